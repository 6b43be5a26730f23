//! The only module that uses DDS: a participant with a writer for each sent topic and a reader for each received topic.
//!
//! Uses only RustDDS. It needs neither ROS nor C for the build, a company maintains it, it is Apache-2.0, and it sends
//! an image as fragments (DATA_FRAG) without blocking the writer. Alternatives: `ros2-client` adds nodes, services and
//! an executor that does not fit into a plugin, on the same RustDDS; `dust_dds` derives types for each message, but 1
//! MB should be passed as bytes; Cyclone's bindings (`cyclonedds-rs`) have no licence and build C; Zenoh needs a bridge
//! or `rmw_zenoh` on the other side.

use std::collections::HashMap;
use std::convert::Infallible;
use std::net::IpAddr;

use anyhow::{Result, anyhow};
use bytes::Bytes;
use rustdds::dds::adapters::no_key as adapters;
use rustdds::no_key::{DataWriter, SimpleDataReader};
use rustdds::policy::{Durability, History, Reliability, ResourceLimits};
use rustdds::{
    DataWriterStatus, DomainParticipant, DomainParticipantBuilder, Publisher, QosPolicies,
    QosPolicyBuilder, RepresentationIdentifier, StatusEvented, Subscriber, Timestamp, TopicKind,
};

use crate::cdr::{CdrError, Reader};
use crate::messages::{Message, Received};
use crate::topics::{Qos, Topic};

/// A participant in a domain.
pub(crate) struct Dds {
    /// By ROS name.
    writers: HashMap<String, Writer>,
    publisher: Publisher,
    subscriber: Subscriber,
    participant: DomainParticipant,
    namespace: String,
    reliable: bool,
}

struct Writer {
    writer: DataWriter<Bytes, Raw>,
    /// Number of matched subscribers.
    matched: i32,
}

/// A reader of one topic.
pub(crate) struct Inbox {
    /// ROS name of the topic.
    pub(crate) name: String,
    reader: SimpleDataReader<Payload, Raw>,
}

/// Bytes of a received message.
#[derive(Clone, Debug)]
pub(crate) struct Payload {
    bytes: Vec<u8>,
    little: bool,
}

impl Dds {
    /// Joins a domain. `interfaces` are the addresses to use; empty means all.
    pub(crate) fn join(
        domain: u16,
        interfaces: &[IpAddr],
        namespace: &str,
        reliable: bool,
    ) -> Result<Self> {
        let mut builder = DomainParticipantBuilder::new(domain);
        if !interfaces.is_empty() {
            builder = builder.with_only_networks(interfaces.iter().copied());
        }
        let failed = |error| {
            anyhow!(
                "cannot join DDS domain {domain}: {error:?}; check ROS_DOMAIN_ID and the network interface"
            )
        };
        let participant = builder.build().map_err(failed)?;
        let qos = QosPolicyBuilder::new().build();
        let publisher = participant.create_publisher(&qos).map_err(failed)?;
        let subscriber = participant.create_subscriber(&qos).map_err(failed)?;
        let (namespace, writers) = (namespace.to_owned(), HashMap::new());
        Ok(Self { writers, publisher, subscriber, participant, namespace, reliable })
    }

    fn topic(&self, topic: &Topic, name: &str) -> Result<(rustdds::Topic, QosPolicies)> {
        let qos = policies(topic.qos, self.reliable);
        let made = self
            .participant
            .create_topic(format!("rt{name}"), topic.dds_type(), &qos, TopicKind::NoKey)
            .map_err(|error| anyhow!("{name}: {error:?}"))?;
        Ok((made, qos))
    }

    /// Announces a topic of the camera or sensor `of`, so that its subscribers are known before the first message.
    pub(crate) fn announce(&mut self, topic: &Topic, of: &str) -> Result<()> {
        let name = topic.ros_name(&self.namespace, of);
        if self.writers.contains_key(&name) {
            return Ok(());
        }
        let (made, qos) = self.topic(topic, &name)?;
        let writer = self
            .publisher
            .create_datawriter_no_key::<Bytes, Raw>(&made, Some(qos))
            .map_err(|error| anyhow!("{name}: {error:?}"))?;
        self.writers.insert(name, Writer { writer, matched: 0 });
        Ok(())
    }

    /// Withdraws all sent topics.
    pub(crate) fn withdraw(&mut self) {
        self.writers.clear();
    }

    /// Updates the number of subscribers; called between images.
    pub(crate) fn count_subscribers(&mut self) {
        for (name, writer) in &mut self.writers {
            while let Some(status) = writer.writer.try_recv_status() {
                match status {
                    DataWriterStatus::PublicationMatched { current, .. } => {
                        writer.matched = current.count();
                    }
                    DataWriterStatus::OfferedIncompatibleQos { last_policy_id, .. } => {
                        tracing::warn!(
                            "{name}: a subscriber requests an incompatible quality of service \
                             ({last_policy_id:?}) and receives nothing: docs/guides/ros2.md"
                        );
                    }
                    _ => {}
                }
            }
        }
    }

    /// Returns whether an announced topic has a subscriber.
    pub(crate) fn is_wanted(&self, topic: &Topic, of: &str) -> bool {
        let name = topic.ros_name(&self.namespace, of);
        self.writers.get(&name).is_some_and(|writer| writer.matched > 0)
    }

