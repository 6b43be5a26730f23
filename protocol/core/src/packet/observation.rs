//! Layout of an observation in shared memory, from the runtime to the plugin.
//!
//! The memory contains `ObservationHeader`, then for each camera its RGB plane (H x W x 3 bytes) and its depth plane (H
//! x W u16, in millimetres), each aligned to 64 bytes. If there are sensors, their section follows
//! ([`crate::sensor::memory`]). Little-endian, fixed offsets. The C header for other languages mirrors this file.
//!
//! If the course withholds pose and velocity, those bytes are zero.

use glam::{DQuat, DVec3};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

use crate::PROTOCOL_VERSION;
use crate::geometry::{Body, Cam, Distortion, Intrinsics, Pose, World};
use crate::messages::MAX_CAMERAS;
use crate::sensor::{SensorHeader, memory};

/// Alignment of the payload and of each of its planes. [bytes]
pub const PLANE_ALIGN: usize = 64;

/// Camera of an observation.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, KnownLayout, Immutable)]
#[repr(C)]
pub struct CameraHeader {
    /// Time at which the newest pose used for this image was measured. [ns, host]
    pub pose_ns: u64,
    /// Time at which the runtime had decoded the image. [ns, host]
    pub ready_ns: u64,
    /// Number of the server's tick in which the image was made.
    pub seq: u64,
    /// fx, fy, cx, cy. [px]
    pub intrinsics_px: [f64; 4],
    /// Distortion coefficients in the order of OpenCV, padded with zeros.
    pub distortion: [f64; 5],
    /// Camera position in the body. [m, body]
    pub translation_m: [f64; 3],
    /// Camera to body rotation, xyzw.
    pub rotation_xyzw: [f64; 4],
    /// Image width; 0 if this camera has no image yet. [px]
    pub width_px: u32,
    /// Image height. [px]
    pub height_px: u32,
    /// Offset of the RGB plane from the start of the header. [bytes]
    pub rgb_offset: u32,
    /// Offset of the depth plane from the start of the header. [bytes]
    pub depth_offset: u32,
    /// Lens model: 0 none, 1 Brown-Conrady, 2 Kannala-Brandt.
    pub distortion_model: u32,
    /// Time from `pose_ns` to the time that the image shows. [ns]
    pub ahead_ns: i32,
    /// Position of the body at that time; zero if the course withholds it. [m, world]
    pub body_position_m: [f64; 3],
    /// Body-to-world rotation at that time, xyzw; zero if the course withholds it.
    pub body_rotation_xyzw: [f64; 4],
}

/// Maximum number of IMU samples in an observation: 0.6 s at 100 Hz. A plugin that skips images for as long as the
/// guard permits still receives every sample.
pub const MAX_IMU: usize = 64;

/// Reading of the autopilot's accelerometer and gyroscope.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, KnownLayout, Immutable)]
#[repr(C)]
pub struct ImuRecord {
    /// Time of the measurement. [ns, host]
    pub stamp_ns: u64,
    /// Specific force: at rest and level, +9.8 along z. [m/s^2, body]
    pub accel_mps2: [f32; 3],
    /// Angular velocity. [rad/s, body]
    pub gyro_radps: [f32; 3],
}

