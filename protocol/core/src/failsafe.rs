//! Failsafe for a companion that falls silent in flight: LAND is sent in its place. Used by the guardian on the
//! companion's computer and by the bridge on the vehicle. Sans-IO, no allocation.
//!
//! A sender of a stream of setpoints or poses (ten within two seconds) is the companion. A ground station that sends an
//! occasional target is not. While the vehicle is armed and follows a companion (GUIDED, or PX4's OFFBOARD), silence of
//! the companion for the configured time leads to LAND, repeated until the autopilot has left that mode. If the
//! companion recovers during the landing, the landing continues, because a vehicle that lands is easier to predict than
//! one that resumes its flight halfway.
//!
//! ```text
//! silent ─▶ asked ── acknowledged ─▶ accepted ── heartbeat in LAND ─▶ descending ── disarmed, or a
//!             └─ not for a second: reported ─┘                          │           pilot's mode ─▶ over
//!                                                        the companion's heartbeat is sent for it
//! ```
//! During the descent, the companion's heartbeat is continued. Otherwise ArduCopter's own failsafe would restart the
//! landing some seconds later, with a pause. The heartbeat is not continued before the descent: if LAND is not
//! received, that failsafe must land the vehicle.

use crate::mavlink::dialect::{COMMAND_LONG_DATA, MavCmd, MavModeFlag};
use crate::mavlink::{CopterMode, HeartbeatSender};
use crate::time::HostTime;

/// State of the vehicle from the autopilot's heartbeat.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Flight {
    /// Whether the vehicle is armed.
    pub armed: bool,
    /// Mode number: `custom_mode` of the heartbeat.
    pub mode: u32,
    /// Sender of the heartbeat: PX4's modes have other numbers, and only multirotors are landed.
    pub sender: HeartbeatSender,
}

impl Flight {
    /// State before the first heartbeat.
    pub const UNKNOWN: Self = Self { armed: false, mode: 0, sender: HeartbeatSender::Device };

    /// Returns the state from the sender of a heartbeat and its fields `base_mode` and `custom_mode`.
    pub fn of(sender: HeartbeatSender, base_mode: u8, mode: u32) -> Self {
        let armed = base_mode & MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED.bits() != 0;
        Self { armed, mode, sender }
    }

    /// Whether the vehicle follows a companion's setpoints.
    pub fn follows(self) -> bool {
        self.is_in(CopterMode::Guided, PX4_OFFBOARD)
    }

    /// Whether the vehicle is landing by itself.
    pub fn lands(self) -> bool {
        self.is_in(CopterMode::Land, PX4_LAND)
    }

    fn is_in(self, copter: CopterMode, px4_mode: u32) -> bool {
        let HeartbeatSender::Multirotor { px4 } = self.sender else { return false };
        self.armed && self.mode == if px4 { px4_mode } else { copter as u32 }
    }
}

/// PX4's main mode 6 (OFFBOARD) in `custom_mode`.
const PX4_OFFBOARD: u32 = 6 << 16;
/// PX4's main mode 4, sub-mode 6 (AUTO.LAND).
const PX4_LAND: u32 = 4 << 16 | 6 << 24;
/// Number of packets within [`STREAM_S`] that make a stream.
const STREAM: u8 = 10;
const STREAM_S: f64 = 2.0;
/// Silence after which a companion has ended, if the vehicle does not follow it. Must exceed the time from the last
/// pose before arming to the heartbeat that reports the arming. [s]
const ENDED_S: f64 = 5.0;
/// Interval at which LAND is repeated until it is acknowledged. [s]
const REPEAT_S: f64 = 0.3;
/// Interval at which LAND is repeated after that, until the mode has changed. Heartbeats arrive once a second. [s]
const REPEAT_ACKNOWLEDGED_S: f64 = 1.5;

/// Time without an acknowledgement after which it is reported. The heartbeat, once a second, may also confirm LAND. [s]
const UNANSWERED_S: f64 = 1.1;
/// Interval at which the report is repeated. [s]
const REPORT_S: f64 = 5.0;
/// Interval at which the companion's heartbeat is sent in its place. Two may be lost before `FS_GCS_TIMEOUT`, whose
/// minimum is 2 s. [s]
const BEAT_S: f64 = 0.5;
/// Maximum time for which it is sent. A landing from the ceiling of a hall takes a quarter of this. [s]
const LONGEST_S: f64 = 120.0;

