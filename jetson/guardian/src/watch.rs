//! Decisions of the guardian, sans-IO. Packets of the runtime and the autopilot pass through [`Watch`]. From them and
//! from `now` follow a stop, LAND, the heartbeats of a landing, and poses in place of the runtime's.
//!
//! The inputs are the runtime's packets ([`Failsafe`]), the autopilot's heartbeat and the pose of the vehicle. After
//! LAND was ordered, orders of the runtime are blocked, even if the runtime recovers; its poses and all other packets
//! still pass. As everywhere, a pilot's mode ends the landing.

use glam::DVec3;
use vizflyt_protocol::failsafe::{
    Failsafe, FailsafeAction, Flight, is_navigation, is_stream, land,
};
use vizflyt_protocol::mavlink::dialect::{MavCmd, MavMessage, MavResult};
use vizflyt_protocol::mavlink::{
    GuidedMotion, GuidedSetpoint, HeartbeatSender, MAX_PACKET, MavHeader, MavlinkVersion, Message,
    Signer, SigningTime, StreamDecoder, Verifier, encode, guided_from_mavlink, guided_to_mavlink,
    vision_of_sample,
};
use vizflyt_protocol::messages::{PoseSample, YawTarget};
use vizflyt_protocol::time::HostTime;

use crate::port::{Wanted, sender_of};

/// Silence of the runtime that leads to LAND, while the vehicle follows the runtime. [ms]
pub const SILENCE_MS: u16 = 500;
/// Gap in the setpoints, which come at 50 Hz, that leads to a stop. [s]
const STOP_S: f64 = 0.2;
/// Interval at which the stop is repeated. [s]
const STOP_EVERY_S: f64 = 0.1;
/// MAVLink component of the guardian: a second onboard computer, so that its packets are counted separately from the
/// runtime's.
pub const COMPONENT_ID: u8 = 192;
/// System id until the runtime has sent a packet. An autopilot counts heartbeats from this id.
const SYSTEM_ID: u8 = 255;
/// Link id of the guardian in signatures. The runtime's is 0.
const SIGNING_LINK: u8 = 1;
/// Time without a pose from the runtime after which the guardian sends poses. [s]
const NAVIGATION_S: f64 = 0.1;
/// Maximum age of a pose that is sent, as in the runtime. [s]
const STALE_S: f64 = 0.5;
/// Minimum interval between sent poses. [s]
const POSE_EVERY_S: f64 = 0.018;
/// Silence after which another autopilot may take the place of this one. [s]
const LOST_AFTER_S: f64 = 3.0;
/// Silence of the autopilot after which the guardian ends, if the runtime has ended. The autopilot's own failsafes have
/// started by then. [s]
const GIVEN_UP_S: f64 = 5.0;
/// Maximum time per step that counts as silence of the runtime, if the guardian itself was not scheduled. If the whole
/// computer stalls, the runtime gets a chance to send before LAND is ordered. [s]
const LONGEST_STEP_S: f64 = 0.05;

/// Notes for the user.
const SILENT: &str = "guardian: the runtime is silent: asks for LAND";
const ENDED: &str = "guardian: the runtime has ended in flight: asks for LAND";
const DESCENDING: &str = "guardian: the autopilot lands";
const UNHEARD: &str = "guardian: LAND is not acknowledged";

pub trait Out {
    /// Sends a packet to the autopilot.
    fn send(&mut self, packet: &[u8]);
    /// Prints a note for the user.
    fn say(&mut self, sentence: &'static str);
}

/// State of the guardian's decisions; see the module.
pub struct Watch {
    failsafe: Failsafe,
    runtime_is_gone: bool,
    /// MAVLink system of the runtime, from its packets.
    system: u8,
    wanted: Wanted,
    signer: Option<Signer>,
    verifier: Option<Verifier>,
    decoder: StreamDecoder,
    autopilot: Option<(u8, u8)>,
    autopilot_at: HostTime,
    /// Time of the autopilot's newest packet of any kind.
    heard_at: HostTime,
    flight: Flight,
    sequence: u8,
    made_at: HostTime,
    polled_at: HostTime,
    /// Watch time: the clock without the time in which the guardian was not scheduled.
    own: HostTime,
    navigated_at: HostTime,
    steering: Option<Steering>,
}

/// Newest setpoint of the runtime.
#[derive(Clone, Copy, Debug)]
struct Steering {
    /// Watch time at which it arrived.
    at: HostTime,
    yaw: YawTarget,
    /// Watch time of the next stop, unless another setpoint arrives.
    stop_at: HostTime,
}

impl Watch {
    pub fn new(now: HostTime, wanted: Wanted) -> Self {
        let signing = wanted.signing.as_ref();
        let signer = signing.map(|signing| Signer::new(signing.key.clone(), SIGNING_LINK));
        let checked = signing.filter(|signing| !signing.accepts_unsigned);
        let verifier = checked.map(|signing| Verifier::new(signing.key.clone()));
        Self {
            failsafe: Failsafe::NONE,
            runtime_is_gone: false,
            system: SYSTEM_ID,
            signer,
            verifier,
            wanted,
            decoder: StreamDecoder::default(),
            autopilot: None,
            autopilot_at: now,
            heard_at: now,
            flight: Flight::UNKNOWN,
            sequence: 0,
            made_at: now,
            polled_at: now,
            own: now,
            navigated_at: now,
            steering: None,
        }
    }

