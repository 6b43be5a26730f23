//! What a plugin sees: typed views of shared memory, without a copy.

use glam::DVec3;
use vizflyt_protocol::geometry::{Body, Cam, Intrinsics, Pose, World};
use vizflyt_protocol::messages::Name;
use vizflyt_protocol::packet::{CameraHeader, InvalidObservation, ObservationHeader};
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
}

/// The vehicle's state as localized, if the course lets plugins know it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Vehicle {
    /// When this was true. [host]
    pub stamp: HostTime,
    /// Position and attitude. [m, world]
    pub world_from_body: Pose<World, Body>,
    /// Velocity. [m/s, world]
    pub v_world_mps: DVec3,
    /// Angular velocity. [rad/s, body]
    pub omega_body_radps: DVec3,
    /// Battery left, 0 to 1; `None` if unknown.
    pub battery_fraction: Option<f64>,
}

/// One camera's RGB-D image. Row-major; row 0 is the top.
#[derive(Clone, Copy, Debug)]
pub struct CameraImage<'a> {
    /// The camera's name in `arena.toml`: `front`.
    pub name: &'a str,
    /// Tick of the server that made the image; equal for all cameras of a tick.
    pub seq: u64,
    /// When the pose that the image shows was measured. [host]
    pub stamp: HostTime,
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
        Ok(Self { header, bytes, names })
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

    /// Returns the vehicle's state; `None` where the course withholds it or none is known yet.
    pub fn vehicle(&self) -> Option<Vehicle> {
        let header = self.header;
        Some(Vehicle {
            world_from_body: header.world_from_body()?,
            stamp: HostTime::from_ns(header.vehicle_ns),
            v_world_mps: DVec3::from(header.velocity_mps),
            omega_body_radps: DVec3::from(header.angular_radps),
            battery_fraction: (header.battery_fraction >= 0.0).then_some(header.battery_fraction),
        })
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
        ready: HostTime::from_ns(camera.ready_ns),
        width_px: camera.width_px,
        height_px: camera.height_px,
        rgb: bytes.get(rgb_at..rgb_at + 3 * pixels)?,
        depth_mm: <[u16]>::ref_from_bytes(bytes.get(depth_at..depth_at + 2 * pixels)?).ok()?,
        intrinsics: camera.intrinsics(),
        body_from_cam: camera.body_from_cam(),
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
