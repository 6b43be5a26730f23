//! How a flight ended.

use serde::{Deserialize, Serialize};

/// How a flight ended, and why.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Outcome {
    /// How.
    pub kind: OutcomeKind,
    /// Why, in one sentence.
    pub reason: String,
}

/// The ways a flight ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OutcomeKind {
    /// The goal was reached.
    Finished,
    /// The vehicle touched an obstacle of the twin.
    Collided,
    /// The vehicle left the fence.
    Geofence,
    /// Time was up.
    Timeout,
    /// The plugin or a person landed it, or the time that a person asked for was over.
    Landed,
    /// The plugin crashed, hung or gave up.
    PluginFailed,
    /// Something else failed: link, localization, server.
    Error,
}

impl Outcome {
    /// Whether the flight ended as wished: at the goal, or landed on purpose.
    pub fn is_good(&self) -> bool {
        matches!(self.kind, OutcomeKind::Finished | OutcomeKind::Landed)
    }
}

impl OutcomeKind {
    /// Returns the name as it stands in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Finished => "finished",
            Self::Collided => "collided",
            Self::Geofence => "geofence",
            Self::Timeout => "timeout",
            Self::Landed => "landed",
            Self::PluginFailed => "plugin_failed",
            Self::Error => "error",
        }
    }
}
