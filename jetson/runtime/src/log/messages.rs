//! Messages of our own in the log, as protobuf: what replay feeds a plugin, bit by bit.
//!
//! A field's number is its meaning for ever; new ones go at the end.

use foxglove::Schema;
use prost::Message;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet};

/// One observation as it went to the plugin.
#[derive(Clone, PartialEq, Message)]
pub struct Observation {
    /// Its number in this flight.
    #[prost(uint64, tag = "1")]
    pub seq: u64,
    /// The protocol version of `head`.
    #[prost(uint32, tag = "2")]
    pub protocol: u32,
    /// When it was published. [ns, host]
    #[prost(uint64, tag = "3")]
    pub published_ns: u64,
    /// Shared memory up to the first image plane: `ObservationHeader` and what belongs to it.
    #[prost(bytes = "vec", tag = "4")]
    pub head: Vec<u8>,
    /// Its images; none where a reduced log left them out.
    #[prost(message, repeated, tag = "5")]
    pub images: Vec<ObservedImage>,
    /// The table of its sensors: one `SensorHeader` after the other.
    #[prost(bytes = "vec", tag = "6")]
    pub sensors: Vec<u8>,
    /// Their records, of those that have a reading.
    #[prost(message, repeated, tag = "7")]
    pub records: Vec<ObservedRecords>,
}

/// The records of one sensor's newest reading.
#[derive(Clone, PartialEq, Message)]
pub struct ObservedRecords {
    /// Index of the sensor.
    #[prost(uint32, tag = "1")]
    pub sensor: u32,
    /// Its name.
    #[prost(string, tag = "2")]
    pub name: String,
    /// They are those of the newest message on `/sensor/NAME`.
    #[prost(bool, tag = "3")]
    pub is_apart: bool,
    /// As in shared memory; none if they are apart.
    #[prost(bytes = "vec", tag = "4")]
    pub bytes: Vec<u8>,
}

/// One camera's image of an observation.
#[derive(Clone, PartialEq, Message)]
pub struct ObservedImage {
    /// Index of the camera.
    #[prost(uint32, tag = "1")]
    pub camera: u32,
    /// Its name.
    #[prost(string, tag = "2")]
    pub name: String,
    /// `ImageHeader` as received.
    #[prost(bytes = "vec", tag = "3")]
    pub header: Vec<u8>,
    /// When its last byte had come. [ns, host]
    #[prost(uint64, tag = "4")]
    pub received_ns: u64,
    /// The RGB-D bitstream as received; without its colour if that is apart.
    #[prost(bytes = "vec", tag = "5")]
    pub bitstream: Vec<u8>,
    /// The colour is the camera's `/camera/NAME/image` of the same log time.
    #[prost(bool, tag = "6")]
    pub is_color_apart: bool,
    /// When the newest pose behind it was measured. [ns, host]
    #[prost(uint64, tag = "7")]
    pub pose_ns: u64,
    /// The instant that it shows. [ns, host]
    #[prost(uint64, tag = "8")]
    pub shown_ns: u64,
}

/// A message between runtime and plugin.
#[derive(Clone, PartialEq, Message)]
pub struct PluginMessage {
    /// From the runtime to the plugin; else the other way.
    #[prost(bool, tag = "1")]
    pub is_to_plugin: bool,
    /// The protocol version of `body`.
    #[prost(uint32, tag = "2")]
    pub protocol: u32,
    /// `ToPlugin` or `FromPlugin`, as it went through shared memory (postcard).
    #[prost(bytes = "vec", tag = "3")]
    pub body: Vec<u8>,
    /// When it was sent to the plugin or taken from it. [ns, host]
    #[prost(uint64, tag = "4")]
    pub at_ns: u64,
}

/// Returns the schema of the message `name` for other people's readers.
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