/// Whether a message belongs to a stream that flies the vehicle: setpoints and external navigation. Only the newest one
/// of a stream is relevant.
pub const fn is_stream(message_id: u32) -> bool {
    // SET_ATTITUDE_TARGET, SET_POSITION_TARGET_LOCAL_NED, SET_POSITION_TARGET_GLOBAL_INT,
    // MANUAL_CONTROL, RC_CHANNELS_OVERRIDE.
    matches!(message_id, 82 | 84 | 86 | 69 | 70) || is_navigation(message_id)
}

/// Whether a message sends the autopilot its pose or velocity (external navigation).
pub const fn is_navigation(message_id: u32) -> bool {
    // GLOBAL_VISION_POSITION_ESTIMATE, VISION_POSITION_ESTIMATE, VISION_SPEED_ESTIMATE,
    // VICON_POSITION_ESTIMATE, ATT_POS_MOCAP, GPS_INPUT, ODOMETRY.
    matches!(message_id, 101..=104 | 138 | 232 | 331)
}

/// Returns the command to land, for `target` (system, component).
pub fn land(target: (u8, u8), confirmation: u8) -> COMMAND_LONG_DATA {
    COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_NAV_LAND,
        target_system: target.0,
        target_component: target.1,
        confirmation,
        ..COMMAND_LONG_DATA::default()
    }
}

/// Payload of a HEARTBEAT.
pub type Beat = [u8; 9];

/// State of the companion and of a landing after its silence.
#[derive(Clone, Copy, Debug, Default)]
pub struct Failsafe {
    streamer: Option<Streamer>,
    landing: Option<Landing>,
}

#[derive(Clone, Copy, Debug)]
struct Streamer {
    source: (u8, u8),
    received_at: HostTime,
    counted: u8,
    counting_since: HostTime,
    /// Newest heartbeat of the streamer.
    beat: Option<Beat>,
}

/// Progress of a landing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LandingStage {
    /// LAND was sent, but not acknowledged.
    Asked,
    /// The autopilot has acknowledged LAND.
    Accepted,
    /// The autopilot's heartbeat reports the mode LAND.
    Descending,
}

#[derive(Clone, Copy, Debug)]
struct Landing {
    stage: LandingStage,
    asked_at: HostTime,
    /// Time of the next LAND; while descending, of the next heartbeat.
    act_at: HostTime,
    /// Time of the next report of a missing acknowledgement.
    report_at: HostTime,
    confirmation: u8,
    /// Whether the landing was announced.
    is_announced: bool,
}

impl Landing {
    fn begun(now: HostTime, stage: LandingStage) -> Self {
        Self {
            stage,
            asked_at: now,
            act_at: now.plus_seconds(REPEAT_S),
            report_at: now.plus_seconds(UNANSWERED_S),
            confirmation: 0,
            is_announced: false,
        }
    }
}

/// Action to perform.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FailsafeAction {
    /// Send LAND. If `confirmation` is 0, the landing begins and should be announced.
    Land {
        /// Number of repetitions, as in MAVLink's `confirmation`.
        confirmation: u8,
    },
    /// Announce that the autopilot is landing.
    AnnounceLanding,
    /// Report that LAND was not acknowledged.
    ReportSilence,
    /// Send the companion's heartbeat, from its system id.
    Beat(u8, Beat),
}

impl Failsafe {
    /// No companion yet. Equal to the default, but `const`.
    pub const NONE: Self = Self { streamer: None, landing: None };

    /// Returns the companion (system, component): the sender of a stream, if there is one.
    pub fn companion(&self) -> Option<(u8, u8)> {
        self.streamer.filter(|streamer| streamer.counted >= STREAM).map(|streamer| streamer.source)
    }

    /// Records a packet from the network. `streams`: the packet is a setpoint or a pose ([`is_stream`]).
    pub fn note_packet(&mut self, now: HostTime, source: (u8, u8), streams: bool) {
        match &mut self.streamer {
            Some(streamer) if streamer.source == source => {
                streamer.received_at = now;
                if streams && streamer.counted < STREAM {
                    if now.seconds_since(streamer.counting_since) > STREAM_S {
                        streamer.counting_since = now;
                        streamer.counted = 0;
                    }
                    streamer.counted += 1;
                }
            }
            // A second sender becomes the companion only if the first is silent or was no companion yet.
            Some(streamer)
                if streamer.counted >= STREAM
                    && now.seconds_since(streamer.received_at) < STREAM_S => {}
            _ if streams => {
                self.streamer = Some(Streamer {
                    source,
                    received_at: now,
                    counted: 1,
                    counting_since: now,
                    beat: None,
                });
            }
            _ => {}
        }
    }

    /// Records a heartbeat from the network.
    pub fn note_heartbeat(&mut self, source: (u8, u8), beat: Beat) {
        if let Some(streamer) = self.streamer.as_mut().filter(|known| known.source.0 == source.0) {
            streamer.beat = Some(beat);
        }
    }

