//! Table of all sent and received topics. The program creates its topics from it, and `docs/guides/ros2.md` lists it.

use crate::messages::{
    CameraInfo, CompressedImage, Empty, Image, Imu, Message, Odometry, Path, PointCloud2,
    PoseStamped, TfMessage, TwistStamped,
};

/// A topic's quality of service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Qos {
    /// `SensorDataQoS`: best effort, volatile, keep last 5. With `--reliable` it is reliable, as REP 2003 recommends
    /// for drivers, so that both kinds of subscribers match.
    SensorData,
    /// As `SensorData` for large messages, keep last 2: queued messages soon become old, and later messages wait for
    /// them.
    Bulk,
    /// The default of ROS 2: reliable, volatile, keep last 10.
    Default,
    /// `DynamicBroadcasterQoS` of tf2: reliable, volatile, keep last 100.
    Tf,
    /// `StaticBroadcasterQoS` of tf2: reliable, transient local, keep last 1.
    TfStatic,
    /// Commands, of which only the newest counts: best effort, volatile, keep last 1. Publishers of both kinds match.
    Command,
}

impl Qos {
    /// Returns a description in words.
    pub fn words(self) -> &'static str {
        match self {
            Self::SensorData => "best effort, volatile, 5",
            Self::Bulk => "best effort, volatile, 2",
            Self::Default => "reliable, volatile, 10",
            Self::Tf => "reliable, volatile, 100",
            Self::TfStatic => "reliable, transient local, 1",
            Self::Command => "best effort, volatile, 1",
        }
    }
}

/// A ROS 2 topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Topic {
    /// Name, under the node's namespace unless it begins with a slash. `CAMERA` and `SENSOR` stand for names in
    /// `arena.toml`.
    pub name: &'static str,
    /// ROS name of the message type.
    pub ty: &'static str,
    /// Quality of service.
    pub qos: Qos,
    /// Frame of its header, without prefix; for received topics, the accepted frames.
    pub frame: &'static str,
    /// Description for the guide.
    pub what: &'static str,
}

impl Topic {
    const fn new<M: Message>(
        name: &'static str,
        qos: Qos,
        frame: &'static str,
        what: &'static str,
    ) -> Self {
        Self { name, ty: M::TYPE, qos, frame, what }
    }

    /// Returns the ROS name in this namespace, for the camera or sensor `of`.
    pub fn ros_name(&self, namespace: &str, of: &str) -> String {
        let name = self.name.replace("CAMERA", of).replace("SENSOR", of);
        if name.starts_with('/') { name } else { format!("/{namespace}/{name}") }
    }

    /// Returns the DDS name of the type: `sensor_msgs::msg::dds_::Image_`.
    pub fn dds_type(&self) -> String {
        let (package, name) = self.ty.split_once("/msg/").unwrap_or((self.ty, ""));
        format!("{package}::msg::dds_::{name}_")
    }
}

/// Colour images.
pub const IMAGE: Topic =
    Topic::new::<Image>("CAMERA/image_raw", Qos::Bulk, OPTICAL, "colour, `rgb8`");