/// Header of an observation: state of the vehicle, and offsets of the cameras' planes.
#[derive(Clone, Copy, Debug, PartialEq, FromBytes, IntoBytes, KnownLayout, Immutable)]
#[repr(C)]
pub struct ObservationHeader {
    magic: [u8; 4],
    version: u16,
    /// Number of valid entries in `cameras`.
    pub camera_count: u8,
    /// [`Self::HAS_ATTITUDE`] and [`Self::HAS_POSE`].
    pub flags: u8,
    /// Total size of header and planes. [bytes]
    pub total_len: u32,
    /// Number of valid samples in `imu`.
    pub imu_count: u32,
    /// Sequence number of the observation in this runtime.
    pub seq: u64,
    /// Time at which the vehicle's state below was valid. [ns, host]
    pub vehicle_ns: u64,
    /// Position, if [`Self::HAS_POSE`] is set. [m, world]
    pub position_m: [f64; 3],
    /// Velocity, if [`Self::HAS_POSE`] is set. [m/s, world]
    pub velocity_mps: [f64; 3],
    /// Body-to-world rotation, xyzw, if [`Self::HAS_ATTITUDE`] is set.
    pub rotation_xyzw: [f64; 4],
    /// Angular velocity, if [`Self::HAS_ATTITUDE`] is set. [rad/s, body]
    pub angular_radps: [f64; 3],
    /// Remaining battery charge, 0 to 1; negative if unknown.
    pub battery_fraction: f64,
    /// Battery voltage; 0 if unknown. [V]
    pub battery_v: f64,
    /// Newest IMU samples, oldest first. Samples of the previous observation are repeated, so that a reader that
    /// skipped it misses none. New samples can be found by their stamps.
    pub imu: [ImuRecord; MAX_IMU],
    /// Cameras; the first `camera_count` are valid.
    pub cameras: [CameraHeader; MAX_CAMERAS],
    /// Offset of the table of sensors from the start of the header, if there are sensors. [bytes]
    pub sensors_offset: u32,
    /// Number of sensors in the table.
    pub sensor_count: u32,
}

// The layout is an interface to other languages and processes.
const _: () = assert!(size_of::<CameraHeader>() == 232);
const _: () = assert!(size_of::<ImuRecord>() == 32);
const _: () = assert!(size_of::<ObservationHeader>() == 160 + 32 * MAX_IMU + 232 * MAX_CAMERAS);

/// Offsets of the planes of a set of images.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ObservationLayout {
    /// (rgb offset, depth offset) of each camera. [bytes]
    pub planes: [(usize, usize); MAX_CAMERAS],
    /// Total size of header and planes. [bytes]
    pub total_len: usize,
}

impl ObservationLayout {
    /// Computes the layout for images of these (width, height), at most [`MAX_CAMERAS`]. [px]
    pub fn of(sizes: &[(u32, u32)]) -> Self {
        let mut planes = [(0, 0); MAX_CAMERAS];
        let mut end = align(size_of::<ObservationHeader>());
        for (plane, &(width, height)) in planes.iter_mut().zip(sizes) {
            let pixels = width as usize * height as usize;
            let depth = align(end + 3 * pixels);
            *plane = (end, depth);
            end = align(depth + 2 * pixels);
        }
        Self { planes, total_len: end }
    }
}

const fn align(offset: usize) -> usize {
    offset.next_multiple_of(PLANE_ALIGN)
}

/// Reason why shared memory does not contain a valid observation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InvalidObservation {
    /// Too short or misaligned.
    #[error("observation of {0} bytes is cut short or misaligned")]
    Short(usize),
    /// Wrong magic or version.
    #[error(
        "observation is not of protocol {PROTOCOL_VERSION}: rebuild the plugin with this runtime's SDK"
    )]
    Foreign,
    /// More IMU samples than the maximum.
    #[error("observation has {0} IMU samples; the maximum is {MAX_IMU}")]
    Imu(u32),
    /// A plane lies outside the memory.
    #[error("camera {0} of the observation lies outside its memory")]
    Plane(usize),
    /// A sensor of an unknown kind, or a reading outside the memory.
    #[error("sensor {0} of the observation lies outside its memory, or is of an unknown kind")]
    Sensor(usize),
}

impl ObservationHeader {
    const MAGIC: [u8; 4] = *b"VZOB";
    /// Bit of `flags`: rotation and angular velocity of the vehicle are valid.
    pub const HAS_ATTITUDE: u8 = 1;
    /// Bit of `flags`: position and velocity of the vehicle are valid.
    pub const HAS_POSE: u8 = 2;

