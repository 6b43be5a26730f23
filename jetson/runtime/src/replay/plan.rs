//! Schedule of a replay, read from the log before the plugin starts, without the images.
//!
//! In flight, the plugin skips images that arrive while it is busy, and receives events between images. A
//! replay repeats this: it feeds the images with a reply, each after the messages that the plugin had
//! received before it entered `on_image`. After the last reply it feeds all images, because the plugin may
//! have crashed or hung on one of them.

use std::collections::{BTreeMap, VecDeque};
use std::io::Read;

use vizflyt_protocol::PROTOCOL_VERSION;
use vizflyt_protocol::messages::{FromPlugin, Setpoint, ToPlugin};
use vizflyt_protocol::packet::framing::decode_body;
use vizflyt_protocol::time::HostTime;

use super::ReplayError;
use crate::log::PluginMessage;
use crate::log::read::{Recorded, RecordedFlight};

/// Reply of the plugin in flight.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct RecordedReply {
    pub(super) seq: u64,
    pub(super) entered: HostTime,
    pub(super) setpoint: Option<Setpoint>,
}

/// Command line of the plugin in the flight.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FlownPlugin {
    /// PLUGIN argument of `vizflyt fly`.
    pub plugin: String,
    /// Arguments after `--`.
    pub arguments: Vec<String>,
}

/// Schedule of the inputs of a plugin in a replay.
#[derive(Debug, Default)]
pub struct ReplayPlan {
    /// Plugin of the flight, if the log names it.
    pub flown: Option<FlownPlugin>,
    /// Observations in the log.
    pub observations: u64,
    /// Observations without images, in a reduced log.
    pub without_images: u64,
    /// Whether the log is truncated or damaged.
    pub is_cut: bool,
    /// Messages to the plugin, with their send times. [host]
    pub(super) messages: VecDeque<(HostTime, ToPlugin)>,
    /// Replies by image number; after a restart of the plugin, numbers can occur again.
    replies: BTreeMap<u64, VecDeque<RecordedReply>>,
    last_entered: HostTime,
}

/// Action for an observation.
#[derive(Clone, Debug, PartialEq)]
#[allow(clippy::large_enum_variant)] // Why: only one exists at a time.
pub(super) enum FeedAction {
    /// Skip it, as the plugin did in flight.
    Skip,
    /// Feed it after the messages sent before this time. Contains the reply in flight, if any.
    After(HostTime, Option<RecordedReply>),
}

impl ReplayPlan {
    /// Reads the schedule from a log.
    ///
    /// # Errors
    /// If the log cannot be read, has another protocol version, or contains no images.
    pub fn read<R: Read>(mut flight: RecordedFlight<R>) -> Result<Self, ReplayError> {
        let mut plan = Self::default();
        let mut program = None;
        while let Some(recorded) = flight.next()? {
            match recorded {
                Recorded::Flight(values) => {
                    // Checked first, because the layout of other records depends on it.
                    program = values.get("program").cloned();
                    let protocol = values.get("protocol").and_then(|text| text.parse().ok());
                    protocol
                        .map_or(Ok(()), |protocol| same_protocol(protocol, program.as_deref()))?;
                    plan.flown = flown(&values);
                }
                Recorded::Plugin(message) => {
                    same_protocol(message.protocol, program.as_deref())?;
                    plan.message(&message);
                }
                Recorded::Observation(observation) => {
                    same_protocol(observation.protocol, program.as_deref())?;
                    plan.observations += 1;
                    plan.without_images += u64::from(observation.images.is_empty());
                }
                Recorded::Broken(_) => plan.observations += 1,
            }
        }
        plan.is_cut = flight.is_cut();
        if plan.observations == plan.without_images {
            return Err(ReplayError::NoImages);
        }
        if !plan.messages.iter().any(|(_, message)| matches!(message, ToPlugin::Start(_))) {
            return Err(ReplayError::NoStart);
        }
        Ok(plan)
    }

    fn message(&mut self, message: &PluginMessage) {
        if message.is_to_plugin {
            // Skips a damaged message; the rest of the log is still useful.
            if let Ok(decoded) = decode_body(&message.body) {
                self.messages.push_back((HostTime::from_ns(message.at_ns), decoded));
            }
        } else if let Ok(FromPlugin::Reply { seq, entered, setpoint, .. }) =
            decode_body(&message.body)
        {
            self.last_entered = self.last_entered.max(entered);
            self.replies.entry(seq).or_default().push_back(RecordedReply {
                seq,
                entered,
                setpoint,
            });
        }
    }

    /// Returns the action for observation `seq`, published at `published`; `all` also feeds observations
    /// that the plugin skipped.
    pub(super) fn feed(&mut self, seq: u64, published: HostTime, all: bool) -> FeedAction {
        let replies = self.replies.get_mut(&seq);
        let reply = replies.and_then(|replies| {
            // Earlier replies belong to a previous plugin process.
            while replies.front().is_some_and(|reply| reply.entered < published) {
                replies.pop_front();
            }
            replies.pop_front()
        });
        match reply {
            Some(reply) => FeedAction::After(reply.entered, Some(reply)),
            None if all || published > self.last_entered => FeedAction::After(published, None),
            None => FeedAction::Skip,
        }
    }

    /// Returns the number of replies to observations that were not fed.
    pub(super) fn unfed(&self) -> u64 {
        self.replies.values().map(|replies| replies.len() as u64).sum()
    }
}

fn same_protocol(found: u32, program: Option<&str>) -> Result<(), ReplayError> {
    if found == u32::from(PROTOCOL_VERSION) {
        return Ok(());
    }
    let program = program.unwrap_or("an unknown program").to_owned();
    Err(ReplayError::Protocol { found, program })
}

fn flown(values: &BTreeMap<String, String>) -> Option<FlownPlugin> {
    let plugin = values.get("plugin")?.clone();
    let arguments = values.get("arguments").and_then(|json| serde_json::from_str(json).ok());
    Some(FlownPlugin { plugin, arguments: arguments.unwrap_or_default() })
}
