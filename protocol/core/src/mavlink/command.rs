//! ArduCopter's modes, and commands and results in words.

use super::dialect::{MavCmd, MavResult};

/// Flight modes of ArduCopter that we name; the number is HEARTBEAT's `custom_mode`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum CopterMode {
    /// Manual attitude.
    Stabilize = 0,
    /// Manual attitude, altitude held.
    AltHold = 2,
    /// Flies what a companion computer asks.
    Guided = 4,
    /// Position held, sticks move it.
    Loiter = 5,
    /// Returns to the launch point; dangerous in a room, it climbs first.
    Rtl = 6,
    /// Comes down here.
    Land = 9,
    /// Stops at once.
    Brake = 17,
}

impl CopterMode {
    /// Returns the mode of a `custom_mode` number, if we name it.
    pub fn from_number(number: u32) -> Option<Self> {
        use CopterMode::{AltHold, Brake, Guided, Land, Loiter, Rtl, Stabilize};
        [Stabilize, AltHold, Guided, Loiter, Rtl, Land, Brake]
            .into_iter()
            .find(|&mode| mode as u32 == number)
    }
}

/// Returns what a command does, in words.
pub fn command_name(command: MavCmd) -> &'static str {
    match command {
        MavCmd::MAV_CMD_DO_SET_MODE => "mode change",
        MavCmd::MAV_CMD_COMPONENT_ARM_DISARM => "arming",
        MavCmd::MAV_CMD_NAV_TAKEOFF => "take-off",
        MavCmd::MAV_CMD_NAV_LAND => "landing",
        MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL => "message rate",
        MavCmd::MAV_CMD_REQUEST_MESSAGE => "message request",
        _ => "command",
    }
}

/// Returns a command's result in words.
pub fn result_name(result: MavResult) -> &'static str {
    match result {
        MavResult::MAV_RESULT_ACCEPTED => "accepted",
        MavResult::MAV_RESULT_TEMPORARILY_REJECTED => "refused for now",
        MavResult::MAV_RESULT_DENIED => "denied",
        MavResult::MAV_RESULT_UNSUPPORTED => "not supported",
        MavResult::MAV_RESULT_FAILED => "failed",
        MavResult::MAV_RESULT_IN_PROGRESS => "in progress",
        MavResult::MAV_RESULT_CANCELLED => "cancelled",
        _ => "answered with an unknown result",
    }
}
