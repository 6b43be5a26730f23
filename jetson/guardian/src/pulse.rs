//! Runtime's side of the guardian's failure, sans-IO: when the guardian has failed, and which packets the runtime may
//! then send to the autopilot itself. The second way only ends a flight: nothing that flies the vehicle passes.

use vizflyt_protocol::failsafe::is_navigation;
use vizflyt_protocol::mavlink::dialect::{MavCmd, MavMessage};
use vizflyt_protocol::mavlink::{CopterMode, MavlinkVersion, Message};
use vizflyt_protocol::time::HostTime;

use crate::watch::{COMMAND_LONG, HEARTBEAT, Head};

/// Interval at which a running guardian reports to the runtime. [s]
pub const ALIVE_EVERY_S: f64 = 0.05;
/// Silence of the guardian after which it counts as failed. [s]
pub const SILENCE_S: f64 = 0.3;
/// Maximum time between two checks that counts as silence. After a stall of the whole computer, the guardian gets a
/// chance to report. [s]
const LONGEST_STEP_S: f64 = 0.1;

/// Silence of a guardian.
#[derive(Clone, Copy, Debug)]
pub struct Pulse {
    checked_at: HostTime,
    silence_s: f64,
}

impl Pulse {
    /// Returns the pulse of a guardian that runs at `now`.
    pub fn new(now: HostTime) -> Self {
        Self { checked_at: now, silence_s: 0.0 }
    }

    /// Records a report of the guardian.
    pub fn note_alive(&mut self, now: HostTime) {
        *self = Self::new(now);
    }

    /// Whether the guardian has failed. Call it at least every 100 ms, after all waiting reports were read.
    pub fn has_failed(&mut self, now: HostTime) -> bool {
        self.silence_s += now.seconds_since(self.checked_at).clamp(0.0, LONGEST_STEP_S);
        self.checked_at = now;
        self.silence_s >= SILENCE_S
    }
}

/// Whether the runtime may send this packet without its guardian: LAND, and the heartbeats and poses of the landing.
pub fn may_bypass(packet: &[u8]) -> bool {
    Head::of(packet).is_some_and(|head| match head.id {
        HEARTBEAT => true,
        COMMAND_LONG => lands(head.payload),
        id => is_navigation(id),
    })
}

/// Whether a COMMAND_LONG orders LAND, as a command or as a mode.
fn lands(payload: &[u8]) -> bool {
    let Ok(MavMessage::COMMAND_LONG(command)) =
        MavMessage::parse(MavlinkVersion::V2, COMMAND_LONG, payload)
    else {
        return false;
    };
    let mode = (command.param2, command.param3);
    match command.command {
        MavCmd::MAV_CMD_NAV_LAND => true,
        // ArduCopter's LAND; PX4's AUTO.LAND.
        MavCmd::MAV_CMD_DO_SET_MODE => {
            mode == (CopterMode::Land as u32 as f32, 0.0) || mode == (4.0, 6.0)
        }
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use vizflyt_protocol::mavlink::dialect::{
        COMMAND_LONG_DATA, HEARTBEAT_DATA, SET_POSITION_TARGET_LOCAL_NED_DATA,
        VISION_POSITION_ESTIMATE_DATA,
    };
    use vizflyt_protocol::mavlink::{MAX_PACKET, MavHeader, encode};

    use super::*;

    fn at(ms: u64) -> HostTime {
        HostTime::from_ns(ms * 1_000_000)
    }

    #[test]
    fn fails_after_silence_but_not_after_a_stall_of_the_computer() {
        let mut pulse = Pulse::new(at(0));
        for ms in (50..=1000).step_by(50) {
            pulse.note_alive(at(ms));
        }
        let failed = (1050..).step_by(50).find(|&ms| pulse.has_failed(at(ms)));
        assert_eq!(failed, Some(1300));
        pulse.note_alive(at(2000));
        assert!(!pulse.has_failed(at(9000)));
        assert!(!pulse.has_failed(at(9050)));
    }

    #[test]
    fn passes_only_what_ends_a_flight() {
        let command = |command, param2, param3| {
            let target = COMMAND_LONG_DATA { target_system: 1, ..Default::default() };
            MavMessage::COMMAND_LONG(COMMAND_LONG_DATA { command, param2, param3, ..target })
        };
        let passes = |message: &MavMessage| {
            let header = MavHeader { system_id: 255, component_id: 191, sequence: 0 };
            may_bypass(encode(header, message, &mut [0; MAX_PACKET]))
        };
        for message in [
            command(MavCmd::MAV_CMD_NAV_LAND, 0.0, 0.0),
            command(MavCmd::MAV_CMD_DO_SET_MODE, 9.0, 0.0),
            command(MavCmd::MAV_CMD_DO_SET_MODE, 4.0, 6.0),
            MavMessage::HEARTBEAT(HEARTBEAT_DATA::default()),
            MavMessage::VISION_POSITION_ESTIMATE(VISION_POSITION_ESTIMATE_DATA::default()),
        ] {
            assert!(passes(&message), "{message:?}");
        }
        let setpoint = SET_POSITION_TARGET_LOCAL_NED_DATA::default();
        for message in [
            command(MavCmd::MAV_CMD_DO_SET_MODE, 4.0, 0.0),
            command(MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, 0.0, 0.0),
            command(MavCmd::MAV_CMD_NAV_TAKEOFF, 0.0, 0.0),
            MavMessage::SET_POSITION_TARGET_LOCAL_NED(setpoint),
        ] {
            assert!(!passes(&message), "{message:?}");
        }
        assert!(!may_bypass(&[]));
    }
}