    /// Records that the autopilot has acknowledged LAND.
    pub fn note_acknowledged(&mut self, now: HostTime) {
        if let Some(landing) = &mut self.landing
            && landing.stage == LandingStage::Asked
        {
            landing.stage = LandingStage::Accepted;
            landing.act_at = now.plus_seconds(REPEAT_ACKNOWLEDGED_S);
        }
    }

    /// Returns the progress of the landing, if there is one.
    pub fn stage(&self) -> Option<LandingStage> {
        self.landing.map(|landing| landing.stage)
    }

    /// Whether LAND has been unacknowledged for too long.
    pub fn is_unanswered(&self, now: HostTime) -> bool {
        self.landing.is_some_and(|landing| {
            landing.stage == LandingStage::Asked
                && now.seconds_since(landing.asked_at) >= UNANSWERED_S
        })
    }

    /// Returns the time at which [`Self::poll`] next returns an action, if `flight` does not change.
    pub fn due(&self, flight: Flight, loss_ms: u16) -> Option<HostTime> {
        if let Some(landing) = self.landing {
            return Some(match landing.stage {
                LandingStage::Asked => landing.act_at.min(landing.report_at),
                LandingStage::Accepted | LandingStage::Descending => landing.act_at,
            });
        }
        let streamer = self.streamer.filter(|streamer| streamer.counted >= STREAM)?;
        let flies = flight.follows() || flight.lands();
        (flies && loss_ms > 0).then(|| streamer.received_at.plus_ns(i64::from(loss_ms) * 1_000_000))
    }