    /// Sends a message on an announced topic. Without subscribers it is not encoded, except for topics that DDS keeps
    /// for late subscribers.
    pub(crate) fn send<M: Message>(&self, topic: &Topic, of: &str, message: &M) {
        if topic.qos == Qos::TfStatic || self.is_wanted(topic, of) {
            self.send_encoded(topic, of, message.encode());
        }
    }

    /// Sends an encoded message.
    pub(crate) fn send_encoded(&self, topic: &Topic, of: &str, message: Vec<u8>) {
        let name = topic.ros_name(&self.namespace, of);
        let Some(writer) = self.writers.get(&name) else { return };
        if let Err(error) = writer.writer.write(message.into(), Some(Timestamp::now())) {
            tracing::debug!("{name}: {error:?}");
        }
    }

    /// Subscribes to a topic.
    pub(crate) fn subscribe(&self, topic: &Topic) -> Result<Inbox> {
        let name = topic.ros_name(&self.namespace, "");
        let (made, qos) = self.topic(topic, &name)?;
        let reader = self
            .subscriber
            .create_simple_datareader_no_key::<Payload, Raw>(&made, Some(qos))
            .map_err(|error| anyhow!("{name}: {error:?}"))?;
        Ok(Inbox { name, reader })
    }
}

impl Inbox {
    /// Returns the next message and the time since its arrival [ns]; `None` if the inbox is empty. Bytes that do not
    /// decode are an error.
    pub(crate) fn next<M: Received>(&self) -> Option<Result<(M, u64), CdrError>> {
        self.reader.drain_read_notifications();
        let change = self.reader.try_take_one().ok().flatten()?;
        let ticks = Timestamp::now().to_ticks().saturating_sub(change.receive_instant.to_ticks());
        // A tick is 2^-32 s.
        let age_ns = (u128::from(ticks) * 1_000_000_000) >> 32;
        let payload = change.sample;
        let message = M::read(&mut Reader::new(&payload.bytes, payload.little));
        Some(message.map(|message| (message, age_ns as u64)))
    }
}

fn policies(qos: Qos, reliable: bool) -> QosPolicies {
    let is_reliable = match qos {
        Qos::SensorData | Qos::Bulk => reliable,
        Qos::Command => false,
        Qos::Default | Qos::Tf | Qos::TfStatic => true,
    };
    let depth = match qos {
        Qos::SensorData => 5,
        Qos::Bulk => 2,
        Qos::Default => 10,
        Qos::Tf => 100,
        Qos::TfStatic | Qos::Command => 1,
    };
    let durability =
        if qos == Qos::TfStatic { Durability::TransientLocal } else { Durability::Volatile };
    let builder =
        QosPolicyBuilder::new().durability(durability).history(History::KeepLast { depth });
    if !is_reliable {
        return builder.reliability(Reliability::BestEffort).build();
    }
    let wait = if qos == Qos::Bulk { 0 } else { 100 };
    let max_blocking_time = rustdds::Duration::from_millis(wait);
    let builder = builder.reliability(Reliability::Reliable { max_blocking_time });
    if qos == Qos::Bulk {
        builder.resource_limits(MOST_UNACKNOWLEDGED).build()
    } else {
        builder.build()
    }
}

/// Limits the queue of reliable image topics. RustDDS keeps all messages that a reliable subscriber has not
/// acknowledged, for any history depth: up to 8,192 images of a stopped subscriber. With this limit it drops new images
/// without waiting, until that subscriber times out.
const MOST_UNACKNOWLEDGED: ResourceLimits =
    ResourceLimits { max_samples: 32, max_instances: 1, max_samples_per_instance: 32 };

/// Passes bytes unchanged; `cdr` does the encoding.
struct Raw;

impl adapters::SerializerAdapter<Bytes> for Raw {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(value: &Bytes) -> Result<Bytes, Infallible> {
        Ok(value.clone())
    }
}

impl adapters::DeserializerAdapter<Payload> for Raw {
    type Error = Infallible;
    type Decoded = Payload;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &[RepresentationIdentifier::CDR_LE, RepresentationIdentifier::CDR_BE]
    }

    fn transform_decoded(decoded: Payload) -> Payload {
        decoded
    }
}

impl adapters::DefaultDecoder<Payload> for Raw {
    type Decoder = RawDecoder;
    const DECODER: RawDecoder = RawDecoder;
}

#[derive(Clone)]
struct RawDecoder;

impl<'de> adapters::Decode<'de, Payload> for RawDecoder {
    type Error = Infallible;

    fn decode_bytes(
        self,
        input_bytes: &'de [u8],
        encoding: RepresentationIdentifier,
    ) -> Result<Payload, Infallible> {
        let little = encoding == RepresentationIdentifier::CDR_LE;
        Ok(Payload { bytes: input_bytes.to_vec(), little })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn image_queue_is_short_and_never_blocks() {
        let best_effort = policies(Qos::Bulk, false);
        assert_eq!(best_effort.history(), Some(History::KeepLast { depth: 2 }));
        let reliable = policies(Qos::Bulk, true);
        assert_eq!(reliable.resource_limits(), Some(MOST_UNACKNOWLEDGED));
        let at_once = rustdds::Duration::from_millis(0);
        assert_eq!(reliable.reliable_max_blocking_time(), Some(at_once));
    }
}
