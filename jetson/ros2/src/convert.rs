//! Converts observations to ROS 2 messages. Pure: an observation and a clock in, messages out.
//!
//! World and body are ROS's `map` and `base_link` (REP 103, REP 105: x forward or east, y left or north, z up), and
//! `cam` is an optical frame (z forward, x right, y down), so no rotation is necessary.

use std::borrow::Cow;

use vizflyt_sdk::glam::{DQuat, DVec2, DVec3};
use vizflyt_sdk::protocol::geometry::{Distortion, Frame, yaw_of};
use vizflyt_sdk::{Body, HostTime, ImuSample, Intrinsics, LidarPoint, Pose, Vehicle, World};
use zerocopy::IntoBytes;

use crate::messages::{
    CameraInfo, FLOAT32, Header, Image, Imu, Odometry, PointCloud2, PointField, PoseStamped, Time,
    TransformStamped, UINT16, UINT32,
};

/// Names of the frames, each with the prefix.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frames {
    prefix: String,
    /// The world.
    pub map: String,
    /// Identical to `map`, because localization does not drift.
    pub odom: String,
    /// The body.
    pub base_link: String,
    /// The levelled body: x along the heading, z up.
    pub base_stabilized: String,
}

impl Frames {
    /// Creates the names with a prefix, for example `drone1/` for one vehicle of several.
    pub fn new(prefix: &str) -> Self {
        let named = |name: &str| format!("{prefix}{name}");
        Self {
            prefix: prefix.to_owned(),
            map: named("map"),
            odom: named("odom"),
            base_link: named("base_link"),
            base_stabilized: named("base_stabilized"),
        }
    }

    /// Returns the frame of a camera.
    pub fn optical(&self, camera: &str) -> String {
        format!("{}{camera}_optical_frame", self.prefix)
    }

    /// Returns the frame of a sensor.
    pub fn sensor(&self, sensor: &str) -> String {
        format!("{}{sensor}", self.prefix)
    }
}

/// Converts this computer's monotonic clock to time since 1970, which ROS 2 uses for stamps.
#[derive(Clone, Copy, Debug, Default)]
pub struct RosClock {
    offset_ns: i64,
}

impl RosClock {
    /// Smaller differences of the calendar clock are ignored, so that stamps stay regular. [ns]
    const STEP_NS: i64 = 5_000_000;

    /// Stores the difference of both clocks at one moment. [ns since 1970; host]
    pub fn relate(&mut self, unix_ns: i64, host: HostTime) {
        let offset_ns = unix_ns - host.as_ns() as i64;
        if (offset_ns - self.offset_ns).abs() > Self::STEP_NS {
            self.offset_ns = offset_ns;
        }
    }

    /// Returns the stamp of an instant.
    pub fn time(&self, host: HostTime) -> Time {
        Time::from_ns(host.as_ns() as i64 + self.offset_ns)
    }
}

/// Encoding of depth (REP 118).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum DepthEncoding {
    /// Metres as 32-bit floats; NaN means no return
    #[default]
    #[value(name = "32fc1")]
    Metres,
    /// Millimetres as 16-bit integers; 0 means no return
    #[value(name = "16uc1")]
    Millimetres,
}

/// Returns a colour image.
pub fn image<'a>(header: Header, intrinsics: &Intrinsics, rgb: &'a [u8]) -> Image<'a> {
    let (width, height) = (intrinsics.width_px, intrinsics.height_px);
    Image { header, height, width, encoding: "rgb8", step: 3 * width, data: Cow::Borrowed(rgb) }
}

/// Returns a depth image. Assumes a little-endian computer, as all supported ones are.
pub fn depth<'a>(
    header: Header,
    intrinsics: &Intrinsics,
    depth_mm: &'a [u16],
    encoding: DepthEncoding,
) -> Image<'a> {
    let (width, height) = (intrinsics.width_px, intrinsics.height_px);
    let (encoding, pixel, data) = match encoding {
        DepthEncoding::Metres => {
            let metres = depth_mm.iter().flat_map(|&mm| metres(mm).to_le_bytes()).collect();
            ("32FC1", 4, Cow::Owned(metres))
        }
        DepthEncoding::Millimetres => ("16UC1", 2, Cow::Borrowed(depth_mm.as_bytes())),
    };
    Image { header, height, width, encoding, step: pixel * width, data }
}

