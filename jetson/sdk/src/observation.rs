//! What a plugin sees: typed views of shared memory, without a copy.

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Cam, Intrinsics, Pose, World};
use vizflyt_protocol::messages::Name;
use vizflyt_protocol::packet::{CameraHeader, ImuRecord, InvalidObservation, ObservationHeader};
use vizflyt_protocol::time::HostTime;
use zerocopy::FromBytes;

/// The vehicle and its cameras' images at one moment. Valid during the call it is given to.
///
/// Built from bytes in the layout of [`ObservationHeader`]: shared memory in flight, an
/// [`ObservationBuffer`](crate::ObservationBuffer) in a test.
#[derive(Clone, Copy, Debug)]
pub struct Observation<'a> {
    header: &'a ObservationHeader,
    bytes: &'a [u8],
    names: &'a [Name],
    /// IMU samples up to here were in an earlier observation.
    imu_after: HostTime,
}

/// What is known of the vehicle: its attitude always, pose and velocity where the course allows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Vehicle {
    /// When this was true. [host]
    pub stamp: HostTime,
    /// Attitude: rotates vectors from body to world axes. The localized one where the course
    /// gives the pose, else the autopilot's estimate.
    pub attitude: DQuat,
    /// Angular velocity. [rad/s, body]
    pub omega_body_radps: DVec3,
    /// Position and attitude as localized; `None` where the course withholds them
    /// ([`ArenaInfo::ground_truth`](crate::ArenaInfo::ground_truth)). [m, world]
    pub world_from_body: Option<Pose<World, Body>>,
    /// Velocity; `None` where `world_from_body` is. [m/s, world]
    pub v_world_mps: Option<DVec3>,
}

/// One reading of the autopilot's accelerometer and gyroscope.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ImuSample {
    /// When it was measured. [host]
    pub stamp: HostTime,
    /// Specific force: at rest and level, +9.8 along z. [m/s^2, body]
    pub accel_mps2: DVec3,
    /// Angular velocity. [rad/s, body]
    pub gyro_radps: DVec3,
}

/// The battery, as the autopilot measures it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Battery {
    /// What is left, 0 to 1; `None` if the autopilot does not know.
    pub fraction: Option<f64>,
    /// Voltage; `None` if it is not measured. [V]
    pub voltage_v: Option<f64>,
}

/// One camera's RGB-D image. Row-major; row 0 is the top.
#[derive(Clone, Copy, Debug)]
pub struct CameraImage<'a> {
    /// The camera's name in `arena.toml`: `front`.
    pub name: &'a str,
    /// Tick of the server that made the image; equal for all cameras of a tick.
    pub seq: u64,
    /// When the newest pose behind the image was measured: its age counts from here. [host]
    pub stamp: HostTime,
    /// The instant that the image shows: the server moves the pose on to when the image is seen, so
    /// this is about now. Where depth is to meet the vehicle's pose, take the pose of this instant.
    /// [host]
    pub shown: HostTime,
    /// When the runtime had the decoded image. [host]
    pub ready: HostTime,
    /// Width. [px]
    pub width_px: u32,
    /// Height. [px]
    pub height_px: u32,
    /// Colour, H x W x 3, sRGB.
    pub rgb: &'a [u8],
    /// Camera-z depth, H x W; 0 is no return. [mm, cam]
    pub depth_mm: &'a [u16],
    /// Focal lengths and principal point. [px]
    pub intrinsics: Intrinsics,
    /// Extrinsics.
    pub body_from_cam: Pose<Body, Cam>,
    /// Where the body was at the instant that the image shows: what the image was rendered from. `None` where the
    /// course withholds the pose. [m, world]
    pub pose_at_image: Option<Pose<World, Body>>,
}

impl<'a> Observation<'a> {
    /// Reads an observation in place. `names` are the cameras' in the order of their index; a
    /// camera beyond them is called by its number only.
    ///
    /// # Errors
    /// If the bytes are cut short, not aligned to 8, of another protocol version, or name a plane
    /// outside themselves.
    pub fn from_bytes(bytes: &'a [u8], names: &'a [Name]) -> Result<Self, InvalidObservation> {
        let header = ObservationHeader::parse(bytes)?;
        Ok(Self { header, bytes, names, imu_after: HostTime::ZERO })
    }

    /// Leaves those IMU samples out that are not younger than `stamp`: the reader has had them.
    pub fn with_imu_after(self, stamp: HostTime) -> Self {
        Self { imu_after: stamp, ..self }
    }

    pub(crate) fn header(&self) -> &'a ObservationHeader {
        self.header
    }

    /// Returns the memory it lies in, in the layout of [`ObservationHeader`].
    pub fn as_bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// Returns the observation's number in this flight; numbers missing were skipped.
    pub fn seq(&self) -> u64 {
        self.header.seq
    }

    /// Returns when the newest image's pose was measured, or the vehicle's state if there is no
    /// image. [host]
    pub fn stamp(&self) -> HostTime {
        self.cameras()
            .map(|camera| camera.stamp)
            .max()
            .unwrap_or(HostTime::from_ns(self.header.vehicle_ns))
    }

    /// Returns where the body was at the instant that the newest image shows: the pose that belongs to its pixels.
    /// `None` without an image, and where the course withholds the pose. [m, world]
    pub fn pose_at_image(&self) -> Option<Pose<World, Body>> {
        self.cameras().max_by_key(|camera| camera.shown)?.pose_at_image
    }

    /// Returns the image of the camera of this name; `None` if there is no such camera or it has
    /// no image yet.
    pub fn camera(&self, name: &str) -> Option<CameraImage<'a>> {
        self.cameras().find(|camera| camera.name == name)
    }

    /// Returns the images there are, in the order of the arena's cameras.
    pub fn cameras(&self) -> impl Iterator<Item = CameraImage<'a>> + use<'a> {
        let (bytes, names) = (self.bytes, self.names);
        self.header.cameras[..self.header.camera_count.into()]
            .iter()
            .enumerate()
            .filter_map(move |(index, camera)| image(bytes, names.get(index), camera))
    }

    /// Returns what is known of the vehicle; `None` before anything is.
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

    /// Returns the IMU samples since the image that the plugin got before this one, oldest first;
    /// at most the newest 64 (0.6 s at 100 Hz).
    pub fn imu(&self) -> impl Iterator<Item = ImuSample> + use<'a> {
        let after_ns = self.imu_after.as_ns();
        self.header.imu().iter().filter(move |record| record.stamp_ns > after_ns).map(sample)
    }

    /// Returns when the newest IMU sample was measured, had before or not. [host]
    pub fn newest_imu(&self) -> Option<HostTime> {
        self.header.imu().last().map(|record| HostTime::from_ns(record.stamp_ns))
    }

    /// Returns the battery's state.
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
    /// Returns the camera-z depth at column `x_px`, row `y_px`; `None` where there is no return
    /// or outside the image. [m, cam]
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