/// Colour images as JPEG.
pub const COMPRESSED: Topic = Topic::new::<CompressedImage>(
    "CAMERA/image_raw/compressed",
    Qos::SensorData,
    OPTICAL,
    "colour, `jpeg`, of the decoded image",
);
/// Calibration of colour images.
pub const CAMERA_INFO: Topic = Topic::new::<CameraInfo>(
    "CAMERA/camera_info",
    Qos::SensorData,
    OPTICAL,
    "intrinsics and lens of the colour image",
);
/// Depth images.
pub const DEPTH: Topic = Topic::new::<Image>(
    "CAMERA/depth/image_raw",
    Qos::Bulk,
    OPTICAL,
    "depth along the optical axis: `32FC1` [m], no return is NaN; or `16UC1` [mm], no return is 0",
);
/// Calibration of depth images.
pub const DEPTH_INFO: Topic = Topic::new::<CameraInfo>(
    "CAMERA/depth/camera_info",
    Qos::SensorData,
    OPTICAL,
    "intrinsics and lens of the depth image",
);
/// Depth as points.
pub const DEPTH_POINTS: Topic = Topic::new::<PointCloud2>(
    "CAMERA/depth/points",
    Qos::Bulk,
    OPTICAL,
    "one point per pixel: x, y, z [m], rgb",
);
/// Sweeps of a LiDAR.
pub const LIDAR: Topic = Topic::new::<PointCloud2>(
    "SENSOR/points",
    Qos::Bulk,
    "`SENSOR`",
    "sweep of a LiDAR: x, y, z [m], before_ns, intensity, ring",
);
/// IMU of the autopilot.
pub const IMU: Topic = Topic::new::<Imu>(
    "imu",
    Qos::SensorData,
    "`base_link`",
    "IMU of the autopilot, including gravity (REP 145)",
);
/// Pose of the vehicle.
pub const POSE: Topic =
    Topic::new::<PoseStamped>("pose", Qos::Default, "`map`", "pose from localization");
/// Pose and velocity of the vehicle.
pub const ODOMETRY: Topic = Topic::new::<Odometry>(
    "odom",
    Qos::Default,
    "`odom`, twist in `base_link`",
    "pose and velocity",
);
/// Moving transforms.
pub const TF: Topic = Topic::new::<TfMessage>(
    "/tf",
    Qos::Tf,
    "`odom`, `base_link`",
    "`base_link` at the instant of each image, and `base_stabilized`",
);
/// Fixed transforms.
pub const TF_STATIC: Topic = Topic::new::<TfMessage>(
    "/tf_static",
    Qos::TfStatic,
    "`map`, `base_link`",
    "`odom`, cameras, sensors",
);
/// Velocity command.
pub const VELOCITY: Topic = Topic::new::<TwistStamped>(
    "cmd_vel",
    Qos::Command,
    "`map`, `odom`, `base_stabilized`, `base_link`",
    "velocity [m/s] and rate of turn about z [rad/s], for 0.5 s; then the vehicle hovers",
);
/// Path command.
pub const PATH: Topic = Topic::new::<Path>(
    "path",
    Qos::Default,
    "`map`, `odom`, `base_stabilized`, `base_link`",
    "path of at most 32 points, flown once at `--path-speed`, nose forward",
);
/// Landing command, which ends a flight.
pub const LAND: Topic = Topic::new::<Empty>(
    "land",
    Qos::Default,
    "",
    "lands at the current position, which ends the flight",
);

const OPTICAL: &str = "`CAMERA_optical_frame`";

/// Sent topics.
pub const SENT: [Topic; 12] = [
    IMAGE,
    COMPRESSED,
    CAMERA_INFO,
    DEPTH,
    DEPTH_INFO,
    DEPTH_POINTS,
    LIDAR,
    IMU,
    POSE,
    ODOMETRY,
    TF,
    TF_STATIC,
];
/// Received topics.
pub const RECEIVED: [Topic; 3] = [VELOCITY, PATH, LAND];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_types_match_ros() {
        assert_eq!(DEPTH.ros_name("vizflyt", "front"), "/vizflyt/front/depth/image_raw");
        assert_eq!(TF.ros_name("vizflyt", ""), "/tf");
        assert_eq!(IMAGE.dds_type(), "sensor_msgs::msg::dds_::Image_");
    }

    #[test]
    fn guide_lists_every_topic() {
        let guide = include_str!("../../../docs/guides/ros2.md");
        let rows: Vec<_> = guide.lines().filter(|line| line.starts_with("| `")).collect();
        for topic in SENT.iter().chain(&RECEIVED) {
            let Topic { name, ty, qos, frame, what } = topic;
            let row = format!("| `{name}` | {ty} | {} | {frame} | {what} |", qos.words());
            assert!(rows.contains(&&*row), "docs/guides/ros2.md lacks\n{row}");
        }
        let topics = rows.iter().filter(|row| row.contains("/msg/")).count();
        assert_eq!(topics, SENT.len() + RECEIVED.len(), "the guide lists unknown topics");
    }
}