/// Returns depth in metres; NaN without a return.
fn metres(depth_mm: u16) -> f32 {
    if depth_mm == 0 { f32::NAN } else { f32::from(depth_mm) / 1000.0 }
}

/// Returns the calibration of an image.
pub fn camera_info(header: Header, intrinsics: &Intrinsics) -> CameraInfo {
    let k = intrinsics;
    // ROS and OpenCV put the centre of the first pixel at 0, VizFlyt its corner.
    let (cx, cy) = (k.cx_px - 0.5, k.cy_px - 0.5);
    let coefficients = k.distortion.to_wire().1;
    let (distortion_model, d) = match k.distortion {
        Distortion::None | Distortion::BrownConrady { .. } => ("plumb_bob", coefficients.to_vec()),
        Distortion::KannalaBrandt { .. } => ("equidistant", coefficients[..4].to_vec()),
    };
    CameraInfo {
        header,
        height: k.height_px,
        width: k.width_px,
        distortion_model,
        d,
        k: [k.fx_px, 0.0, cx, 0.0, k.fy_px, cy, 0.0, 0.0, 1.0],
        p: [k.fx_px, 0.0, cx, 0.0, 0.0, k.fy_px, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }
}

/// Directions of a camera's pixels: `(x / z, y / z)`, NaN outside the lens's image. Cached between images.
#[derive(Debug, Default)]
pub struct Rays {
    of: Option<Intrinsics>,
    slopes: Vec<[f32; 2]>,
}

impl Rays {
    fn of(&mut self, intrinsics: &Intrinsics) -> &[[f32; 2]] {
        if self.of.as_ref() != Some(intrinsics) {
            let pixels = (0..intrinsics.height_px).flat_map(|y| {
                (0..intrinsics.width_px).map(move |x| DVec2::new(x.into(), y.into()))
            });
            let slope = |pixel: DVec2| intrinsics.slope(pixel + 0.5).unwrap_or(DVec2::NAN);
            self.slopes = pixels.map(|pixel| slope(pixel).as_vec2().to_array()).collect();
            self.of = Some(*intrinsics);
        }
        &self.slopes
    }
}

const DEPTH_FIELDS: &[PointField] =
    &[("x", 0, FLOAT32), ("y", 4, FLOAT32), ("z", 8, FLOAT32), ("rgb", 12, FLOAT32)];

/// Returns an image's depth as points in its optical frame, one for each pixel; NaN without a return.
pub fn depth_points<'a>(
    header: Header,
    intrinsics: &Intrinsics,
    rays: &mut Rays,
    rgb: &[u8],
    depth_mm: &[u16],
) -> PointCloud2<'a> {
    let slopes = rays.of(intrinsics);
    let mut data = Vec::with_capacity(16 * slopes.len());
    for ((&[x, y], &mm), color) in slopes.iter().zip(depth_mm).zip(rgb.chunks_exact(3)) {
        let z_m = metres(mm);
        for value in [x * z_m, y * z_m, z_m] {
            data.extend_from_slice(&value.to_le_bytes());
        }
        // PCL's packing: blue is the lowest byte.
        data.extend_from_slice(&[color[2], color[1], color[0], 0]);
    }
    PointCloud2 {
        header,
        height: intrinsics.height_px,
        width: intrinsics.width_px,
        fields: DEPTH_FIELDS,
        point_step: 16,
        data: Cow::Owned(data),
        is_dense: false,
    }
}

const LIDAR_FIELDS: &[PointField] = &[
    ("x", 0, FLOAT32),
    ("y", 4, FLOAT32),
    ("z", 8, FLOAT32),
    ("before_ns", 12, UINT32),
    ("intensity", 16, UINT16),
    ("ring", 18, UINT16),
];

/// Returns a LiDAR's sweep in the sensor's frame.
pub fn lidar_points(header: Header, points: &[LidarPoint]) -> PointCloud2<'_> {
    PointCloud2 {
        header,
        height: 1,
        width: points.len() as u32,
        fields: LIDAR_FIELDS,
        point_step: size_of::<LidarPoint>() as u32,
        data: Cow::Borrowed(points.as_bytes()),
        is_dense: true,
    }
}

