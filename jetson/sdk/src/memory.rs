//! Writes observations: into shared memory for the runtime, into owned memory for tests and replays. Counterpart of
//! [`observation`](crate::Observation).

use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::messages::{CameraInfo, MAX_CAMERAS, Name};
use vizflyt_protocol::packet::{ImuRecord, MAX_IMU, ObservationHeader, ObservationLayout};
use vizflyt_protocol::sensor::{MAX_SENSORS, SensorInfo};
use vizflyt_protocol::time::HostTime;
use zerocopy::{FromBytes, FromZeros, Immutable, IntoBytes, KnownLayout};

use crate::observation::{Battery, ImuSample, Observation, Vehicle};
use crate::sensor::GivenReading;

/// Stamps of one image and the server tick that rendered it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ImageStamps {
    /// Server tick that rendered the image.
    pub seq: u64,
    /// Measurement time of the newest pose behind the image. [host]
    pub pose: HostTime,
    /// Time from `pose` to the instant that the image shows. [ns]
    pub ahead_ns: i32,
    /// Time at which the image was decoded. [host]
    pub ready: HostTime,
}

/// Writes one observation in place: header, then the planes of each camera.
#[derive(Debug)]
pub struct ObservationWriter<'m> {
    memory: &'m mut [u8],
    layout: ObservationLayout,
}

/// Planes of one camera, to be filled in.
#[derive(Debug)]
pub struct PlanesMut<'m> {
    /// Colour, H x W x 3.
    pub rgb: &'m mut [u8],
    /// Depth, H x W; 0 means no return. [mm]
    pub depth_mm: &'m mut [u16],
}

/// The cameras' images do not fit in the given memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("observation needs {needed} bytes aligned to 8, the memory has {found}")]
pub struct ObservationTooLarge {
    /// Bytes that the cameras need.
    pub needed: usize,
    /// Bytes of the given memory.
    pub found: usize,
}

impl<'m> ObservationWriter<'m> {
    /// Returns the size of an observation of these cameras. [bytes]
    pub fn len_for(cameras: &[CameraInfo]) -> usize {
        layout_of(cameras).total_len
    }

    /// Starts observation `seq` in `memory`, without images and vehicle state.
    ///
    /// # Errors
    /// If `memory` is smaller than [`Self::len_for`] or not aligned to 8.
    pub fn new(
        memory: &'m mut [u8],
        seq: u64,
        cameras: &[CameraInfo],
    ) -> Result<Self, ObservationTooLarge> {
        let layout = layout_of(cameras);
        let found = memory.len();
        let error = ObservationTooLarge { needed: layout.total_len, found };
        let total_len = u32::try_from(layout.total_len).map_err(|_| error)?;
        if found < layout.total_len {
            return Err(error);
        }
        let count = cameras.len().min(MAX_CAMERAS);
        let mut header = ObservationHeader::new(seq, count as u8, total_len);
        for (head, &(rgb, depth)) in header.cameras[..count].iter_mut().zip(&layout.planes) {
            // `image_ready` sets the other fields.
            (head.rgb_offset, head.depth_offset) = (rgb as u32, depth as u32);
        }
        let (place, _) = ObservationHeader::mut_from_prefix(memory).map_err(|_| error)?;
        *place = header;
        Ok(Self { memory, layout })
    }

    /// Starts `memory` as a copy of the observation `from` of `old_cameras`, with a new layout for `cameras`, after a
    /// camera has changed its size. Images of cameras with an unchanged size are copied.
    ///
    /// # Errors
    /// As [`Self::new`], for either memory.
    pub fn adopt(
        memory: &'m mut [u8],
        cameras: &[CameraInfo],
        from: &[u8],
        old_cameras: &[CameraInfo],
    ) -> Result<Self, ObservationTooLarge> {
        let old_layout = layout_of(old_cameras);
        let error = ObservationTooLarge { needed: old_layout.total_len, found: from.len() };
        let (old, _) = ObservationHeader::ref_from_prefix(from).map_err(|_| error)?;
        let mut new = Self::new(memory, old.seq, cameras)?;
        for index in 0..cameras.len().min(old_cameras.len()).min(MAX_CAMERAS) {
            let (camera, was) = (&cameras[index], old.cameras[index]);
            let size = (camera.intrinsics.width_px, camera.intrinsics.height_px);
            if was.width_px == 0 || (was.width_px, was.height_px) != size {
                continue;
            }
            let pixels = camera.intrinsics.pixels();
            let (old_planes, new_planes) = (old_layout.planes[index], new.layout.planes[index]);
            for (old_at, new_at, len) in
                [(old_planes.0, new_planes.0, 3 * pixels), (old_planes.1, new_planes.1, 2 * pixels)]
            {
                let plane = from.get(old_at..old_at + len).ok_or(error)?;
                new.memory[new_at..new_at + len].copy_from_slice(plane);
            }
            let mut head = was;
            (head.rgb_offset, head.depth_offset) = (new_planes.0 as u32, new_planes.1 as u32);
            new.header().cameras[index] = head;
        }
        Ok(new)
    }

