//! The layout of one observation in shared memory, from the runtime to the plugin.
//!
//! `ObservationHeader`, then for each camera its RGB plane (H x W x 3 bytes) and its depth plane
//! (H x W u16 of millimetres), each at a 64-byte boundary; behind them the sensors' part, if there are
//! sensors ([`crate::sensor::memory`]). Little-endian, fixed offsets: the C header for other languages
//! mirrors this file.
//!
//! What the course withholds (pose, velocity) is not written: those bytes are zero.

use glam::{DQuat, DVec3};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

use crate::PROTOCOL_VERSION;
use crate::geometry::{Body, Cam, Distortion, Intrinsics, Pose, World};
use crate::messages::MAX_CAMERAS;
use crate::sensor::{SensorHeader, memory};

/// Alignment of the payload and of each plane in it. [bytes]
pub const PLANE_ALIGN: usize = 64;

/// One camera of an observation.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, KnownLayout, Immutable)]
#[repr(C)]
pub struct CameraHeader {
    /// When the newest pose behind this image was measured. [ns, host]
    pub pose_ns: u64,
    /// When the runtime had the decoded image. [ns, host]
    pub ready_ns: u64,
    /// Tick of the server that made the image.
    pub seq: u64,
    /// fx, fy, cx, cy. [px]
    pub intrinsics_px: [f64; 4],
    /// Coefficients in the order of OpenCV, the rest 0.
    pub distortion: [f64; 5],
    /// Camera position in the body. [m, body]
    pub translation_m: [f64; 3],
    /// Camera to body rotation, xyzw.
    pub rotation_xyzw: [f64; 4],
    /// Image width; 0 if this camera has no image yet. [px]
    pub width_px: u32,
    /// Image height. [px]
    pub height_px: u32,
    /// Start of the RGB plane from the start of the header. [bytes]
    pub rgb_offset: u32,
    /// Start of the depth plane. [bytes]
    pub depth_offset: u32,
    /// The lens: 0 none, 1 Brown-Conrady, 2 Kannala-Brandt.
    pub distortion_model: u32,
    /// By how much later than `pose_ns` the instant is that the image shows. [ns]
    pub ahead_ns: i32,
    /// Where the body was at that instant; zero where the course withholds it. [m, world]
    pub body_position_m: [f64; 3],
    /// Body to world rotation at that instant, xyzw; zero where the course withholds it.
    pub body_rotation_xyzw: [f64; 4],
}

/// Most IMU samples in one observation: 0.6 s at 100 Hz, so that a plugin that skips images for as
/// long as the guard lets it still gets every sample.
pub const MAX_IMU: usize = 64;

/// One reading of the autopilot's accelerometer and gyroscope.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, KnownLayout, Immutable)]
#[repr(C)]
pub struct ImuRecord {
    /// When it was measured. [ns, host]
    pub stamp_ns: u64,
    /// Specific force: at rest and level, +9.8 along z. [m/s^2, body]
    pub accel_mps2: [f32; 3],
    /// Angular velocity. [rad/s, body]
    pub gyro_radps: [f32; 3],
}

/// Head of an observation: the vehicle, and where the cameras' planes lie.
#[derive(Clone, Copy, Debug, PartialEq, FromBytes, IntoBytes, KnownLayout, Immutable)]
#[repr(C)]
pub struct ObservationHeader {
    magic: [u8; 4],
    version: u16,
    /// Cameras in use, from the front of `cameras`.
    pub camera_count: u8,
    /// [`Self::HAS_ATTITUDE`] and [`Self::HAS_POSE`].
    pub flags: u8,
    /// Bytes of header and planes together.
    pub total_len: u32,
    /// Samples in use, from the front of `imu`.
    pub imu_count: u32,
    /// Counts observations of this runtime.
    pub seq: u64,
    /// When the vehicle's state below was true. [ns, host]
    pub vehicle_ns: u64,
    /// Position, with [`Self::HAS_POSE`]. [m, world]
    pub position_m: [f64; 3],
    /// Velocity, with [`Self::HAS_POSE`]. [m/s, world]
    pub velocity_mps: [f64; 3],
    /// Body to world rotation, xyzw, with [`Self::HAS_ATTITUDE`].
    pub rotation_xyzw: [f64; 4],
    /// Angular velocity, with [`Self::HAS_ATTITUDE`]. [rad/s, body]
    pub angular_radps: [f64; 3],
    /// Battery left, 0 to 1; negative if unknown.
    pub battery_fraction: f64,
    /// Battery voltage; 0 if unknown. [V]
    pub battery_v: f64,
    /// The newest IMU samples, oldest first. Those that came with the former observation are
    /// there again: a reader that skipped it misses none, and finds new ones by their stamps.
    pub imu: [ImuRecord; MAX_IMU],
    /// The cameras.
    pub cameras: [CameraHeader; MAX_CAMERAS],
    /// Start of the table of sensors from the start of the header, if there are any. [bytes]
    pub sensors_offset: u32,
    /// Sensors in the table.
    pub sensor_count: u32,
}

