//! Handles packets of the autopilot, and of other senders on its network.

// Why: MISSION_REQUEST is formally superseded, but ArduCopter sends it.
#![allow(deprecated)]

use std::collections::VecDeque;

use glam::DVec3;
use vizflyt_protocol::mavlink::dialect::{
    AUTOPILOT_VERSION_DATA, COMMAND_ACK_DATA, EkfStatusFlags, HEARTBEAT_DATA, MavCmd, MavMessage,
    MavModeFlag, MavSysStatusSensor, STATUSTEXT_DATA, SYS_STATUS_DATA, TIMESYNC_DATA,
};
use vizflyt_protocol::mavlink::{
    CopterMode, GlobalPoint, HeartbeatSender, Message, Packet, attitude_from_mavlink,
    fence_corner_to_mavlink, fence_request_from_mavlink, heartbeat_sender,
    highres_imu_from_mavlink, local_position_from_mavlink, raw_imu_from_mavlink,
};
use vizflyt_protocol::packet::MAX_IMU;
use vizflyt_protocol::time::{AutopilotTime, HostTime, OffsetFilter};
use vizflyt_sdk::ImuSample;

use super::commands::{Command, CommandOutcome, is_final};
use super::params::ParamEvent;
use super::{
    COMPONENT_ID, Firmware, Link, LinkEvent, Prearm, SECOND_S, SYSTEM_ID, Target, dialect,
};

/// Minimum decrease of the boot clock that counts as a restart. [ms]
const REBOOT_MS: u32 = 1000;
/// Maximum number of texts stored for rejections.
const TEXTS: usize = 8;
/// Maximum number of clock requests stored: replies arrive within as many seconds.
const CLOCK_REQUESTS: usize = 8;
/// Maximum time from our command to its acknowledgement; later ones are not ours. [s]
const ACK_BELONGS_S: f64 = 10.0;
/// Prefix of pre-arm texts.
const PREARM: &str = "PreArm: ";

impl Link {
    pub(super) fn handle_packet(&mut self, now: HostTime, packet: &Packet) {
        let from = Target::of(packet);
        if let MavMessage::HEARTBEAT(heartbeat) = &packet.message {
            self.handle_heartbeat(now, from, heartbeat);
            return;
        }
        // Ignore packets of ground stations, gimbals and other vehicles on the same network.
        if self.autopilot != Some(from) {
            if let MavMessage::STATUSTEXT(message) = &packet.message {
                let text = message.text.to_str().unwrap_or_default();
                if !self.is_own_name(text) {
                    self.companions.text(now, (from.system, from.component), text);
                }
            }
            return;
        }
        self.received_at = now;
        self.rates.received(packet.message.message_id());
        match &packet.message {
            MavMessage::ATTITUDE(message) => {
                self.handle_boot_time(message.time_boot_ms);
                let (rotation, omega_body_radps) = attitude_from_mavlink(message);
                if rotation.is_finite() && omega_body_radps.is_finite() {
                    self.state.world_from_body = rotation;
                    self.state.omega_body_radps = omega_body_radps;
                    let boot_ns = u64::from(message.time_boot_ms) * 1_000_000;
                    self.attitude_at = Some(self.measured_at(now, boot_ns));
                }
            }
            MavMessage::LOCAL_POSITION_NED(message) => {
                self.handle_boot_time(message.time_boot_ms);
                let (p_world_m, v_world_mps) = local_position_from_mavlink(message);
                if p_world_m.is_finite() && v_world_mps.is_finite() {
                    self.state.p_world_m = p_world_m;
                    self.state.v_world_mps = v_world_mps;
                    self.position_known = true;
                }
            }
            MavMessage::RAW_IMU(message) if !self.imu_is_fine => {
                self.handle_imu(now, message.time_usec, raw_imu_from_mavlink(message));
            }
            MavMessage::HIGHRES_IMU(message) => {
                self.imu_is_fine = true;
                self.handle_imu(now, message.time_usec, highres_imu_from_mavlink(message));
            }
            MavMessage::SYS_STATUS(message) => self.handle_sys_status(message),
            MavMessage::EKF_STATUS_REPORT(message) => self.ekf = message.flags,
            // The same bits with different names.
            MavMessage::ESTIMATOR_STATUS(message) => {
                self.ekf = EkfStatusFlags::from_bits_truncate(message.flags.bits());
            }
            MavMessage::GPS_GLOBAL_ORIGIN(message) => {
                let (latitude_e7, longitude_e7) = (message.latitude, message.longitude);
                let origin = GlobalPoint { latitude_e7, longitude_e7 };
                self.origin = Some(origin);
                self.fence.set_origin(origin);
            }
            request @ (MavMessage::MISSION_REQUEST(_) | MavMessage::MISSION_REQUEST_INT(_)) => {
                self.handle_fence_request(now, from, request);
            }
            MavMessage::MISSION_ACK(message) => {
                if let Some(event) = self.fence.acknowledged(now, message) {
                    self.events.push_back(LinkEvent::Fence(event));
                }
            }
            MavMessage::TIMESYNC(message) => self.handle_timesync(now, message),
            MavMessage::STATUSTEXT(message) => self.handle_text(now, message),
            MavMessage::COMMAND_ACK(message) => self.handle_ack(now, message),
            MavMessage::AUTOPILOT_VERSION(message) => self.handle_version(message),
            MavMessage::PARAM_VALUE(message) => {
                if let Some(event) = self.params.handle(now, message, self.dialect) {
                    self.events.push_back(LinkEvent::Param(event));
                }
            }
            _ => {}
        }
    }

