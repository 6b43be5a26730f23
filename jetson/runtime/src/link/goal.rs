//! What a flight wants of the autopilot.

/// The state that the link is to reach.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Goal {
    /// Watch only: heartbeats, telemetry, origin and external navigation.
    #[default]
    Prepare,
    /// GUIDED, armed, and risen by this much above the ground. [m]
    TakeOff(f32),
    /// Stay in GUIDED and follow setpoints.
    Fly,
    /// LAND mode, until disarmed. Never given up.
    Land,
}
