//! Sends one command at a time: repeats it with a growing confirmation count until it is acknowledged, retries it after
//! a rejection, and finally gives up.

use vizflyt_protocol::mavlink::dialect::{MavCmd, MavResult};
use vizflyt_protocol::mavlink::{CopterMode, command_name, result_name};
use vizflyt_protocol::time::HostTime;

/// Whether a retry is useless.
pub(super) fn is_final(result: MavResult) -> bool {
    matches!(result, MavResult::MAV_RESULT_UNSUPPORTED)
}

/// A command to the autopilot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Command {
    Mode(CopterMode),
    Arm,
    /// Height above the ground. [m]
    TakeOff(f32),
    Land,
    /// Id of a message and its period. [us]
    Interval(u32, f32),
    /// Id of a message to request once.
    Message(u32),
}

impl Command {
    pub(super) fn name(self) -> &'static str {
        command_name(self.mavlink())
    }

    /// Whether the flight continues without it.
    pub(super) fn is_chore(self) -> bool {
        matches!(self, Self::Interval(..) | Self::Message(_))
    }

    pub(super) fn mavlink(self) -> MavCmd {
        match self {
            Self::Mode(_) => MavCmd::MAV_CMD_DO_SET_MODE,
            Self::Arm => MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
            Self::TakeOff(_) => MavCmd::MAV_CMD_NAV_TAKEOFF,
            Self::Land => MavCmd::MAV_CMD_NAV_LAND,
            Self::Interval(..) => MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
            Self::Message(_) => MavCmd::MAV_CMD_REQUEST_MESSAGE,
        }
    }
}

/// Retry policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Patience {
    Bounded,
    Endless,
}

/// Result of an acknowledgement or a timeout.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum CommandOutcome {
    Pending,
    Accepted(Command),
    GivenUp { command: Command, why: String },
}

/// Timeout of an acknowledgement, after which the command is sent again. ArduCopter replies within 20 ms; a Wi-Fi
/// bridge adds up to 100. [s]
const REPEAT_S: f64 = 0.4;
/// Maximum number of transmissions without a reply: 2 s.
const REPEATS: u8 = 5;
/// Delay from a rejection to the next attempt. [s]
const RETRY_S: f64 = 1.0;
/// Maximum number of rejections. Pre-arm checks may need some seconds to pass.
const REFUSALS: u8 = 8;

/// Command in progress.
#[derive(Clone, Debug, Default)]
pub(super) struct Commands {
    pending: Option<Pending>,
    /// Commands started since the last acceptance.
    tries: u32,
}

#[derive(Clone, Debug)]
struct Pending {
    command: Command,
    patience: Patience,
    /// Transmissions of one attempt, from 0.
    confirmation: u8,
    refusals: u8,
    last_result: Option<MavResult>,
    due_at: HostTime,
    /// Whether `due_at` is the timeout of an acknowledgement; otherwise it is the time of the next attempt.
    waits: bool,
    /// Given up: reported once, not sent again until the goal changes.
    dead: bool,
}

impl Commands {
    /// Drops the command in progress.
    pub(super) fn abandon(&mut self) {
        *self = Self::default();
    }

    /// Whether the number of commands started is odd.
    pub(super) fn is_odd_try(&self) -> bool {
        self.tries % 2 == 1
    }

    pub(super) fn due_at(&self) -> Option<HostTime> {
        self.pending.as_ref().filter(|pending| !pending.dead).map(|pending| pending.due_at)
    }

    /// Starts or continues `command`. Returns the confirmation count if the command must be sent now.
    pub(super) fn start(
        &mut self,
        now: HostTime,
        command: Command,
        patience: Patience,
    ) -> Option<u8> {
        match &mut self.pending {
            Some(pending) if pending.command == command => {
                if pending.dead || now < pending.due_at {
                    return None;
                }
                if pending.waits {
                    pending.confirmation = pending.confirmation.saturating_add(1);
                } else {
                    pending.confirmation = 0;
                }
                pending.waits = true;
                pending.due_at = now.plus_seconds(REPEAT_S);
                Some(pending.confirmation)
            }
            // Endless commands alternate between two commands: let each reach its timeout.
            Some(pending) if patience == Patience::Endless && now < pending.due_at => None,
            _ => {
                self.tries += 1;
                self.pending = Some(Pending {
                    command,
                    patience,
                    confirmation: 0,
                    refusals: 0,
                    last_result: None,
                    due_at: now.plus_seconds(REPEAT_S),
                    waits: true,
                    dead: false,
                });
                Some(0)
            }
        }
    }

    pub(super) fn handle_ack(
        &mut self,
        now: HostTime,
        id: MavCmd,
        result: MavResult,
    ) -> CommandOutcome {
        let Some(pending) = &mut self.pending else { return CommandOutcome::Pending };
        if pending.command.mavlink() != id || pending.dead || !pending.waits {
            return CommandOutcome::Pending;
        }
        let command = pending.command;
        match result {
            MavResult::MAV_RESULT_ACCEPTED => {
                self.abandon();
                CommandOutcome::Accepted(command)
            }
            MavResult::MAV_RESULT_IN_PROGRESS => {
                pending.due_at = now.plus_seconds(REPEAT_S);
                CommandOutcome::Pending
            }
            refusal => {
                pending.last_result = Some(refusal);
                pending.refusals = pending.refusals.saturating_add(1);
                pending.waits = false;
                pending.due_at = now.plus_seconds(RETRY_S);
                let is_last =
                    is_final(refusal) || pending.command.is_chore() || pending.refusals >= REFUSALS;
                if pending.patience == Patience::Bounded && is_last {
                    return self.give_up();
                }
                CommandOutcome::Pending
            }
        }
    }

    pub(super) fn handle_timeout(&mut self, now: HostTime) -> CommandOutcome {
        let Some(pending) = &self.pending else { return CommandOutcome::Pending };
        let exhausted = pending.patience == Patience::Bounded
            && pending.waits
            && pending.confirmation + 1 >= REPEATS
            && now >= pending.due_at;
        if exhausted && !pending.dead { self.give_up() } else { CommandOutcome::Pending }
    }

    fn give_up(&mut self) -> CommandOutcome {
        let Some(pending) = &mut self.pending else { return CommandOutcome::Pending };
        pending.dead = true;
        let command = pending.command;
        let why = match pending.last_result {
            Some(result) => format!("refused ({})", result_name(result)),
            None => format!("not answered ({REPEATS} times)"),
        };
        if command.is_chore() {
            // Not critical: the next command may be sent at once.
            self.pending = None;
        }
        CommandOutcome::GivenUp { command, why }
    }
}