    /// Continues an observation of these cameras that [`Self::new`] started in `memory`.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn resume(
        memory: &'m mut [u8],
        cameras: &[CameraInfo],
    ) -> Result<Self, ObservationTooLarge> {
        let layout = layout_of(cameras);
        let found = memory.len();
        if found < layout.total_len || ObservationHeader::mut_from_prefix(memory).is_err() {
            return Err(ObservationTooLarge { needed: layout.total_len, found });
        }
        Ok(Self { memory, layout })
    }

    /// Returns the end of the last image. [bytes]
    pub(crate) fn images_end(&self) -> usize {
        self.layout.total_len
    }

    pub(crate) fn memory(&mut self) -> &mut [u8] {
        self.memory
    }

    fn header(&mut self) -> &mut ObservationHeader {
        ObservationHeader::mut_from_prefix(self.memory).expect("checked in `new`").0
    }

    /// Writes the vehicle state that the plugin may see. `None` fields stay zero.
    pub fn vehicle(&mut self, vehicle: &Vehicle) {
        let header = self.header();
        header.flags |= ObservationHeader::HAS_ATTITUDE;
        header.vehicle_ns = vehicle.stamp.as_ns();
        header.rotation_xyzw = vehicle.attitude.to_array();
        header.angular_radps = vehicle.omega_body_radps.to_array();
        if let (Some(pose), Some(v_world_mps)) = (vehicle.world_from_body, vehicle.v_world_mps) {
            header.flags |= ObservationHeader::HAS_POSE;
            header.position_m = pose.translation_m.to_array();
            header.velocity_mps = v_world_mps.to_array();
        }
    }

    /// Writes the state of the battery.
    pub fn battery(&mut self, battery: &Battery) {
        let header = self.header();
        header.battery_fraction = battery.fraction.unwrap_or(-1.0);
        header.battery_v = battery.voltage_v.unwrap_or(0.0);
    }

    /// Writes IMU samples, oldest first. Of more than 64, the newest 64 are written.
    pub fn imu<'s>(&mut self, samples: impl IntoIterator<Item = &'s ImuSample>) {
        let header = self.header();
        let mut count = 0;
        for sample in samples {
            header.imu[count % MAX_IMU] = ImuRecord {
                stamp_ns: sample.stamp.as_ns(),
                accel_mps2: sample.accel_mps2.to_array().map(|value| value as f32),
                gyro_radps: sample.gyro_radps.to_array().map(|value| value as f32),
            };
            count += 1;
        }
        if count > MAX_IMU {
            header.imu.rotate_left(count % MAX_IMU);
        }
        header.imu_count = count.min(MAX_IMU) as _;
    }

    /// Returns the planes of camera `index`, of the size in its [`CameraInfo`], to decode into. `None` for an
    /// unknown index. Call [`Self::image_ready`] afterwards.
    pub fn planes(&mut self, index: usize, camera: &CameraInfo) -> Option<PlanesMut<'_>> {
        let count = usize::from(self.header().camera_count);
        let &(rgb_at, depth_at) = self.layout.planes[..count].get(index)?;
        let pixels = camera.intrinsics.pixels();
        let (front, back) = self.memory.split_at_mut_checked(depth_at)?;
        let rgb = front.get_mut(rgb_at..rgb_at + 3 * pixels)?;
        let depth_mm = <[u16]>::mut_from_bytes(back.get_mut(..2 * pixels)?).ok()?;
        Some(PlanesMut { rgb, depth_mm })
    }

    /// Writes the pose of the body at the instant that the image of camera `index` shows. Call it only if the course
    /// gives the pose to the plugin.
    pub fn pose_at_image(&mut self, index: usize, world_from_body: &Pose<World, Body>) {
        let count = usize::from(self.header().camera_count);
        if let Some(head) = self.header().cameras[..count].get_mut(index) {
            head.set_pose_at_image(world_from_body);
        }
    }

    /// Marks the planes of camera `index` as filled. A plugin does not see the image before.
    pub fn image_ready(&mut self, index: usize, camera: &CameraInfo, stamps: ImageStamps) {
        let count = usize::from(self.header().camera_count);
        let Some(head) = self.header().cameras[..count].get_mut(index) else { return };
        head.set_intrinsics(&camera.intrinsics);
        head.translation_m = camera.body_from_cam.translation_m.to_array();
        head.rotation_xyzw = camera.body_from_cam.rotation.to_array();
        head.seq = stamps.seq;
        head.pose_ns = stamps.pose.as_ns();
        head.ahead_ns = stamps.ahead_ns;
        head.ready_ns = stamps.ready.as_ns();
    }
}