    fn handle_heartbeat(&mut self, now: HostTime, from: Target, heartbeat: &HEARTBEAT_DATA) {
        let Target { system, component } = from;
        let sender =
            heartbeat_sender(component, heartbeat.mavtype as u8, heartbeat.autopilot as u8);
        let HeartbeatSender::Multirotor { px4 } = sender else {
            self.companions.heartbeat(now, (system, component), heartbeat);
            if !self.companions.is_echo((system, component), heartbeat)
                && let Some(line) = self.neighbors.heartbeat(now, from, heartbeat)
            {
                self.events.push_back(LinkEvent::Neighbor(line));
            }
            return;
        };
        let dialect = dialect::of(px4);
        let ours = self.settings.system.or(self.flown).is_none_or(|system| system == from.system);
        match self.autopilot {
            None if ours => {
                self.autopilot = Some(from);
                self.neighbors.remove(from);
                self.dialect = dialect;
                self.forget();
                self.params.read(dialect.watched());
                self.announced_at = None;
                // Send the origin and a clock request now, not at the next second.
                self.beat_at = self.beat_at.min(now);
                self.events.push_back(LinkEvent::Connected { system: from.system });
            }
            Some(known) if known == from => {}
            _ => {
                self.neighbors.heartbeat(now, from, heartbeat);
                return;
            }
        }
        self.received_at = now;
        let armed = heartbeat.base_mode.contains(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED);
        if armed != self.state.armed {
            self.state.armed = armed;
            if armed {
                self.flown = Some(from.system);
            } else {
                self.took_off = false;
            }
            self.events.push_back(if armed { LinkEvent::Armed } else { LinkEvent::Disarmed });
        }
        let mode = self.dialect.mode(heartbeat.custom_mode);
        if mode != self.state.mode {
            self.state.mode = mode;
            self.events.push_back(LinkEvent::Mode(mode));
        }
        self.own_mode.handle_heartbeat(self.goal, mode, armed);
    }

    /// Drops state that a restarted autopilot no longer has.
    fn forget(&mut self) {
        self.origin = None;
        self.fence.restart();
        self.ekf = EkfStatusFlags::empty();
        self.prearm = Prearm::default();
        self.took_off = false;
        self.rising = None;
        self.boot_ms = 0;
        self.attitude_at = None;
        self.position_known = false;
        self.imu.clear();
        self.imu_is_fine = false;
        self.clock = OffsetFilter::default();
        self.firmware = None;
        self.params.forget();
        self.rates = super::Rates::default();
        self.delay_reported = false;
        self.commands.abandon();
        let intervals = self.dialect.intervals().iter();
        self.chores = intervals.map(|&(id, period_us)| Command::Interval(id, period_us)).collect();
        self.chores.push_back(Command::Message(AUTOPILOT_VERSION));
        // A vehicle that crashed must not take off again by itself.
        self.goal_is_stale = matches!(self.goal, super::Goal::TakeOff(_) | super::Goal::Fly);
    }

    fn handle_boot_time(&mut self, boot_ms: u32) {
        if boot_ms.saturating_add(REBOOT_MS) < self.boot_ms {
            self.events.push_back(LinkEvent::Rebooted);
            self.forget();
            // The mode after a restart was not chosen by anyone.
            self.own_mode = super::OwnMode::default();
            self.params.read(self.dialect.watched());
        }
        self.boot_ms = boot_ms;
    }

    fn handle_fence_request(&mut self, now: HostTime, from: Target, request: &MavMessage) {
        let Some(seq) = fence_request_from_mavlink(request) else { return };
        if let Some(corner) = self.fence.asked(now, seq) {
            let item = fence_corner_to_mavlink(&corner, seq, (from.system, from.component));
            self.send(now, &MavMessage::MISSION_ITEM_INT(item));
        }
    }

