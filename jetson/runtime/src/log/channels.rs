//! What is logged: topics, encodings, schemas.
//!
//! What Foxglove knows a message for is logged as that (protobuf); our own figures are JSON; and
//! what replay needs bit by bit is protobuf of our own ([`super::messages`]).

use foxglove::messages as fox;
use foxglove::{Encode, Schema};
use serde_json::{Value, json};

use super::messages;

/// What is logged; each has its topic, the cameras' and sensors' have one for each of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Channel {
    /// Localized pose: foxglove.PoseInFrame.
    Pose,
    /// Pose of body in world and of cameras in body: foxglove.FrameTransform.
    Transform,
    /// Localized velocity and the pose's age.
    Motion,
    /// Where an image was rendered from, at the instant that it shows: foxglove.PoseInFrame.
    PoseAtImage,
    /// The autopilot's accelerometer and gyroscope.
    Imu,
    /// Where the plugin thinks it is: foxglove.PoseInFrame.
    Odometry,
    /// What the plugin asked for.
    Requested,
    /// What the guard sent on.
    Sent,
    /// Events of server and runtime: foxglove.Log.
    Event,
    /// The runtime's regular report.
    Telemetry,
    /// Lines the plugin printed: foxglove.Log.
    PluginOutput,
    /// Stamps of each image on its way.
    Image,
    /// Where images get their age, over the last seconds.
    Timing,
    /// How the log itself fares.
    Log,
    /// What went through shared memory to the plugin, images as encoded, colour apart.
    Observation,
    /// Messages to and from the plugin, as they were.
    Plugin,
    /// Colour of a camera as encoded: foxglove.CompressedImage.
    Color(u8),
    /// How a camera's images are rendered: foxglove.CameraCalibration.
    Calibration(u8),
    /// Each instant of a camera's image.
    Stamps(u8),
    /// A camera's depth for viewers, if it is wanted: foxglove.RawImage.
    Depth(u8),
    /// What a LiDAR or a radar sees: foxglove.PointCloud.
    Points(u8),
    /// What a range finder or a sonar measures: foxglove.LaserScan.
    Range(u8),
}

/// How a channel presents itself in a file or to a viewer.
#[derive(Clone, Debug)]
pub(super) struct Description {
    pub(super) topic: String,
    /// Of messages: `json` or `protobuf`.
    pub(super) encoding: &'static str,
    pub(super) schema: Schema,
}

impl Channel {
    /// Those that every log has; cameras come when their first image does.
    pub(super) const FIXED: [Self; 16] = [
        Self::Pose,
        Self::Transform,
        Self::Motion,
        Self::PoseAtImage,
        Self::Imu,
        Self::Odometry,
        Self::Requested,
        Self::Sent,
        Self::Event,
        Self::Telemetry,
        Self::PluginOutput,
        Self::Image,
        Self::Timing,
        Self::Log,
        Self::Observation,
        Self::Plugin,
    ];

    /// Returns the topic; `camera` is the name of the camera or sensor whose channel it is.
    pub(super) fn topic(self, camera: &str) -> String {
        match self {
            Self::Pose => "/pose".into(),
            Self::Transform => "/tf".into(),
            Self::Motion => "/motion".into(),
            Self::PoseAtImage => "/pose_at_image".into(),
            Self::Imu => "/imu".into(),
            Self::Odometry => "/odometry".into(),
            Self::Requested => "/setpoint/asked".into(),
            Self::Sent => "/setpoint/sent".into(),
            Self::Event => "/event".into(),
            Self::Telemetry => "/telemetry".into(),
            Self::PluginOutput => "/plugin/output".into(),
            Self::Image => "/image/timing".into(),
            Self::Timing => "/timing".into(),
            Self::Log => "/log".into(),
            Self::Observation => "/observation".into(),
            Self::Plugin => "/plugin/messages".into(),
            Self::Color(_) => format!("/camera/{camera}/image"),
            Self::Calibration(_) => format!("/camera/{camera}/calibration"),
            Self::Stamps(_) => format!("/camera/{camera}/stamps"),
            Self::Depth(_) => format!("/camera/{camera}/depth"),
            Self::Points(_) | Self::Range(_) => format!("/sensor/{camera}"),
        }
    }

    /// Returns how the channel presents itself.
    pub(super) fn describe(self, camera: &str) -> Description {
        let topic = self.topic(camera);
        let foxglove = match self {
            Self::Pose | Self::PoseAtImage | Self::Odometry => fox::PoseInFrame::get_schema(),
            Self::Transform => fox::FrameTransform::get_schema(),
            Self::Event | Self::PluginOutput => fox::Log::get_schema(),
            Self::Color(_) => fox::CompressedImage::get_schema(),
            Self::Calibration(_) => fox::CameraCalibration::get_schema(),
            Self::Depth(_) => fox::RawImage::get_schema(),
            Self::Points(_) => fox::PointCloud::get_schema(),
            Self::Range(_) => fox::LaserScan::get_schema(),
            Self::Observation => Some(messages::schema("Observation")),
            Self::Plugin => Some(messages::schema("PluginMessage")),
            _ => None,
        };
        if let Some(schema) = foxglove {
            return Description { topic, encoding: "protobuf", schema };
        }
        let (name, properties) = self.json_schema();
        let schema = json!({"type": "object", "title": name, "properties": properties});
        let schema = Schema::new(name, "jsonschema", schema.to_string().into_bytes());
        Description { topic, encoding: "json", schema }
    }

    /// Name and properties of a JSON channel's messages, as far as viewers use them.
    fn json_schema(self) -> (&'static str, Value) {
        let number = json!({"type": "number"});
        let text = json!({"type": "string"});
        let vector = json!({"type": "array", "items": {"type": "number"}});
        match self {
            Self::Motion => {
                let properties = json!({"stamp_ns": number, "v_world_mps": vector,
                    "omega_body_radps": vector, "position_sigma_m": vector,
                    "rotation_sigma_rad": vector, "age_ms": number});
                ("vizflyt.Motion", properties)
            }
            Self::Imu => {
                let properties =
                    json!({"stamp_ns": number, "accel_mps2": vector, "gyro_radps": vector});
                ("vizflyt.Imu", properties)
            }
            Self::Stamps(_) => {
                let properties = json!({"seq": number, "shown_ns": number, "pose_ns": number, "received_ns": number});
                ("vizflyt.ImageStamps", properties)
            }
            Self::Requested => ("vizflyt.Setpoint", json!({"seq": number, "setpoint": {}})),
            Self::Sent => {
                let properties =
                    json!({"v_world_mps": vector, "yaw_rad": number, "yaw_rate_radps": number});
                ("vizflyt.GuidedSetpoint", properties)
            }
            Self::Telemetry => {
                let properties = json!({"phase": text, "vehicle": {"type": "object"},
                    "images": {"type": "object"}, "setpoint": {}});
                ("vizflyt.Telemetry", properties)
            }
            Self::Image => {
                let properties = json!({"seq": number, "pose_ns": number, "received_ns": number,
                    "ready_ns": number, "entered_ns": number, "returned_ns": number,
                    "age_ms": number});
                ("vizflyt.ImageTiming", properties)
            }
            Self::Log => {
                let properties = json!({"written_bytes": number, "dropped_images": number,
                    "dropped_records": number, "left_out_images": number, "free_bytes": number, "text": text});
                ("vizflyt.Log", properties)
            }
            _ => {
                let properties = json!({"seconds": number, "waterfall": {"type": "object"},
                    "intervals": {"type": "object"}, "clock": {}, "cameras": {"type": "array"}});
                ("vizflyt.Timing", properties)
            }
        }
    }
}