/// Returns an inertial sensor's reading.
pub fn imu(clock: RosClock, frames: &Frames, sample: &ImuSample) -> Imu {
    Imu {
        header: Header { stamp: clock.time(sample.stamp), frame_id: frames.base_link.clone() },
        angular_velocity: sample.gyro_radps,
        linear_acceleration: sample.accel_mps2,
    }
}

/// Returns pose and odometry of a vehicle; `None` if the course withholds them.
pub fn pose_and_odometry(
    clock: RosClock,
    frames: &Frames,
    vehicle: &Vehicle,
) -> Option<(PoseStamped, Odometry)> {
    let (pose, v_world_mps) = (vehicle.world_from_body?, vehicle.v_world_mps?);
    let stamp = clock.time(vehicle.stamp);
    let (position, orientation) = (pose.translation_m, pose.rotation);
    let header = Header { stamp, frame_id: frames.map.clone() };
    let odometry = Odometry {
        header: Header { stamp, frame_id: frames.odom.clone() },
        child_frame_id: frames.base_link.clone(),
        position,
        orientation,
        linear: orientation.inverse() * v_world_mps,
        angular: vehicle.omega_body_radps,
    };
    Some((PoseStamped { header, position, orientation }, odometry))
}

fn transform(
    stamp: Time,
    parent: &str,
    child: String,
    translation: DVec3,
    rotation: DQuat,
) -> TransformStamped {
    let header = Header { stamp, frame_id: parent.to_owned() };
    TransformStamped { header, child_frame_id: child, translation, rotation }
}

/// Returns the transforms of the body and of the levelled body.
pub fn moving(stamp: Time, frames: &Frames, pose: &Pose<World, Body>) -> [TransformStamped; 2] {
    let levelled = DQuat::from_rotation_z(yaw_of(pose.rotation));
    let body_from_levelled = pose.rotation.inverse() * levelled;
    let (base, stabilized) = (&frames.base_link, &frames.base_stabilized);
    [
        transform(stamp, &frames.odom, base.clone(), pose.translation_m, pose.rotation),
        transform(stamp, base, stabilized.clone(), DVec3::ZERO, body_from_levelled),
    ]
}

/// Returns the transform of a camera or sensor in the body.
pub fn mounted<F: Frame>(
    stamp: Time,
    frames: &Frames,
    child: String,
    mounting: &Pose<Body, F>,
) -> TransformStamped {
    transform(stamp, &frames.base_link, child, mounting.translation_m, mounting.rotation)
}

/// Returns the transform of `odom` in `map`: the identity.
pub fn odom_in_map(stamp: Time, frames: &Frames) -> TransformStamped {
    transform(stamp, &frames.map, frames.odom.clone(), DVec3::ZERO, DQuat::IDENTITY)
}