    fn handle_imu(&mut self, now: HostTime, boot_us: u64, (accel, gyro): (DVec3, DVec3)) {
        if !(accel.is_finite() && gyro.is_finite()) {
            return;
        }
        let stamp = self.measured_at(now, boot_us.saturating_mul(1000));
        // Consumers detect new samples by their stamps, so these must increase.
        if self.imu.back().is_some_and(|newest| newest.stamp >= stamp) {
            return;
        }
        if self.imu.len() == MAX_IMU {
            self.imu.pop_front();
        }
        self.imu.push_back(ImuSample { stamp, accel_mps2: accel, gyro_radps: gyro });
    }

    /// Converts a time of the autopilot's clock; `now` while the offset of that clock is unknown, and never later than
    /// `now`.
    fn measured_at(&self, now: HostTime, boot_ns: u64) -> HostTime {
        let at = self.clock.to_local(AutopilotTime::from_ns(boot_ns));
        at.filter(|&at| now.seconds_since(at).abs() < SECOND_S).map_or(now, |at| at.min(now))
    }

    fn handle_sys_status(&mut self, message: &SYS_STATUS_DATA) {
        let check = MavSysStatusSensor::MAV_SYS_STATUS_PREARM_CHECK;
        let healthy = message.onboard_control_sensors_health;
        let ok = healthy.contains(check);
        if ok && self.prearm.ok != Some(true) {
            self.prearm.texts.clear();
        }
        self.prearm.ok = Some(ok);
        let in_use =
            message.onboard_control_sensors_enabled & message.onboard_control_sensors_present;
        self.prearm.unhealthy = in_use & !healthy & !check;
        // 65535 and -1 mean "not measured".
        let millivolts = message.voltage_battery;
        self.state.battery_v =
            if millivolts == u16::MAX { 0.0 } else { f32::from(millivolts) / 1000.0 };
        let percent = message.battery_remaining;
        self.state.battery_fraction =
            if percent < 0 { -1.0 } else { (f32::from(percent) / 100.0).min(1.0) };
    }

    fn handle_version(&mut self, message: &AUTOPILOT_VERSION_DATA) {
        let [_, patch, minor, major] = message.flight_sw_version.to_le_bytes();
        let firmware = Firmware { name: self.dialect.name(), version: (major, minor, patch) };
        if self.firmware != Some(firmware) {
            self.firmware = Some(firmware);
            self.events.push_back(LinkEvent::Firmware(firmware));
        }
    }

    fn handle_timesync(&mut self, now: HostTime, message: &TIMESYNC_DATA) {
        if message.tc1 == 0 {
            let reply =
                TIMESYNC_DATA { tc1: now.as_ns() as i64, ts1: message.ts1, ..Default::default() };
            return self.send(now, &MavMessage::TIMESYNC(reply));
        }
        let to = (message.target_system, message.target_component);
        let is_ours = self.clock_asked.contains(&message.ts1);
        if !is_ours {
            // Older autopilots do not set the receiver of their reply.
            if to != (0, 0) {
                self.companions.answer(now, to);
            }
        } else if let (Ok(theirs), Ok(ours)) =
            (u64::try_from(message.tc1), u64::try_from(message.ts1))
            && now.seconds_since(HostTime::from_ns(ours)).abs() < 2.0 * SECOND_S
        {
            self.clock.update(HostTime::from_ns(ours), AutopilotTime::from_ns(theirs), now);
        }
    }

    /// Stores a clock request, so that its reply is recognized.
    pub(super) fn note_clock_request(&mut self, stamp_ns: i64) {
        if self.clock_asked.len() == CLOCK_REQUESTS {
            self.clock_asked.pop_front();
        }
        self.clock_asked.push_back(stamp_ns);
    }

    fn handle_text(&mut self, now: HostTime, message: &STATUSTEXT_DATA) {
        let Some(text) = self.text_parts.join(message) else { return };
        remember(&mut self.texts, now, text.clone());
        if let Some(why) = text.strip_prefix(PREARM) {
            self.prearm.texts.retain(|(_, known)| known != why);
            remember(&mut self.prearm.texts, now, why.to_owned());
        }
        self.events.push_back(LinkEvent::Text { severity: message.severity as u8, text });
    }