fn layout_of(cameras: &[CameraInfo]) -> ObservationLayout {
    let mut sizes = [(0, 0); MAX_CAMERAS];
    for (size, camera) in sizes.iter_mut().zip(cameras) {
        *size = (camera.intrinsics.width_px, camera.intrinsics.height_px);
    }
    ObservationLayout::of(&sizes[..cameras.len().min(MAX_CAMERAS)])
}

/// One observation in owned memory, for tests, replays and tools.
///
/// ```
/// use vizflyt_sdk::{CameraInfo, ImageStamps, Intrinsics, ObservationBuffer};
/// let front = CameraInfo::forward("front", Intrinsics::from_horizontal_fov(4, 2, 1.5));
/// let mut buffer = ObservationBuffer::new(&[front]);
/// buffer.set_image(0, ImageStamps::default(), |planes| {
///     planes.rgb.fill(128);
///     planes.depth_mm.fill(2500);
/// });
/// let obs = buffer.observation();
/// assert_eq!(obs.camera("front").unwrap().depth_m(3, 1), Some(2.5));
/// assert!(obs.camera("rear").is_none() && obs.vehicle().is_none());
/// ```
#[derive(Debug)]
pub struct ObservationBuffer {
    blocks: Vec<Block>,
    cameras: Vec<CameraInfo>,
    sensors: Vec<SensorInfo>,
    names: Vec<Name>,
}

/// Memory in units of the layout's alignment.
#[derive(Clone, Copy, Debug, FromBytes, IntoBytes, KnownLayout, Immutable)]
#[repr(C, align(64))]
struct Block([u8; 64]);

impl ObservationBuffer {
    /// Creates an empty observation with number 0 of these cameras (at most 8).
    ///
    /// # Panics
    /// If the cameras together need 4 GiB or more.
    pub fn new(cameras: &[CameraInfo]) -> Self {
        Self::with_sensors(cameras, &[])
    }

    /// As [`Self::new`], with space for the readings of these sensors (at most 8).
    ///
    /// # Panics
    /// As [`Self::new`].
    pub fn with_sensors(cameras: &[CameraInfo], sensors: &[SensorInfo]) -> Self {
        let cameras = cameras[..cameras.len().min(MAX_CAMERAS)].to_vec();
        let sensors = sensors[..sensors.len().min(MAX_SENSORS)].to_vec();
        let names = cameras.iter().map(|camera| camera.name.clone()).collect();
        let len = ObservationWriter::len_for(&cameras) + ObservationWriter::sensors_len(&sensors);
        let blocks = vec![Block::new_zeroed(); len.div_ceil(size_of::<Block>())];
        let mut buffer = Self { blocks, cameras, sensors, names };
        buffer.clear(0);
        buffer
    }

    /// Removes all content and sets the number to `seq`.
    ///
    /// # Panics
    /// As [`Self::new`].
    pub fn clear(&mut self, seq: u64) {
        ObservationWriter::new(self.blocks.as_mut_bytes(), seq, &self.cameras)
            .expect("sized in `new`; larger than 4 GiB is no observation");
    }