/// Returns the header of an image.
pub fn optical_header(stamp: Time, frames: &Frames, camera: &str) -> Header {
    Header { stamp, frame_id: frames.optical(camera) }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use vizflyt_sdk::protocol::geometry::body_from_forward_cam;

    use super::*;

    fn intrinsics() -> Intrinsics {
        Intrinsics::from_horizontal_fov(4, 2, FRAC_PI_2)
    }

    #[test]
    fn depth_is_metres_or_millimetres() {
        let (camera, depth_mm) = (intrinsics(), [0, 1500, 1, 65535, 2, 3, 4, 5]);
        let metres = depth(Header::default(), &camera, &depth_mm, DepthEncoding::Metres);
        assert_eq!((metres.encoding, metres.step, metres.data.len()), ("32FC1", 16, 32));
        let value = |at: usize| f32::from_le_bytes(metres.data[4 * at..][..4].try_into().unwrap());
        assert!(value(0).is_nan());
        assert_eq!((value(1), value(3)), (1.5, 65.535));
        let raw = depth(Header::default(), &camera, &depth_mm, DepthEncoding::Millimetres);
        assert_eq!((raw.encoding, raw.step), ("16UC1", 8));
        assert_eq!(raw.data[2..4], 1500u16.to_le_bytes());
    }

    #[test]
    fn camera_info_counts_from_pixel_centres() {
        let info = camera_info(Header::default(), &intrinsics());
        // 90 degrees over 4 pixels: f = 2; the middle lies between the second and the third pixel.
        for (found, expected) in [(info.k[0], 2.0), (info.k[2], 1.5), (info.k[5], 0.5)] {
            assert!((found - expected).abs() < 1e-12, "{found} is not {expected}");
        }
        assert_eq!((info.distortion_model, info.d.len()), ("plumb_bob", 5));
        let fisheye = Distortion::KannalaBrandt { k1: 0.1, k2: 0.2, k3: 0.3, k4: 0.4 };
        let info =
            camera_info(Header::default(), &Intrinsics { distortion: fisheye, ..intrinsics() });
        assert_eq!((info.distortion_model, info.d), ("equidistant", vec![0.1, 0.2, 0.3, 0.4]));
    }

    #[test]
    fn points_lie_on_the_rays_of_their_pixels() {
        let (camera, mut rays) = (intrinsics(), Rays::default());
        let (rgb, mut depth_mm) = ([7u8; 24], [0u16; 8]);
        depth_mm[3] = 2000;
        let cloud = depth_points(Header::default(), &camera, &mut rays, &rgb, &depth_mm);
        assert_eq!((cloud.height, cloud.width, cloud.data.len()), (2, 4, 16 * 8));
        let value = |at: usize| f32::from_le_bytes(cloud.data[at..at + 4].try_into().unwrap());
        let found = DVec3::new(value(48).into(), value(52).into(), value(56).into());
        let expected = camera.unproject(DVec2::new(3.5, 0.5), 2.0).unwrap();
        assert!((found - expected).length() < 1e-6, "{found} is not {expected}");
        assert!(value(0).is_nan());
    }

    #[test]
    fn optical_frame_points_forward_and_stabilized_frame_is_level() {
        // A camera that points forward: its z is the body's x.
        let (frames, camera) = (Frames::new(""), body_from_forward_cam(DVec3::ZERO, 0.0));
        let fixed = mounted(Time::default(), &frames, frames.optical("front"), &camera);
        assert_eq!(fixed.child_frame_id, "front_optical_frame");
        assert!((fixed.rotation * DVec3::Z - DVec3::X).length() < 1e-12);
        let (yaw, pitch) = (DQuat::from_rotation_z(1.0), DQuat::from_rotation_y(0.3));
        let pose = Pose::new(DVec3::ONE, yaw * pitch);
        let [base, levelled] = moving(Time::default(), &frames, &pose);
        assert_eq!(base.translation, DVec3::ONE);
        let in_map = base.rotation * levelled.rotation;
        assert!((in_map * DVec3::Z - DVec3::Z).length() < 1e-12);
        assert!((in_map * DVec3::X - yaw * DVec3::X).length() < 1e-12);
    }

    #[test]
    fn odometry_twist_is_in_body_axes() {
        let north = DQuat::from_rotation_z(FRAC_PI_2);
        let mut vehicle = Vehicle {
            stamp: HostTime::from_ns(5),
            attitude: north,
            omega_body_radps: DVec3::Z,
            world_from_body: Some(Pose::new(DVec3::X, north)),
            v_world_mps: Some(DVec3::Y * 2.0),
        };
        let (clock, frames) = (RosClock::default(), Frames::new(""));
        let (pose, odometry) = pose_and_odometry(clock, &frames, &vehicle).unwrap();
        assert_eq!((pose.position, &*pose.header.frame_id), (DVec3::X, "map"));
        assert!((odometry.linear - DVec3::X * 2.0).length() < 1e-12, "{}", odometry.linear);
        vehicle.world_from_body = None;
        assert_eq!(pose_and_odometry(clock, &frames, &vehicle), None);
    }

    #[test]
    fn stamps_stay_regular_until_the_calendar_clock_steps() {
        let mut clock = RosClock::default();
        clock.relate(1_000_000_000_000, HostTime::from_ns(100));
        assert_eq!(clock.time(HostTime::from_ns(100)).sec, 1000);
        clock.relate(1_000_001_000_000, HostTime::from_ns(100));
        assert_eq!(clock.time(HostTime::from_ns(100)).nanosec, 0);
        clock.relate(2_000_000_000_000, HostTime::from_ns(100));
        assert_eq!(clock.time(HostTime::from_ns(100)).sec, 2000);
    }
}