    fn handle_ack(&mut self, now: HostTime, ack: &COMMAND_ACK_DATA) {
        // Acknowledgements contain the companion's address; zero is the old form, for all.
        let to = (ack.target_system, ack.target_component);
        let for_us = (to.0 == 0 || to.0 == SYSTEM_ID) && (to.1 == 0 || to.1 == COMPONENT_ID);
        let asked = self
            .commanded
            .iter()
            .any(|&(command, at)| command == ack.command && now.seconds_since(at) < ACK_BELONGS_S);
        if !for_us || (!asked && to != (0, 0)) {
            return self.companions.answer(now, to);
        }
        if ack.command == MavCmd::MAV_CMD_RUN_PREARM_CHECKS {
            self.prearm.is_unsupported = is_final(ack.result);
            return;
        }
        match self.commands.handle_ack(now, ack.command, ack.result) {
            CommandOutcome::Pending => {}
            CommandOutcome::Accepted(command) => self.accepted(now, command),
            CommandOutcome::GivenUp { command, why } => self.given_up(now, command, &why),
        }
    }

    /// Assumes that the commanded state is reached; the next heartbeat corrects it if not.
    fn accepted(&mut self, now: HostTime, command: Command) {
        match command {
            Command::Mode(mode) => self.state.mode = mode as u32,
            Command::Arm => {
                if !self.state.armed {
                    self.state.armed = true;
                    self.events.push_back(LinkEvent::Armed);
                }
            }
            Command::TakeOff(_) => self.rose(),
            Command::Land => self.state.mode = CopterMode::Land as u32,
            Command::Interval(id, period_us) => {
                self.rates.watch(now, (id, period_us));
                self.chores.pop_front();
            }
            Command::Message(_) => {
                self.chores.pop_front();
            }
        }
    }

    /// Records that the take-off has begun.
    pub(super) fn rose(&mut self) {
        self.took_off = true;
        self.events.push_back(LinkEvent::TakingOff);
    }

    pub(super) fn given_up(&mut self, now: HostTime, command: Command, why: &str) {
        if command.is_chore() {
            // An autopilot that rejects our rate may still send the message at its own rate.
            self.chores.pop_front();
            return;
        }
        let text = self.refusal(now, command, why);
        self.events.push_back(LinkEvent::Refused(text));
    }

    /// Reports the result of reading or writing parameters.
    pub(super) fn param_event(&mut self, event: ParamEvent) {
        self.events.push_back(LinkEvent::Param(event));
    }
}

/// Message id of AUTOPILOT_VERSION.
const AUTOPILOT_VERSION: u32 = 148;

fn remember(texts: &mut VecDeque<(HostTime, String)>, now: HostTime, text: String) {
    if texts.len() == TEXTS {
        texts.pop_front();
    }
    texts.push_back((now, text));
}

/// Joins texts that arrive in several parts (`id` and `chunk_seq` of STATUSTEXT).
#[derive(Clone, Debug, Default)]
pub(super) struct TextParts {
    id: u16,
    next: u8,
    text: String,
}

/// Size of one part in bytes; a shorter part is the last.
const PART: usize = 50;
/// Maximum number of parts.
const PARTS: u8 = 8;

impl TextParts {
    /// Returns the text after its last part. A missing part is shown as "...".
    fn join(&mut self, message: &STATUSTEXT_DATA) -> Option<String> {
        let part = message.text.to_str().unwrap_or("(not UTF-8)");
        if message.id == 0 {
            return Some(part.trim().to_owned());
        }
        if message.id != self.id || message.chunk_seq == 0 {
            (self.id, self.next) = (message.id, 0);
            self.text.clear();
        }
        if message.chunk_seq != self.next {
            self.text.push_str("...");
        }
        self.text.push_str(part);
        self.next = message.chunk_seq.saturating_add(1);
        let last = part.len() < PART || self.next >= PARTS;
        last.then(|| {
            self.id = 0;
            std::mem::take(&mut self.text).trim().to_owned()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_texts_are_joined() {
        let part = |id, chunk_seq, text: &str| STATUSTEXT_DATA {
            id,
            chunk_seq,
            text: text.into(),
            ..Default::default()
        };
        let mut parts = TextParts::default();
        let full = "x".repeat(50);
        assert_eq!(parts.join(&part(0, 0, " alone ")), Some("alone".into()));
        assert_eq!(parts.join(&part(7, 0, &full)), None);
        assert_eq!(parts.join(&part(7, 1, "end")), Some(format!("{full}end")));
        assert_eq!(parts.join(&part(8, 0, &full)), None);
        assert_eq!(parts.join(&part(8, 2, "end")), Some(format!("{full}...end")));
        assert_eq!(parts.join(&part(9, 0, &full)), None);
        assert_eq!(parts.join(&part(10, 0, "other")), Some("other".into()));
    }
}