    /// Returns an empty header for `camera_count` cameras and `total_len` bytes.
    pub fn new(seq: u64, camera_count: u8, total_len: u32) -> Self {
        Self {
            magic: Self::MAGIC,
            version: PROTOCOL_VERSION,
            camera_count,
            flags: 0,
            total_len,
            imu_count: 0,
            seq,
            vehicle_ns: 0,
            position_m: [0.0; 3],
            velocity_mps: [0.0; 3],
            rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
            angular_radps: [0.0; 3],
            battery_fraction: -1.0,
            battery_v: 0.0,
            imu: [ImuRecord::default(); MAX_IMU],
            cameras: [CameraHeader::default(); MAX_CAMERAS],
            sensors_offset: 0,
            sensor_count: 0,
        }
    }

    /// Reads and validates the header in place. In a valid header, all planes and readings lie within `bytes`.
    pub fn parse(bytes: &[u8]) -> Result<&Self, InvalidObservation> {
        let (header, _) =
            Self::ref_from_prefix(bytes).map_err(|_| InvalidObservation::Short(bytes.len()))?;
        if header.magic != Self::MAGIC || header.version != PROTOCOL_VERSION {
            return Err(InvalidObservation::Foreign);
        }
        if usize::from(header.camera_count) > MAX_CAMERAS {
            return Err(InvalidObservation::Plane(header.camera_count.into()));
        }
        if header.imu_count as usize > MAX_IMU {
            return Err(InvalidObservation::Imu(header.imu_count));
        }
        for (index, camera) in header.cameras[..header.camera_count.into()].iter().enumerate() {
            let pixels = u64::from(camera.width_px) * u64::from(camera.height_px);
            let fits = |offset: u32, bytes_per_pixel: u64, alignment: u32| {
                // No overflow (3 * 2^64): the sides are bounded below.
                offset.is_multiple_of(alignment)
                    && u64::from(offset) + bytes_per_pixel * pixels <= bytes.len() as u64
            };
            let sides = camera.width_px.max(camera.height_px) <= Intrinsics::MAX_SIDE_PX;
            if !(sides && fits(camera.rgb_offset, 3, 1) && fits(camera.depth_offset, 2, 2)) {
                return Err(InvalidObservation::Plane(index));
            }
        }
        memory::parse(bytes, header.sensors_offset, header.sensor_count)
            .map_err(InvalidObservation::Sensor)?;
        Ok(header)
    }

    /// Returns the sensors of the observation in `bytes`, which starts with this header.
    pub fn sensors<'a>(&self, bytes: &'a [u8]) -> &'a [SensorHeader] {
        memory::parse(bytes, self.sensors_offset, self.sensor_count).unwrap_or_default()
    }

    /// Returns the vehicle's attitude, body to world, if known.
    pub fn attitude(&self) -> Option<DQuat> {
        (self.flags & Self::HAS_ATTITUDE != 0).then(|| DQuat::from_array(self.rotation_xyzw))
    }

    /// Returns the vehicle's pose, if the course allows it.
    pub fn world_from_body(&self) -> Option<Pose<World, Body>> {
        let attitude = self.attitude().filter(|_| self.flags & Self::HAS_POSE != 0)?;
        Some(Pose::new(DVec3::from(self.position_m), attitude))
    }

    /// Returns the valid IMU samples, oldest first.
    pub fn imu(&self) -> &[ImuRecord] {
        &self.imu[..(self.imu_count as usize).min(MAX_IMU)]
    }
}

impl CameraHeader {
    /// Writes the camera's intrinsics.
    pub fn set_intrinsics(&mut self, k: &Intrinsics) {
        let (model, distortion) = k.distortion.to_wire();
        self.width_px = k.width_px;
        self.height_px = k.height_px;
        self.intrinsics_px = [k.fx_px, k.fy_px, k.cx_px, k.cy_px];
        self.distortion_model = model.into();
        self.distortion = distortion;
    }

