//! Custom protobuf messages of the log, from which a replay reproduces a plugin's inputs bit by bit.
//!
//! Field numbers never change their meaning; new fields get new numbers.

use foxglove::Schema;
use prost::Message;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet};

/// One observation as sent to the plugin.
#[derive(Clone, PartialEq, Message)]
pub struct Observation {
    /// Number of the observation in this flight.
    #[prost(uint64, tag = "1")]
    pub seq: u64,
    /// Protocol version of `head`.
    #[prost(uint32, tag = "2")]
    pub protocol: u32,
    /// Time of publication. [ns, host]
    #[prost(uint64, tag = "3")]
    pub published_ns: u64,
    /// Shared memory up to the first image plane, which begins with `ObservationHeader`.
    #[prost(bytes = "vec", tag = "4")]
    pub head: Vec<u8>,
    /// Images; empty if a reduced log has omitted them.
    #[prost(message, repeated, tag = "5")]
    pub images: Vec<ObservedImage>,
    /// Table of sensors: consecutive `SensorHeader`s.
    #[prost(bytes = "vec", tag = "6")]
    pub sensors: Vec<u8>,
    /// Records of the sensors that have a reading.
    #[prost(message, repeated, tag = "7")]
    pub records: Vec<ObservedRecords>,
}

/// Records of one sensor's newest reading.
#[derive(Clone, PartialEq, Message)]
pub struct ObservedRecords {
    /// Index of the sensor.
    #[prost(uint32, tag = "1")]
    pub sensor: u32,
    /// Name of the sensor.
    #[prost(string, tag = "2")]
    pub name: String,
    /// Whether the records are in the newest message on `/sensor/NAME` instead of `bytes`.
    #[prost(bool, tag = "3")]
    pub is_apart: bool,
    /// Records as in shared memory; empty if `is_apart`.
    #[prost(bytes = "vec", tag = "4")]
    pub bytes: Vec<u8>,
}

/// One camera's image of an observation.
#[derive(Clone, PartialEq, Message)]
pub struct ObservedImage {
    /// Index of the camera.
    #[prost(uint32, tag = "1")]
    pub camera: u32,
    /// Name of the camera.
    #[prost(string, tag = "2")]
    pub name: String,
    /// `ImageHeader` as received.
    #[prost(bytes = "vec", tag = "3")]
    pub header: Vec<u8>,
    /// Arrival time of the last byte. [ns, host]
    #[prost(uint64, tag = "4")]
    pub received_ns: u64,
    /// RGB-D bitstream as received; without colour if `is_color_apart`.
    #[prost(bytes = "vec", tag = "5")]
    pub bitstream: Vec<u8>,
    /// Whether the colour is in the message of the same log time on `/camera/NAME/image`.
    #[prost(bool, tag = "6")]
    pub is_color_apart: bool,
    /// Measurement time of the newest pose used for the image. [ns, host]
    #[prost(uint64, tag = "7")]
    pub pose_ns: u64,
    /// Instant that the image shows. [ns, host]
    #[prost(uint64, tag = "8")]
    pub shown_ns: u64,
}

/// A message between runtime and plugin.
#[derive(Clone, PartialEq, Message)]
pub struct PluginMessage {
    /// Direction: `true` from the runtime to the plugin, `false` from the plugin.
    #[prost(bool, tag = "1")]
    pub is_to_plugin: bool,
    /// Protocol version of `body`.
    #[prost(uint32, tag = "2")]
    pub protocol: u32,
    /// `ToPlugin` or `FromPlugin`, as sent through the socket (postcard).
    #[prost(bytes = "vec", tag = "3")]
    pub body: Vec<u8>,
    /// Time of sending to the plugin or of receiving from it. [ns, host]
    #[prost(uint64, tag = "4")]
    pub at_ns: u64,
}

/// Returns the schema of the message `name`, for readers of other programs.
pub(super) fn schema(name: &str) -> Schema {
    let field = |name: &str, number, kind: Type| FieldDescriptorProto {
        name: Some(name.into()),
        number: Some(number),
        label: Some(Label::Optional.into()),
        r#type: Some(kind.into()),
        ..FieldDescriptorProto::default()
    };
    let images = FieldDescriptorProto {
        label: Some(Label::Repeated.into()),
        type_name: Some(".vizflyt.ObservedImage".into()),
        ..field("images", 5, Type::Message)
    };
    let records = FieldDescriptorProto {
        label: Some(Label::Repeated.into()),
        type_name: Some(".vizflyt.ObservedRecords".into()),
        ..field("records", 7, Type::Message)
    };
    let message = |name: &str, field: Vec<FieldDescriptorProto>| DescriptorProto {
        name: Some(name.into()),
        field,
        ..DescriptorProto::default()
    };
    let file = FileDescriptorProto {
        name: Some("vizflyt.proto".into()),
        package: Some("vizflyt".into()),
        syntax: Some("proto3".into()),
        message_type: vec![
            message(
                "Observation",
                vec![
                    field("seq", 1, Type::Uint64),
                    field("protocol", 2, Type::Uint32),
                    field("published_ns", 3, Type::Uint64),
                    field("head", 4, Type::Bytes),
                    images,
                    field("sensors", 6, Type::Bytes),
                    records,
                ],
            ),
            message(
                "ObservedRecords",
                vec![
                    field("sensor", 1, Type::Uint32),
                    field("name", 2, Type::String),
                    field("is_apart", 3, Type::Bool),
                    field("bytes", 4, Type::Bytes),
                ],
            ),
            message(
                "ObservedImage",
                vec![
                    field("camera", 1, Type::Uint32),
                    field("name", 2, Type::String),
                    field("header", 3, Type::Bytes),
                    field("received_ns", 4, Type::Uint64),
                    field("bitstream", 5, Type::Bytes),
                    field("is_color_apart", 6, Type::Bool),
                    field("pose_ns", 7, Type::Uint64),
                    field("shown_ns", 8, Type::Uint64),
                ],
            ),
            message(
                "PluginMessage",
                vec![
                    field("is_to_plugin", 1, Type::Bool),
                    field("protocol", 2, Type::Uint32),
                    field("body", 3, Type::Bytes),
                    field("at_ns", 4, Type::Uint64),
                ],
            ),
        ],
        ..FileDescriptorProto::default()
    };
    let set = FileDescriptorSet { file: vec![file] };
    Schema::new(format!("vizflyt.{name}"), "protobuf", set.encode_to_vec())
}
