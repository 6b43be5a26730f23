//! The replay's schedule: read from the log once, before the plugin starts, without the images.
//!
//! In flight the plugin skips images that come while it works, and receives events in between. A
//! replay repeats that: it feeds the images that were answered, each after the messages that the
//! plugin had received before it entered `on_image`. After the last reply it feeds all images: if the
//! plugin crashed or hung, then on one of those.

use std::collections::{BTreeMap, VecDeque};
use std::io::Read;

use vizflyt_protocol::PROTOCOL_VERSION;
use vizflyt_protocol::messages::{FromPlugin, Setpoint, ToPlugin};
use vizflyt_protocol::packet::framing::decode_body;
use vizflyt_protocol::time::HostTime;

use super::ReplayError;
use crate::log::PluginMessage;
use crate::log::read::{Recorded, RecordedFlight};

/// A reply that the plugin gave in flight.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct RecordedReply {
    pub(super) seq: u64,
    pub(super) entered: HostTime,
    pub(super) setpoint: Option<Setpoint>,
}

/// The plugin that flew, as the person typed it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FlownPlugin {
    /// The PLUGIN of `vizflyt fly`.
    pub plugin: String,
    /// What came after `--`.
    pub arguments: Vec<String>,
}

/// What a replay feeds to the plugin, and when.
#[derive(Debug, Default)]
pub struct ReplayPlan {
    /// The plugin that flew, if the log names it.
    pub flown: Option<FlownPlugin>,
    /// Observations in the log.
    pub observations: u64,
    /// Those of them whose images a reduced log left out.
    pub without_images: u64,
    /// Whether the log ends early.
    pub is_cut: bool,
    /// Messages to the plugin, and when they were sent. [host]
    pub(super) messages: VecDeque<(HostTime, ToPlugin)>,
    /// Replies by image number: numbers may come again when the plugin was restarted.
    replies: BTreeMap<u64, VecDeque<RecordedReply>>,
    last_entered: HostTime,
}

/// What to do with an observation.
#[derive(Clone, Debug, PartialEq)]
#[allow(clippy::large_enum_variant)] // Why: there is one of it at a time.
pub(super) enum FeedAction {
    /// The plugin skipped it.
    Skip,
    /// Feed it after the messages sent before this time; and what the plugin answered, if it did.
    After(HostTime, Option<RecordedReply>),
}

impl ReplayPlan {
    /// Reads it from a log.
    ///
    /// # Errors
    /// If the log cannot be read, is of another protocol version, or holds no images.
    pub fn read<R: Read>(mut flight: RecordedFlight<R>) -> Result<Self, ReplayError> {
        let mut plan = Self::default();
        let mut program = None;
        while let Some(recorded) = flight.next()? {
            match recorded {
                Recorded::Flight(values) => {
                    // Checked before anything is read that may be laid out otherwise.
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
            // One that does not decode is of a damaged file; the rest is still of use.
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

    /// Returns what to do with observation `seq` that was published then; `all` feeds those too
    /// that the plugin skipped.
    pub(super) fn feed(&mut self, seq: u64, published: HostTime, all: bool) -> FeedAction {
        let replies = self.replies.get_mut(&seq);
        let reply = replies.and_then(|replies| {
            // Earlier ones are another plugin process's.
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

    /// Returns how many replies have not been fed.
    pub(super) fn unfed(&self) -> u64 {
        self.replies.values().map(|replies| replies.len() as u64).sum()
    }
}

fn same_protocol(found: u32, program: Option<&str>) -> Result<(), ReplayError> {
    if found == u32::from(PROTOCOL_VERSION) {
        return Ok(());
    }
    let program = program.unwrap_or("a program that it does not name").to_owned();
    Err(ReplayError::Protocol { found, program })
}

fn flown(values: &BTreeMap<String, String>) -> Option<FlownPlugin> {
    let plugin = values.get("plugin")?.clone();
    let arguments = values.get("arguments").and_then(|json| serde_json::from_str(json).ok());
    Some(FlownPlugin { plugin, arguments: arguments.unwrap_or_default() })
}
