//! What is sent and received, in one table: the program makes its topics by it, and `docs/guides/ros2.md` lists it.

use crate::messages::{
    CameraInfo, CompressedImage, Empty, Image, Imu, Message, Odometry, Path, PointCloud2,
    PoseStamped, TfMessage, TwistStamped,
};

/// A topic's quality of service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Qos {
    /// `SensorDataQoS`: best effort, volatile, keep last 5; with `--reliable` reliable instead, as REP 2003 has drivers
    /// send, so that subscribers of both kinds get it.
    SensorData,
    /// The same of what fills a network, keep last 2: messages that wait to be sent are soon old, and what is said behind
    /// them waits for them.
    Bulk,
    /// The default of ROS 2: reliable, volatile, keep last 10.
    Default,
    /// `DynamicBroadcasterQoS` of tf2: reliable, volatile, keep last 100.
    Tf,
    /// `StaticBroadcasterQoS` of tf2: reliable, transient local, keep last 1.
    TfStatic,
    /// Of a command, where the newest alone counts: best effort, volatile, keep last 1; publishers of either kind match.
    Command,
}

impl Qos {
    /// Returns it in words.
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

/// A topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Topic {
    /// Its name, under the node's namespace unless it begins with a slash. `CAMERA` and `SENSOR` stand for the names of
    /// `arena.toml`.
    pub name: &'static str,
    /// Its type.
    pub ty: &'static str,
    /// How it is sent or received.
    pub qos: Qos,
    /// Frame of its header, without a prefix; of what is received the frames that are understood.
    pub frame: &'static str,
    /// What it is.
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

    /// Returns its name in ROS, in this namespace, of the camera or sensor `of`.
    pub fn ros_name(&self, namespace: &str, of: &str) -> String {
        let name = self.name.replace("CAMERA", of).replace("SENSOR", of);
        if name.starts_with('/') { name } else { format!("/{namespace}/{name}") }
    }

    /// Returns its type as DDS knows it: `sensor_msgs::msg::dds_::Image_`.
    pub fn dds_type(&self) -> String {
        let (package, name) = self.ty.split_once("/msg/").unwrap_or((self.ty, ""));
        format!("{package}::msg::dds_::{name}_")
    }
}

/// Colour.
pub const IMAGE: Topic =
    Topic::new::<Image>("CAMERA/image_raw", Qos::Bulk, OPTICAL, "colour, `rgb8`");
/// Colour as JPEG.
pub const COMPRESSED: Topic = Topic::new::<CompressedImage>(
    "CAMERA/image_raw/compressed",
    Qos::SensorData,
    OPTICAL,
    "colour, `jpeg`, of the decoded image",
);
/// How colour was rendered.
pub const CAMERA_INFO: Topic = Topic::new::<CameraInfo>(
    "CAMERA/camera_info",
    Qos::SensorData,
    OPTICAL,
    "intrinsics and lens of this very image",
);
/// Depth.
pub const DEPTH: Topic = Topic::new::<Image>(
    "CAMERA/depth/image_raw",
    Qos::Bulk,
    OPTICAL,
    "depth along the optical axis: `32FC1` [m], no return is NaN; or `16UC1` [mm], no return is 0",
);
/// How depth was rendered.
pub const DEPTH_INFO: Topic = Topic::new::<CameraInfo>(
    "CAMERA/depth/camera_info",
    Qos::SensorData,
    OPTICAL,
    "the same of the depth",
);
/// Depth as points.
pub const DEPTH_POINTS: Topic = Topic::new::<PointCloud2>(
    "CAMERA/depth/points",
    Qos::Bulk,
    OPTICAL,
    "a point a pixel: x, y, z [m], rgb",
);
/// A LiDAR's sweep.
pub const LIDAR: Topic = Topic::new::<PointCloud2>(
    "SENSOR/points",
    Qos::Bulk,
    "`SENSOR`",
    "a LiDAR's sweep: x, y, z [m], before_ns, intensity, ring",
);
/// The autopilot's inertial sensor.
pub const IMU: Topic = Topic::new::<Imu>(
    "imu",
    Qos::SensorData,
    "`base_link`",
    "the autopilot's, with gravity in it (REP 145)",
);
/// Where the vehicle is.
pub const POSE: Topic =
    Topic::new::<PoseStamped>("pose", Qos::Default, "`map`", "where it was localized");
/// The same with its motion.
pub const ODOMETRY: Topic = Topic::new::<Odometry>(
    "odom",
    Qos::Default,
    "`odom`, twist in `base_link`",
    "the same with its motion",
);
/// Where frames are.
pub const TF: Topic = Topic::new::<TfMessage>(
    "/tf",
    Qos::Tf,
    "`odom`, `base_link`",
    "`base_link` at the instant of each image, and `base_stabilized`",
);
/// Where frames are that stay.
pub const TF_STATIC: Topic = Topic::new::<TfMessage>(
    "/tf_static",
    Qos::TfStatic,
    "`map`, `base_link`",
    "`odom`, cameras, sensors",
);
/// A velocity to fly at.
pub const VELOCITY: Topic = Topic::new::<TwistStamped>(
    "cmd_vel",
    Qos::Command,
    "`map`, `odom`, `base_stabilized`, `base_link`",
    "a velocity [m/s] and a turn about z [rad/s]; for 0.5 s, then the vehicle hovers",
);
/// A path to follow.
pub const PATH: Topic = Topic::new::<Path>(
    "path",
    Qos::Default,
    "`map`, `odom`, `base_stabilized`, `base_link`",
    "a path of at most 32 points, flown once at `--path-speed`, nose ahead",
);
/// The end of a flight.
pub const LAND: Topic =
    Topic::new::<Empty>("land", Qos::Default, "", "comes down here, which ends the flight");

const OPTICAL: &str = "`CAMERA_optical_frame`";

/// What is sent.
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
/// What is received.
pub const RECEIVED: [Topic; 3] = [VELOCITY, PATH, LAND];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_types_are_those_of_ros() {
        assert_eq!(DEPTH.ros_name("vizflyt", "front"), "/vizflyt/front/depth/image_raw");
        assert_eq!(TF.ros_name("vizflyt", ""), "/tf");
        assert_eq!(IMAGE.dds_type(), "sensor_msgs::msg::dds_::Image_");
    }

    #[test]
    fn the_guide_lists_every_topic_as_it_is() {
        let guide = include_str!("../../../docs/guides/ros2.md");
        let rows: Vec<_> = guide.lines().filter(|line| line.starts_with("| `")).collect();
        for topic in SENT.iter().chain(&RECEIVED) {
            let Topic { name, ty, qos, frame, what } = topic;
            let row = format!("| `{name}` | {ty} | {} | {frame} | {what} |", qos.words());
            assert!(rows.contains(&&*row), "docs/guides/ros2.md lacks\n{row}");
        }
        let topics = rows.iter().filter(|row| row.contains("/msg/")).count();
        assert_eq!(topics, SENT.len() + RECEIVED.len(), "the guide lists others besides");
    }
}
