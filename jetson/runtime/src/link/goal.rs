//! Goal of the link.

/// State that the link must reach.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Goal {
    /// Only watch: heartbeats, telemetry, origin and external navigation.
    #[default]
    Prepare,
    /// GUIDED, armed, and this height above the ground reached. [m]
    TakeOff(f32),
    /// Stay in GUIDED and follow setpoints.
    Fly,
    /// LAND mode, until disarmed. Retried without limit.
    Land,
}
