//! Input of a plugin: typed views of shared memory, without a copy.

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Cam, Intrinsics, Pose, World};
use vizflyt_protocol::messages::Name;
use vizflyt_protocol::packet::{CameraHeader, ImuRecord, InvalidObservation, ObservationHeader};
use vizflyt_protocol::time::HostTime;
use zerocopy::FromBytes;

/// The vehicle and the images of its cameras at one moment. Valid only during the call that receives it.
///
/// Built from bytes in the layout of [`ObservationHeader`]: shared memory in flight, an
/// [`ObservationBuffer`](crate::ObservationBuffer) in a test.
#[derive(Clone, Copy, Debug)]
pub struct Observation<'a> {
    header: &'a ObservationHeader,
    bytes: &'a [u8],
    names: &'a [Name],
    /// IMU samples up to this stamp were in an earlier observation.
    imu_after: HostTime,
}

/// State of the vehicle: always the attitude; pose and velocity only if the course allows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Vehicle {
    /// Time of this state. [host]
    pub stamp: HostTime,
    /// Attitude: rotates vectors from body to world axes. From localization if the course gives the pose, otherwise the
    /// autopilot's estimate.
    pub attitude: DQuat,
    /// Angular velocity. [rad/s, body]
    pub omega_body_radps: DVec3,
    /// Position and attitude from localization; `None` if the course withholds them
    /// ([`ArenaInfo::ground_truth`](crate::ArenaInfo::ground_truth)). [m, world]
    pub world_from_body: Option<Pose<World, Body>>,
    /// Velocity; `None` if `world_from_body` is `None`. [m/s, world]
    pub v_world_mps: Option<DVec3>,
}

/// One sample of the autopilot's accelerometer and gyroscope.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ImuSample {
    /// Time of the measurement. [host]
    pub stamp: HostTime,
    /// Specific force: at rest and level, +9.8 along z. [m/s^2, body]
    pub accel_mps2: DVec3,
    /// Angular velocity. [rad/s, body]
    pub gyro_radps: DVec3,
}

/// State of the battery, as measured by the autopilot.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Battery {
    /// Remaining charge, 0 to 1; `None` if the autopilot does not report it.
    pub fraction: Option<f64>,
    /// Voltage; `None` if it is not measured. [V]
    pub voltage_v: Option<f64>,
}

/// RGB-D image of one camera. Row-major; row 0 is the top.
#[derive(Clone, Copy, Debug)]
pub struct CameraImage<'a> {
    /// Name of the camera in `arena.toml`, for example `front`.
    pub name: &'a str,
    /// Server tick that rendered the image; equal for all cameras of a tick.
    pub seq: u64,
    /// Measurement time of the newest pose behind the image. The image's age counts from here. [host]
    pub stamp: HostTime,
    /// Instant that the image shows. The server predicts the pose to the time at which the image is seen, so this is
    /// about now. To combine depth with the vehicle's pose, use the pose at this instant. [host]
    pub shown: HostTime,
    /// Time at which the runtime had decoded the image. [host]
    pub ready: HostTime,
    /// Width. [px]
    pub width_px: u32,
    /// Height. [px]
    pub height_px: u32,
    /// Colour, H x W x 3, sRGB.
    pub rgb: &'a [u8],
    /// Camera-z depth, H x W; 0 means no return. [mm, cam]
    pub depth_mm: &'a [u16],
    /// Focal lengths and principal point. [px]
    pub intrinsics: Intrinsics,
    /// Extrinsics.
    pub body_from_cam: Pose<Body, Cam>,
    /// Pose of the body at the instant that the image shows, from which the image was rendered. `None` if the course
    /// withholds the pose. [m, world]
    pub pose_at_image: Option<Pose<World, Body>>,
}

impl<'a> Observation<'a> {
    /// Reads an observation in place. `names` are the cameras' names in the order of their index; a camera without a
    /// name gets an empty one.
    ///
    /// # Errors
    /// If the bytes are cut short, not aligned to 8, of another protocol version, or refer to a plane outside the
    /// bytes.
    pub fn from_bytes(bytes: &'a [u8], names: &'a [Name]) -> Result<Self, InvalidObservation> {
        let header = ObservationHeader::parse(bytes)?;
        Ok(Self { header, bytes, names, imu_after: HostTime::ZERO })
    }

    /// Excludes IMU samples that are not newer than `stamp`, because the reader already has them.
    pub fn with_imu_after(self, stamp: HostTime) -> Self {
        Self { imu_after: stamp, ..self }
    }

