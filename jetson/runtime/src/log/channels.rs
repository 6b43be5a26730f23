//! Channels of the log: topics, encodings, schemas.
//!
//! Data with a Foxglove message uses it (protobuf). Other values are JSON. Data that a replay needs
//! bit by bit uses custom protobuf messages ([`super::messages`]).

use foxglove::messages as fox;
use foxglove::{Encode, Schema};
use serde_json::{Value, json};

use super::messages;

/// Channel of the log, with one topic; channels of cameras and sensors have one topic for each of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Channel {
    /// Localized pose: foxglove.PoseInFrame.
    Pose,
    /// Pose of body in world and of cameras in body: foxglove.FrameTransform.
    Transform,
    /// Localized velocity, and age of the pose.
    Motion,
    /// Pose of the body from which an image was rendered, at the image's instant: foxglove.PoseInFrame.
    PoseAtImage,
    /// The autopilot's accelerometer and gyroscope.
    Imu,
    /// Odometry estimate of the plugin: foxglove.PoseInFrame.
    Odometry,
    /// Setpoint requested by the plugin.
    Requested,
    /// Setpoint sent by the guard.
    Sent,
    /// Events of server and runtime: foxglove.Log.
    Event,
    /// Periodic report of the runtime.
    Telemetry,
    /// Lines printed by the plugin: foxglove.Log.
    PluginOutput,
    /// Stamps of each image at the stages of its processing.
    Image,
    /// Contributions of the stages to the image age, over the last seconds.
    Timing,
    /// Status of the log itself.
    Log,
    /// Observations as sent through shared memory to the plugin, images as encoded, colour separate.
    Observation,
    /// Messages to and from the plugin, unchanged.
    Plugin,
    /// Colour of a camera as encoded: foxglove.CompressedImage.
    Color(u8),
    /// Calibration of a camera: foxglove.CameraCalibration.
    Calibration(u8),
    /// Stamps of a camera's images.
    Stamps(u8),
    /// Depth of a camera for viewers, if requested: foxglove.RawImage.
    Depth(u8),
    /// Points of a LiDAR or a radar: foxglove.PointCloud.
    Points(u8),
    /// Range of a range finder or a sonar: foxglove.LaserScan.
    Range(u8),
}

/// Description of a channel in a file or for a viewer.
#[derive(Clone, Debug)]
pub(super) struct Description {
    pub(super) topic: String,
    /// Encoding of messages: `json` or `protobuf`.
    pub(super) encoding: &'static str,
    pub(super) schema: Schema,
}

impl Channel {
    /// Channels of every log. Channels of cameras are added with their first image.
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

    /// Returns the topic; `camera` is the name of the channel's camera or sensor.
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

    /// Returns name and properties of a JSON channel's messages, for viewers.
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