    /// Returns the camera's intrinsics.
    pub fn intrinsics(&self) -> Intrinsics {
        let [fx_px, fy_px, cx_px, cy_px] = self.intrinsics_px;
        let model = u8::try_from(self.distortion_model).unwrap_or(u8::MAX);
        Intrinsics {
            width_px: self.width_px,
            height_px: self.height_px,
            fx_px,
            fy_px,
            cx_px,
            cy_px,
            distortion: Distortion::from_wire(model, self.distortion).unwrap_or_default(),
        }
    }

    /// Returns the pose of the body at the time that the image shows, if the course allows it.
    pub fn pose_at_image(&self) -> Option<Pose<World, Body>> {
        let rotation = DQuat::from_array(self.body_rotation_xyzw);
        Some(Pose::new(DVec3::from(self.body_position_m), rotation)).filter(Pose::is_valid)
    }

    /// Writes the pose of the body at the time that the image shows.
    pub fn set_pose_at_image(&mut self, world_from_body: &Pose<World, Body>) {
        self.body_position_m = world_from_body.translation_m.to_array();
        self.body_rotation_xyzw = world_from_body.rotation.to_array();
    }

    /// Returns the camera's extrinsics.
    pub fn body_from_cam(&self) -> Pose<Body, Cam> {
        Pose::new(DVec3::from(self.translation_m), DQuat::from_array(self.rotation_xyzw))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[repr(align(64))]
    struct Aligned([u8; 8192]);

    fn memory(header: &ObservationHeader) -> Aligned {
        let mut memory = Aligned([0; 8192]);
        memory.0[..size_of::<ObservationHeader>()].copy_from_slice(header.as_bytes());
        memory
    }

    fn header(width: u32, height: u32) -> ObservationHeader {
        let layout = ObservationLayout::of(&[(width, height)]);
        let mut header = ObservationHeader::new(1, 1, layout.total_len as u32);
        header.cameras[0].width_px = width;
        header.cameras[0].height_px = height;
        header.cameras[0].rgb_offset = layout.planes[0].0 as u32;
        header.cameras[0].depth_offset = layout.planes[0].1 as u32;
        header
    }

    #[test]
    fn parses_a_valid_observation() {
        let header = header(30, 20);
        assert_eq!(ObservationHeader::parse(&memory(&header).0), Ok(&header));
        assert_eq!(header.world_from_body(), None);
    }

    #[test]
    fn rejects_planes_outside_the_memory() {
        let mut h = header(30, 20);
        h.cameras[0].depth_offset = 8190;
        assert_eq!(ObservationHeader::parse(&memory(&h).0), Err(InvalidObservation::Plane(0)));
        let mut h = header(30, 20);
        h.cameras[0].width_px = u32::MAX;
        h.cameras[0].height_px = u32::MAX;
        assert_eq!(ObservationHeader::parse(&memory(&h).0), Err(InvalidObservation::Plane(0)));
        let mut h = header(30, 20);
        h.imu_count = MAX_IMU as u32 + 1;
        assert_eq!(ObservationHeader::parse(&memory(&h).0), Err(InvalidObservation::Imu(65)));
        assert!(ObservationHeader::parse(&[0; 64]).is_err());
    }

    proptest! {
        #[test]
        fn planes_are_aligned_and_do_not_overlap(sizes in prop::collection::vec((1u32..200, 1u32..200), 1..=MAX_CAMERAS)) {
            let layout = ObservationLayout::of(&sizes);
            let mut end = size_of::<ObservationHeader>();
            for (&(rgb, depth), &(w, h)) in layout.planes.iter().zip(&sizes) {
                let pixels = (w * h) as usize;
                prop_assert!(rgb % PLANE_ALIGN == 0 && depth % PLANE_ALIGN == 0);
                prop_assert!(rgb >= end && depth >= rgb + 3 * pixels);
                end = depth + 2 * pixels;
            }
            prop_assert!(layout.total_len >= end);
        }
    }
}