    /// Returns an action due at `now`. Call it until it returns `None`.
    pub fn poll(&mut self, now: HostTime, flight: Flight, loss_ms: u16) -> Option<FailsafeAction> {
        let ended = |streamer: &Streamer| now.seconds_since(streamer.received_at) > ENDED_S;
        match &mut self.landing {
            Some(_) if !flight.follows() && !flight.lands() => {
                self.landing = None;
                // The companion must stream again before its silence leads to LAND again.
                self.streamer = None;
            }
            Some(landing) => {
                if flight.lands() && landing.stage != LandingStage::Descending {
                    landing.stage = LandingStage::Descending;
                    landing.act_at = now;
                }
                if landing.stage != LandingStage::Asked && !landing.is_announced {
                    landing.is_announced = true;
                    return Some(FailsafeAction::AnnounceLanding);
                }
            }
            // On the ground or in a pilot's mode, a companion may end. A later flight without a companion must not be
            // landed because of its silence.
            None if !flight.follows()
                && !flight.lands()
                && self.streamer.as_ref().is_some_and(ended) =>
            {
                self.streamer = None;
            }
            None => {}
        }
        if self.due(flight, loss_ms)? > now {
            return None;
        }
        let landing = match &mut self.landing {
            Some(landing) => landing,
            // The companion or a pilot has ordered the landing: only the heartbeat must be continued.
            none if flight.lands() => none.insert(Landing {
                is_announced: true,
                ..Landing::begun(now, LandingStage::Descending)
            }),
            none => {
                *none = Some(Landing::begun(now, LandingStage::Asked));
                return Some(FailsafeAction::Land { confirmation: 0 });
            }
        };
        match landing.stage {
            LandingStage::Asked if landing.report_at <= now => {
                landing.report_at = now.plus_seconds(REPORT_S);
                Some(FailsafeAction::ReportSilence)
            }
            LandingStage::Asked | LandingStage::Accepted => {
                let accepted = landing.stage == LandingStage::Accepted;
                let repeat_s = if accepted { REPEAT_ACKNOWLEDGED_S } else { REPEAT_S };
                landing.act_at = now.plus_seconds(repeat_s);
                landing.confirmation = landing.confirmation.saturating_add(1);
                Some(FailsafeAction::Land { confirmation: landing.confirmation })
            }
            LandingStage::Descending => {
                landing.act_at = now.plus_seconds(BEAT_S);
                let takes_too_long = now.seconds_since(landing.asked_at) > LONGEST_S;
                // A companion that has recovered sends its own heartbeat.
                let silent = |streamer: &Streamer| {
                    let silent_ms = now.seconds_since(streamer.received_at) * 1e3;
                    silent_ms >= f64::from(loss_ms)
                };
                let streamer = self.streamer.filter(|known| !takes_too_long && silent(known))?;
                Some(FailsafeAction::Beat(streamer.source.0, streamer.beat?))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use std::vec::Vec;

    use super::*;

    const RUNTIME: (u8, u8) = (255, 191);
    const COPTER: HeartbeatSender = HeartbeatSender::Multirotor { px4: false };
    const GUIDED: Flight = Flight { armed: true, mode: 4, sender: COPTER };

    fn at(ms: u64) -> HostTime {
        HostTime::from_ns(ms * 1_000_000)
    }

    /// Streams from 0 to 1 s, then is silent. Returns the times of LAND and their repetition counts up to `until_ms`.
    fn landings(
        flight: impl Fn(u64) -> Flight,
        loss_ms: u16,
        period_ms: u64,
        until_ms: u64,
    ) -> Vec<(u64, u8)> {
        let mut loss = Failsafe::default();
        let mut sent = Vec::new();
        for ms in 0..until_ms {
            if ms <= 1000 && ms % period_ms == 0 {
                loss.note_packet(at(ms), RUNTIME, true);
            }
            while let Some(act) = loss.poll(at(ms), flight(ms), loss_ms) {
                if let FailsafeAction::Land { confirmation } = act {
                    sent.push((ms, confirmation));
                }
            }
        }
        sent
    }

    #[test]
    fn repeats_land_until_the_mode_changes() {
        let land_at = |ms| if ms < 2700 { GUIDED } else { Flight { mode: 9, ..GUIDED } };
        assert_eq!(landings(land_at, 1000, 20, 9000), [(2000, 0), (2300, 1), (2600, 2)]);
    }

    #[test]
    fn lands_only_a_vehicle_that_follows_a_companion() {
        for flight in [Flight { armed: false, ..GUIDED }, Flight { mode: 5, ..GUIDED }] {
            assert_eq!(landings(|_| flight, 1000, 20, 5000), []);
        }
        assert_eq!(landings(|_| GUIDED, 0, 20, 5000), []);
        // One target every 400 ms: a ground station.
        assert_eq!(landings(|_| GUIDED, 1000, 400, 5000), []);
        let px4 = HeartbeatSender::Multirotor { px4: true };
        let px4 = Flight { armed: true, mode: 6 << 16, sender: px4 };
        assert_eq!(landings(|_| px4, 1000, 20, 2200), [(2000, 0)]);
        // ArduCopter's mode number is not valid for PX4.
        assert_eq!(landings(|_| Flight { mode: 4, ..px4 }, 1000, 20, 5000), []);
    }

    #[test]
    fn does_not_land_later_for_a_companion_that_ended_on_the_ground() {
        let pilot = |ms| Flight { mode: 5, armed: ms < 3000, ..GUIDED };
        let later = |ms| if ms < 7000 { pilot(ms) } else { GUIDED };
        assert_eq!(landings(later, 1000, 20, 12_000), []);
        // A companion that falls silent during arming does lead to LAND.
        let soon = |ms| if ms < 4000 { pilot(ms) } else { GUIDED };
        assert_eq!(landings(soon, 1000, 20, 4200), [(4000, 0)]);
    }

    #[test]
    fn counts_only_packets_of_the_companion() {
        let mut loss = Failsafe::default();
        for ms in (0..500).step_by(20) {
            loss.note_packet(at(ms), RUNTIME, true);
        }
        loss.note_packet(at(1200), RUNTIME, false);
        loss.note_packet(at(1900), (255, 190), true);
        assert_eq!(loss.due(GUIDED, 1000), Some(at(2200)));
    }

    #[test]
    fn repeats_land_slowly_after_an_acknowledgement() {
        let mut loss = Failsafe::default();
        for ms in (0..=500).step_by(20) {
            loss.note_packet(at(ms), RUNTIME, true);
        }
        assert_eq!(
            loss.poll(at(1500), GUIDED, 1000),
            Some(FailsafeAction::Land { confirmation: 0 })
        );
        loss.note_acknowledged(at(1510));
        assert_eq!(loss.poll(at(1510), GUIDED, 1000), Some(FailsafeAction::AnnounceLanding));
        assert_eq!(loss.due(GUIDED, 1000), Some(at(3010)));
        // The companion recovers; the landing continues.
        loss.note_packet(at(1600), RUNTIME, true);
        assert_eq!(
            loss.poll(at(3010), GUIDED, 1000),
            Some(FailsafeAction::Land { confirmation: 1 })
        );
        assert_eq!(loss.poll(at(3100), Flight { mode: 9, ..GUIDED }, 1000), None);
        assert_eq!(loss.stage(), Some(LandingStage::Descending));
        assert_eq!(loss.poll(at(9000), Flight { armed: false, mode: 9, ..GUIDED }, 1000), None);
        assert_eq!(loss.stage(), None);
    }
}