    /// Forwards one packet of the runtime. During a landing by the guardian, orders are dropped.
    pub fn handle_runtime(&mut self, now: HostTime, packet: &[u8], out: &mut impl Out) {
        let Some(head) = Head::of(packet) else { return };
        self.step(now);
        self.system = head.source.0;
        self.failsafe.note_packet(self.own, head.source, is_stream(head.id));
        if head.id == HEARTBEAT
            && let Ok(beat) = head.payload.try_into()
        {
            self.failsafe.note_heartbeat(head.source, beat);
        }
        if is_navigation(head.id) {
            self.navigated_at = now;
        }
        if let Some(yaw) = head.steers() {
            let stop_at = self.own.plus_seconds(STOP_S);
            self.steering = Some(Steering { at: self.own, yaw, stop_at });
        }
        if self.failsafe.stage().is_none() || !is_order(head.id) {
            out.send(packet);
        }
    }

    /// Handles bytes from the autopilot: heartbeats and the answer to LAND.
    pub fn handle_autopilot(&mut self, now: HostTime, bytes: &[u8]) {
        self.step(now);
        let Self { decoder, verifier, wanted, autopilot, .. } = self;
        let (mut beat, mut accepted, mut is_heard) = (None, false, false);
        let elapsed_us = (now.seconds_since(self.made_at).max(0.0) * 1e6) as u64;
        decoder.push_whole(bytes, |bytes, packet| {
            let system = packet.header.system_id as u8;
            if wanted.system.is_some_and(|wanted| wanted != system) {
                return;
            }
            let mut is_genuine = |bytes: &[u8]| match (&mut *verifier, &wanted.signing) {
                (Some(verifier), Some(signing)) => {
                    verifier.check(signing.start.plus_us(elapsed_us), bytes).is_ok()
                }
                _ => true,
            };
            is_heard |= *autopilot == Some((system, packet.header.component_id));
            match &packet.message {
                MavMessage::HEARTBEAT(heartbeat) => {
                    let sender = sender_of(packet.header, heartbeat);
                    if !matches!(sender, HeartbeatSender::Multirotor { .. }) {
                        return;
                    }
                    if !is_genuine(bytes) {
                        return;
                    }
                    let flight =
                        Flight::of(sender, heartbeat.base_mode.bits(), heartbeat.custom_mode);
                    beat = Some(((system, packet.header.component_id), flight));
                }
                MavMessage::COMMAND_ACK(ack) => {
                    accepted |= ack.command == MavCmd::MAV_CMD_NAV_LAND
                        && ack.result == MavResult::MAV_RESULT_ACCEPTED
                        && is_genuine(bytes);
                }
                _ => {}
            }
        });
        if let Some((from, flight)) = beat {
            // As in the runtime, the first autopilot keeps its place until it is silent; in flight, always.
            let is_kept = self.flight.armed || now.seconds_since(self.autopilot_at) < LOST_AFTER_S;
            if self.autopilot.is_none_or(|known| known == from || !is_kept) {
                (self.autopilot, self.autopilot_at, self.flight) = (Some(from), now, flight);
            }
        }
        if is_heard {
            self.heard_at = now;
        }
        if accepted {
            self.failsafe.note_acknowledged(self.own);
        }
    }

    /// Records that the runtime has ended.
    pub fn handle_end(&mut self) {
        self.runtime_is_gone = true;
    }

    /// Handles a pose that was measured at `stamp`: sends it if the runtime sends no poses.
    pub fn handle_pose(
        &mut self,
        now: HostTime,
        sample: &PoseSample,
        stamp: HostTime,
        out: &mut impl Out,
    ) {
        let runtime_sends = now.seconds_since(self.navigated_at) < NAVIGATION_S;
        let is_fresh = now.seconds_since(stamp) < STALE_S;
        if self.autopilot.is_some() && !runtime_sends && is_fresh && sample.is_valid() {
            // The next pose is due one period later, not NAVIGATION_S later.
            self.navigated_at = now.plus_seconds(POSE_EVERY_S - NAVIGATION_S);
            let message = vision_of_sample(sample, stamp);
            self.transmit(now, &MavMessage::VISION_POSITION_ESTIMATE(message), out);
        }
    }