// The layout is a contract with other languages and processes.
const _: () = assert!(size_of::<CameraHeader>() == 232);
const _: () = assert!(size_of::<ImuRecord>() == 32);
const _: () = assert!(size_of::<ObservationHeader>() == 160 + 32 * MAX_IMU + 232 * MAX_CAMERAS);

/// Where the planes of a set of images lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ObservationLayout {
    /// (rgb offset, depth offset) of each camera. [bytes]
    pub planes: [(usize, usize); MAX_CAMERAS],
    /// Bytes of header and planes together.
    pub total_len: usize,
}

impl ObservationLayout {
    /// Lays out images of the given (width, height), at most [`MAX_CAMERAS`]. [px]
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

/// Why shared memory does not hold an observation.
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
    /// More IMU samples than there is room for.
    #[error("observation names {0} IMU samples; there is room for {MAX_IMU}")]
    Imu(u32),
    /// A plane lies outside the memory.
    #[error("camera {0} of the observation lies outside its memory")]
    Plane(usize),
    /// A sensor of no kind, or a reading that lies outside the memory.
    #[error("sensor {0} of the observation lies outside its memory, or is of an unknown kind")]
    Sensor(usize),
}

impl ObservationHeader {
    const MAGIC: [u8; 4] = *b"VZOB";
    /// Bit of `flags`: the vehicle's rotation and angular velocity are filled in.
    pub const HAS_ATTITUDE: u8 = 1;
    /// Bit of `flags`: so are its position and velocity.
    pub const HAS_POSE: u8 = 2;

    /// Makes an empty header for `camera_count` cameras and `total_len` bytes.
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

    /// Reads and validates the header in place; every plane and reading named in it then lies in `bytes`.
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
                // 3 * 2^64 cannot come up: sides are bounded first.
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

    /// Returns the sensors of the observation in `bytes`, of which this is the header.
    pub fn sensors<'a>(&self, bytes: &'a [u8]) -> &'a [SensorHeader] {
        memory::parse(bytes, self.sensors_offset, self.sensor_count).unwrap_or_default()
    }

    /// Returns the vehicle's attitude, body to world, if it is known.
    pub fn attitude(&self) -> Option<DQuat> {
        (self.flags & Self::HAS_ATTITUDE != 0).then(|| DQuat::from_array(self.rotation_xyzw))
    }

    /// Returns the vehicle's pose, if the course lets the plugin know it.
    pub fn world_from_body(&self) -> Option<Pose<World, Body>> {
        let attitude = self.attitude().filter(|_| self.flags & Self::HAS_POSE != 0)?;
        Some(Pose::new(DVec3::from(self.position_m), attitude))
    }

    /// Returns the IMU samples there are, oldest first.
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

    /// Returns where the body was at the instant that the image shows, if the course lets the plugin know it.
    pub fn pose_at_image(&self) -> Option<Pose<World, Body>> {
        let rotation = DQuat::from_array(self.body_rotation_xyzw);
        Some(Pose::new(DVec3::from(self.body_position_m), rotation)).filter(Pose::is_valid)
    }

    /// Writes it.
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
    fn a_laid_out_observation_parses() {
        let header = header(30, 20);
        assert_eq!(ObservationHeader::parse(&memory(&header).0), Ok(&header));
        assert_eq!(header.world_from_body(), None);
    }

    #[test]
    fn planes_outside_the_memory_are_refused() {
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
        fn planes_are_aligned_and_apart(sizes in prop::collection::vec((1u32..200, 1u32..200), 1..=MAX_CAMERAS)) {
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