    pub(crate) fn header(&self) -> &'a ObservationHeader {
        self.header
    }

    /// Returns the underlying memory, in the layout of [`ObservationHeader`].
    pub fn as_bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// Returns the observation's number in this flight. Missing numbers were skipped.
    pub fn seq(&self) -> u64 {
        self.header.seq
    }

    /// Returns the measurement time of the newest image's pose, or of the vehicle's state without an image. [host]
    pub fn stamp(&self) -> HostTime {
        self.cameras()
            .map(|camera| camera.stamp)
            .max()
            .unwrap_or(HostTime::from_ns(self.header.vehicle_ns))
    }

    /// Returns the pose of the body at the instant that the newest image shows, which belongs to its pixels. `None`
    /// without an image, and if the course withholds the pose. [m, world]
    pub fn pose_at_image(&self) -> Option<Pose<World, Body>> {
        self.cameras().max_by_key(|camera| camera.shown)?.pose_at_image
    }

    /// Returns the image of the camera with this name. `None` for an unknown name, or without an image.
    pub fn camera(&self, name: &str) -> Option<CameraImage<'a>> {
        self.cameras().find(|camera| camera.name == name)
    }

    /// Returns the available images, in the order of the arena's cameras.
    pub fn cameras(&self) -> impl Iterator<Item = CameraImage<'a>> + use<'a> {
        let (bytes, names) = (self.bytes, self.names);
        self.header.cameras[..self.header.camera_count.into()]
            .iter()
            .enumerate()
            .filter_map(move |(index, camera)| image(bytes, names.get(index), camera))
    }

    /// Returns the state of the vehicle; `None` before the first one.
    pub fn vehicle(&self) -> Option<Vehicle> {
        let header = self.header;
        let world_from_body = header.world_from_body();
        Some(Vehicle {
            stamp: HostTime::from_ns(header.vehicle_ns),
            attitude: header.attitude()?,
            omega_body_radps: DVec3::from(header.angular_radps),
            world_from_body,
            v_world_mps: world_from_body.map(|_| DVec3::from(header.velocity_mps)),
        })
    }

    /// Returns the IMU samples since the plugin's previous image, oldest first. At most the newest 64 (0.6 s at 100
    /// Hz).
    pub fn imu(&self) -> impl Iterator<Item = ImuSample> + use<'a> {
        let after_ns = self.imu_after.as_ns();
        self.header.imu().iter().filter(move |record| record.stamp_ns > after_ns).map(sample)
    }

    /// Returns the measurement time of the newest IMU sample, including excluded ones. [host]
    pub fn newest_imu(&self) -> Option<HostTime> {
        self.header.imu().last().map(|record| HostTime::from_ns(record.stamp_ns))
    }

    /// Returns the state of the battery.
    pub fn battery(&self) -> Battery {
        let (fraction, voltage_v) = (self.header.battery_fraction, self.header.battery_v);
        Battery {
            fraction: (fraction >= 0.0).then_some(fraction),
            voltage_v: (voltage_v > 0.0).then_some(voltage_v),
        }
    }
}

fn sample(record: &ImuRecord) -> ImuSample {
    ImuSample {
        stamp: HostTime::from_ns(record.stamp_ns),
        accel_mps2: DVec3::from(record.accel_mps2.map(f64::from)),
        gyro_radps: DVec3::from(record.gyro_radps.map(f64::from)),
    }
}

fn image<'a>(
    bytes: &'a [u8],
    name: Option<&'a Name>,
    camera: &'a CameraHeader,
) -> Option<CameraImage<'a>> {
    let pixels = camera.width_px as usize * camera.height_px as usize;
    if pixels == 0 {
        return None;
    }
    let (rgb_at, depth_at) = (camera.rgb_offset as usize, camera.depth_offset as usize);
    Some(CameraImage {
        name: name.map_or("", |name| name.as_str()),
        seq: camera.seq,
        stamp: HostTime::from_ns(camera.pose_ns),
        shown: HostTime::from_ns(camera.pose_ns).plus_ns(camera.ahead_ns.into()),
        ready: HostTime::from_ns(camera.ready_ns),
        width_px: camera.width_px,
        height_px: camera.height_px,
        rgb: bytes.get(rgb_at..rgb_at + 3 * pixels)?,
        depth_mm: <[u16]>::ref_from_bytes(bytes.get(depth_at..depth_at + 2 * pixels)?).ok()?,
        intrinsics: camera.intrinsics(),
        body_from_cam: camera.body_from_cam(),
        pose_at_image: camera.pose_at_image(),
    })
}

impl CameraImage<'_> {
    /// Returns the camera-z depth at column `x_px`, row `y_px`. `None` for pixels without a return or outside the
    /// image. [m, cam]
    pub fn depth_m(&self, x_px: u32, y_px: u32) -> Option<f32> {
        if x_px >= self.width_px || y_px >= self.height_px {
            return None;
        }
        let index = y_px as usize * self.width_px as usize + x_px as usize;
        match self.depth_mm.get(index) {
            None | Some(0) => None,
            Some(&depth_mm) => Some(f32::from(depth_mm) / 1000.0),
        }
    }

    /// Returns the colour at column `x_px`, row `y_px`; `None` outside the image.
    pub fn rgb_at(&self, x_px: u32, y_px: u32) -> Option<[u8; 3]> {
        if x_px >= self.width_px || y_px >= self.height_px {
            return None;
        }
        let index = 3 * (y_px as usize * self.width_px as usize + x_px as usize);
        self.rgb.get(index..index + 3)?.try_into().ok()
    }
}