    /// Performs due actions. Call it at least every 20 ms.
    pub fn handle_timeout(&mut self, now: HostTime, out: &mut impl Out) {
        self.step(now);
        let silence_ms = if self.runtime_is_gone { 1 } else { SILENCE_MS };
        self.stop(now, out);
        while let Some(action) = self.failsafe.poll(self.own, self.flight, silence_ms) {
            match action {
                FailsafeAction::Land { confirmation } => {
                    if confirmation == 0 {
                        out.say(if self.runtime_is_gone { ENDED } else { SILENT });
                    }
                    let Some(target) = self.autopilot else { continue };
                    let land = MavMessage::COMMAND_LONG(land(target, confirmation));
                    self.transmit(now, &land, out);
                }
                FailsafeAction::AnnounceLanding => out.say(DESCENDING),
                FailsafeAction::ReportSilence => out.say(UNHEARD),
                FailsafeAction::Beat(_, beat) => {
                    if let Ok(message) = MavMessage::parse(MavlinkVersion::V2, HEARTBEAT, &beat) {
                        self.transmit(now, &message, out);
                    }
                }
            }
        }
    }

    /// Stops the vehicle if setpoints are missing. The runtime's next setpoint resumes the flight.
    fn stop(&mut self, now: HostTime, out: &mut impl Out) {
        let is_stopping = self.flight.follows() && self.failsafe.stage().is_none();
        let (Some(target), Some(steering)) = (self.autopilot, &mut self.steering) else { return };
        let silence_s = self.own.seconds_since(steering.at);
        if !is_stopping || silence_s > 1e-3 * f64::from(SILENCE_MS) || self.own < steering.stop_at {
            return;
        }
        steering.stop_at = self.own.plus_seconds(STOP_EVERY_S);
        let stop =
            GuidedSetpoint { motion: GuidedMotion::Velocity(DVec3::ZERO), yaw: steering.yaw };
        let stop = guided_to_mavlink(&stop, target, (now.as_ns() / 1_000_000) as u32);
        self.transmit(now, &MavMessage::SET_POSITION_TARGET_LOCAL_NED(stop), out);
    }

    /// Whether the guardian can end: the runtime has ended, and the vehicle is disarmed or silent.
    pub fn is_over(&self, now: HostTime) -> bool {
        let is_heard = now.seconds_since(self.heard_at) < GIVEN_UP_S;
        self.runtime_is_gone && !(self.flight.armed && is_heard)
    }

    /// Advances the watch time to `now`.
    fn step(&mut self, now: HostTime) {
        let step_s = now.seconds_since(self.polled_at).clamp(0.0, LONGEST_STEP_S);
        (self.polled_at, self.own) = (now, self.own.plus_seconds(step_s));
    }

    fn transmit(&mut self, now: HostTime, message: &MavMessage, out: &mut impl Out) {
        let header = MavHeader {
            system_id: self.system.into(),
            component_id: COMPONENT_ID,
            sequence: self.sequence,
        };
        self.sequence = self.sequence.wrapping_add(1);
        let mut packet = [0; MAX_PACKET];
        let mut len = encode(header, message, &mut packet).len();
        if let (Some(signer), Some(signing)) = (&mut self.signer, &self.wanted.signing) {
            let elapsed_us = (now.seconds_since(self.made_at).max(0.0) * 1e6) as u64;
            let time: SigningTime = signing.start.plus_us(elapsed_us);
            len = signer.sign(time, &mut packet, len);
        }
        out.send(&packet[..len]);
    }
}

pub(crate) const HEARTBEAT: u32 = 0;
pub(crate) const COMMAND_LONG: u32 = 76;
const SET_POSITION_TARGET_LOCAL_NED: u32 = 84;

/// Whether a message makes the autopilot act: a setpoint, a mode or a command.
const fn is_order(id: u32) -> bool {
    // SET_MODE, COMMAND_INT.
    (is_stream(id) && !is_navigation(id)) || matches!(id, 11 | 75 | COMMAND_LONG)
}

/// Header and payload of a MAVLink 2 packet.
pub(crate) struct Head<'a> {
    source: (u8, u8),
    pub(crate) id: u32,
    pub(crate) payload: &'a [u8],
}

impl<'a> Head<'a> {
    pub(crate) fn of(packet: &'a [u8]) -> Option<Self> {
        let &[0xFD, len, _, _, _, system, component, a, b, c, ref rest @ ..] = packet else {
            return None;
        };
        let payload = rest.get(..usize::from(len))?;
        Some(Self { source: (system, component), id: u32::from_le_bytes([a, b, c, 0]), payload })
    }

    /// Returns the yaw to keep while stopped, if this is a setpoint.
    fn steers(&self) -> Option<YawTarget> {
        if self.id != SET_POSITION_TARGET_LOCAL_NED {
            return None;
        }
        match MavMessage::parse(MavlinkVersion::V2, self.id, self.payload) {
            Ok(MavMessage::SET_POSITION_TARGET_LOCAL_NED(message)) => {
                Some(match guided_from_mavlink(&message).ok()?.yaw {
                    YawTarget::Rate(_) => YawTarget::Rate(0.0),
                    yaw => yaw,
                })
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests;
