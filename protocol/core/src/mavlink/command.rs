//! Names of commands and results, for messages.

use super::dialect::{MavCmd, MavResult};

/// Returns the name of a command's action.
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

/// Returns the name of a command's result.
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