    fn writer(&mut self) -> ObservationWriter<'_> {
        let layout = layout_of(&self.cameras);
        ObservationWriter { memory: self.blocks.as_mut_bytes(), layout }
    }

    /// Writes the vehicle state that the plugin may see.
    pub fn set_vehicle(&mut self, vehicle: &Vehicle) {
        self.writer().vehicle(vehicle);
    }

    /// Writes the state of the battery.
    pub fn set_battery(&mut self, battery: &Battery) {
        self.writer().battery(battery);
    }

    /// Writes IMU samples, oldest first. Of more than 64, the newest 64 are written.
    pub fn set_imu(&mut self, samples: &[ImuSample]) {
        self.writer().imu(samples);
    }

    /// Writes the image of camera `index` with `fill`. Does nothing for an unknown index.
    pub fn set_image(
        &mut self,
        index: usize,
        stamps: ImageStamps,
        fill: impl FnOnce(PlanesMut<'_>),
    ) {
        let Some(camera) = self.cameras.get(index).cloned() else { return };
        let mut writer = self.writer();
        if let Some(planes) = writer.planes(index, &camera) {
            fill(planes);
            writer.image_ready(index, &camera, stamps);
        }
    }

    /// Writes the pose of the body at the instant that the image of camera `index` shows.
    pub fn set_pose_at_image(&mut self, index: usize, world_from_body: &Pose<World, Body>) {
        self.writer().pose_at_image(index, world_from_body);
    }

    /// Writes the newest readings, in the order of the sensors. `None` stands for a sensor without a reading.
    pub fn set_readings(&mut self, readings: &[Option<GivenReading<'_>>]) {
        let sensors = std::mem::take(&mut self.sensors);
        self.writer().sensors(&sensors, readings);
        self.sensors = sensors;
    }

    /// Returns the bytes in the layout of [`ObservationHeader`], aligned to 64.
    pub fn as_bytes(&self) -> &[u8] {
        self.blocks.as_bytes()
    }

    /// Returns the plugin's view of this observation.
    ///
    /// # Panics
    /// Never, because this module creates the layout.
    pub fn observation(&self) -> Observation<'_> {
        Observation::from_bytes(self.as_bytes(), &self.names).expect("laid out in `new`")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};
    use proptest::prelude::*;
    use vizflyt_protocol::geometry::{Intrinsics, Pose, body_from_forward_cam};
    use vizflyt_protocol::messages::bounded;
    use vizflyt_protocol::packet::InvalidObservation;

    fn camera(name: &str, width_px: u32, height_px: u32) -> CameraInfo {
        CameraInfo {
            name: bounded(name),
            intrinsics: Intrinsics::from_horizontal_fov(width_px, height_px, 1.5),
            body_from_cam: body_from_forward_cam(DVec3::X * 0.06, 0.2),
        }
    }

    #[test]
    fn written_observation_reads_back_equal() {
        let cameras = [camera("front", 5, 3), camera("rear", 7, 4)];
        let mut buffer = ObservationBuffer::new(&cameras);
        assert_eq!(buffer.observation().cameras().count(), 0);
        let vehicle = Vehicle {
            stamp: HostTime::from_ns(5),
            attitude: DQuat::from_rotation_z(0.5),
            omega_body_radps: DVec3::Z,
            world_from_body: Some(Pose::new(DVec3::ONE, DQuat::from_rotation_z(0.5))),
            v_world_mps: Some(DVec3::Y),
        };
        buffer.set_vehicle(&vehicle);
        let battery = Battery { fraction: Some(0.5), voltage_v: None };
        buffer.set_battery(&battery);
        let imu = |ns| ImuSample {
            stamp: HostTime::from_ns(ns),
            accel_mps2: DVec3::new(0.0, 0.5, 9.75),
            gyro_radps: DVec3::X,
        };
        buffer.set_imu(&[imu(10), imu(20), imu(30)]);
        let stamps = ImageStamps {
            seq: 3,
            pose: HostTime::from_ns(7),
            ready: HostTime::from_ns(9),
            ahead_ns: 4,
        };
        buffer.set_image(1, stamps, |planes| {
            for (index, depth_mm) in planes.depth_mm.iter_mut().enumerate() {
                *depth_mm = index as u16;
            }
            planes.rgb[3 * 27..].copy_from_slice(&[1, 2, 3]);
        });
        buffer.set_image(9, stamps, |_| panic!("there is no camera 9"));

        let observation = buffer.observation();
        assert_eq!(observation.vehicle(), Some(vehicle));
        assert_eq!(observation.battery(), battery);
        assert_eq!(observation.imu().collect::<Vec<_>>(), [imu(10), imu(20), imu(30)]);
        let later = observation.with_imu_after(HostTime::from_ns(20));
        assert_eq!(later.imu().collect::<Vec<_>>(), [imu(30)]);
        assert_eq!(later.newest_imu(), Some(HostTime::from_ns(30)));
        assert_eq!(observation.stamp(), HostTime::from_ns(7));
        assert!(observation.camera("front").is_none(), "it has no image yet");
        let rear = observation.camera("rear").unwrap();
        assert_eq!((rear.seq, rear.stamp, rear.ready), (3, stamps.pose, stamps.ready));
        assert_eq!(
            (rear.intrinsics, rear.body_from_cam),
            (cameras[1].intrinsics, cameras[1].body_from_cam)
        );
        assert_eq!(rear.depth_m(0, 0), None, "0 is no return");
        assert_eq!((rear.depth_m(6, 3), rear.rgb_at(6, 3)), (Some(0.027), Some([1, 2, 3])));

        buffer.clear(8);
        assert_eq!(buffer.observation().seq(), 8);
        assert!(
            buffer.observation().vehicle().is_none()
                && buffer.observation().cameras().next().is_none()
        );

        let many: Vec<_> = (1..=MAX_IMU as u64 + 9).map(imu).collect();
        buffer.set_imu(&many);
        assert_eq!(buffer.observation().imu().collect::<Vec<_>>(), many[9..]);
    }

    /// Withheld values are absent from the plugin's memory, not only hidden by the API.
    #[test]
    fn withheld_pose_is_not_in_memory() {
        let secret = 1234.5678_f64;
        let holds = |buffer: &ObservationBuffer| {
            let bytes = buffer.as_bytes();
            bytes.windows(8).any(|window| window == secret.to_le_bytes())
        };
        let mut buffer = ObservationBuffer::new(&[camera("front", 5, 3)]);
        let mut vehicle = Vehicle {
            stamp: HostTime::from_ns(5),
            attitude: DQuat::from_rotation_z(0.5),
            omega_body_radps: DVec3::Z,
            world_from_body: Some(Pose::new(DVec3::splat(secret), DQuat::IDENTITY)),
            v_world_mps: Some(DVec3::splat(secret)),
        };
        buffer.set_vehicle(&vehicle);
        assert!(holds(&buffer));
        buffer.clear(1);
        assert!(!holds(&buffer), "clearing leaves nothing behind");
        (vehicle.world_from_body, vehicle.v_world_mps) = (None, None);
        buffer.set_vehicle(&vehicle);
        assert_eq!(buffer.observation().vehicle(), Some(vehicle));
    }

    #[test]
    fn keeps_images_when_another_camera_changes_size() {
        let old = [camera("front", 5, 3), camera("rear", 7, 4), camera("down", 2, 2)];
        let mut buffer = ObservationBuffer::new(&old);
        buffer.clear(6);
        let stamps = ImageStamps { seq: 3, ..ImageStamps::default() };
        for index in 0..3 {
            buffer.set_image(index, stamps, |planes| {
                planes.rgb.fill(10 + index as u8);
                planes.depth_mm.fill(1000 * (1 + index as u16));
            });
        }
        // The first camera grows, the last shrinks, the middle one keeps its size.
        let new = [camera("front", 50, 30), camera("rear", 7, 4), camera("down", 1, 2)];
        let mut grown = ObservationBuffer::new(&new);
        ObservationWriter::adopt(grown.blocks.as_mut_bytes(), &new, buffer.as_bytes(), &old)
            .unwrap();
        let found = grown.observation();
        assert_eq!((found.seq(), found.cameras().count()), (6, 1));
        let rear = found.camera("rear").unwrap();
        assert_eq!((rear.seq, rear.rgb, rear.depth_mm), (3, &[11; 84][..], &[2000; 28][..]));
        let mut small = vec![0; 64];
        assert!(ObservationWriter::adopt(&mut small, &new, buffer.as_bytes(), &old).is_err());
        assert!(ObservationWriter::adopt(grown.blocks.as_mut_bytes(), &new, &small, &old).is_err());
    }

    #[test]
    fn rejects_memory_that_is_too_small() {
        let cameras = [camera("front", 64, 48)];
        let needed = ObservationWriter::len_for(&cameras);
        let mut memory = vec![0; needed - 1];
        let error = ObservationWriter::new(&mut memory, 0, &cameras).unwrap_err();
        assert_eq!(error, ObservationTooLarge { needed, found: needed - 1 });
        let bytes = ObservationBuffer::new(&cameras);
        let cut = Observation::from_bytes(&bytes.as_bytes()[..64], &[]);
        assert!(matches!(cut, Err(InvalidObservation::Short(64))));
    }

    proptest! {
        /// For any header, a view stays within its bytes or is rejected.
        #[test]
        fn corrupt_headers_never_read_outside(at in 0usize..size_of::<ObservationHeader>(), value in any::<u8>()) {
            let mut buffer = ObservationBuffer::new(&[camera("front", 8, 6)]);
            buffer.set_image(0, ImageStamps::default(), |planes| planes.rgb.fill(9));
            buffer.blocks.as_mut_bytes()[at] = value;
            if let Ok(observation) = Observation::from_bytes(buffer.as_bytes(), &[]) {
                prop_assert!(observation.imu().count() <= MAX_IMU);
                for image in observation.cameras() {
                    let pixels = image.width_px as usize * image.height_px as usize;
                    prop_assert_eq!(image.rgb.len(), 3 * pixels);
                    prop_assert_eq!(image.depth_mm.len(), pixels);
                }
            }
        }
    }
}
