//! How a flight ended.

use serde::{Deserialize, Serialize};
use vizflyt_protocol::messages::OutcomeKind;

/// How a flight ended, and why.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Outcome {
    /// How.
    pub kind: OutcomeKind,
    /// Why, in one sentence.
    pub reason: String,
}

impl Outcome {
    /// Whether the flight ended as wished: at the goal, or landed on purpose.
    pub fn is_good(&self) -> bool {
        matches!(self.kind, OutcomeKind::Finished | OutcomeKind::Landed)
    }
}
