//! The MAVLink link to an ArduCopter autopilot: a sans-IO state machine. Bytes, poses, setpoints
//! and `now` in; datagrams and events out. [`udp`] drives it.
//!
//! ```text
//! poses 100 Hz ── vision() ──▶ VISION_POSITION_ESTIMATE 50 Hz      what the autopilot flies by
//! guard 50 Hz ── setpoint() ─▶ SET_POSITION_TARGET_LOCAL_NED       yaw always sent
//! flight ── set_goal() ──────▶ mode, arming, take-off, landing     acknowledged, repeated
//! autopilot ── handle_input() ▶ VehicleState, clock offset, LinkEvents
//! ```
//! Commands follow from what is observed, not from a script: whatever the goal needs next is
//! sent, so a reboot of either side or a lost packet only repeats a step.
//!
//! Why longer than most: one state machine, read best in one place.

// Why: SET_GPS_GLOBAL_ORIGIN is superseded on paper (2025-04) and what every ArduCopter accepts.
#![allow(deprecated)]

mod commands;
mod events;
#[cfg(test)]
mod tests;
pub mod udp;

use std::collections::VecDeque;

use glam::DVec3;
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::mavlink::dialect::{
    COMMAND_ACK_DATA, COMMAND_LONG_DATA, EkfStatusFlags, HEARTBEAT_DATA, MavAutopilot, MavCmd,
    MavMessage, MavModeFlag, MavState, MavSysStatusSensor, MavType, SET_GPS_GLOBAL_ORIGIN_DATA,
    STATUSTEXT_DATA, SYS_STATUS_DATA, TIMESYNC_DATA,
};
use vizflyt_protocol::mavlink::{
    CopterMode, GuidedSetpoint, MAX_PACKET, MavHeader, Packet, StreamDecoder,
    attitude_from_mavlink, encode, guided_to_mavlink, highres_imu_from_mavlink,
    local_position_from_mavlink, raw_imu_from_mavlink, vision_to_mavlink,
};
use vizflyt_protocol::messages::VehicleState;
use vizflyt_protocol::packet::MAX_IMU;
use vizflyt_protocol::time::{Autopilot, AutopilotTime, Host, HostTime, OffsetFilter};
use vizflyt_sdk::ImuSample;

use commands::{Answer, Command, Commands, Patience};
pub use events::{LinkEvent, advice};

/// What the link shall bring about.
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

/// One UDP payload.
#[derive(Clone, Copy, Debug)]
pub struct Datagram {
    bytes: [u8; MAX_PACKET],
    len: usize,
}

impl std::ops::Deref for Datagram {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

/// Our system id: the one whose heartbeats ArduCopter's ground station failsafe counts
/// (`MAV_GCS_SYSID`, default 255).
pub const SYSTEM_ID: u8 = 255;
/// Our component: MAV_COMP_ID_ONBOARD_COMPUTER.
pub const COMPONENT_ID: u8 = 191;

/// Heartbeats, origin and clock requests. [s]
const SECOND_S: f64 = 1.0;
/// An autopilot silent for this long is lost: three heartbeats. [s]
const LOST_AFTER_S: f64 = 3.0;
/// Least time between two external navigation poses: a little under 20 ms, as ArduCopter fuses at
/// most 50 a second. [s]
const VISION_PERIOD_S: f64 = 0.018;
/// Standard deviation stated with each pose. Mocap is better, but the filter needs slack. [m]
const VISION_SIGMA_M: f32 = 0.02;
/// Any place will do indoors: it only ties the local frame to the globe. ArduCopter's own
/// test field. [1e-7 degrees, 1e-7 degrees, mm]
const ORIGIN: (i32, i32, i32) = (-353_632_621, 1_491_652_374, 584_000);
/// A boot clock that falls by more than this has restarted. [ms]
const REBOOT_MS: u32 = 1000;
/// Datagrams waiting at most; the driver empties the queue at once, so this is never reached.
const OUTBOX: usize = 512;
/// Texts of the autopilot this young belong to a refusal. [s]
const TEXT_BELONGS_S: f64 = 3.0;
/// Texts remembered for that.
const TEXTS: usize = 8;

/// Messages we ask for, and how often. (id, period) [us]
const INTERVALS: [(u32, f32); 5] = [
    (30, 20_000.0),   // ATTITUDE
    (27, 10_000.0),   // RAW_IMU: 4 kB/s, which a serial link still carries
    (32, 20_000.0),   // LOCAL_POSITION_NED
    (193, 200_000.0), // EKF_STATUS_REPORT
    (1, 500_000.0),   // SYS_STATUS
];

/// The link. See the module.
pub struct Link {
    decoder: StreamDecoder,
    outbox: VecDeque<Datagram>,
    events: VecDeque<LinkEvent>,
    sequence: u8,
    sent_packets: u64,
    goal: Goal,
    commands: Commands,
    /// System and component of the autopilot; `None` before its first heartbeat and after a
    /// silence.
    autopilot: Option<(u8, u8)>,
    heard_at: HostTime,
    state: VehicleState,
    /// When the attitude in `state` was true.
    attitude_at: Option<HostTime>,
    /// The newest IMU samples, oldest first.
    imu: VecDeque<ImuSample>,
    /// HIGHRES_IMU comes: RAW_IMU, the same in whole numbers, is left aside.
    imu_is_fine: bool,
    clock: OffsetFilter<Host, Autopilot>,
    boot_ms: u32,
    origin_set: bool,
    ekf: EkfStatusFlags,
    /// `None` until SYS_STATUS told.
    prearm_ok: Option<bool>,
    took_off: bool,
    intervals_left: usize,
    vision_at: Option<HostTime>,
    beat_at: HostTime,
    texts: VecDeque<(HostTime, String)>,
}

impl Link {
    /// Makes a link at `now` that has heard nothing yet.
    pub fn new(now: HostTime) -> Self {
        Self {
            decoder: StreamDecoder::default(),
            outbox: VecDeque::new(),
            events: VecDeque::new(),
            sequence: 0,
            sent_packets: 0,
            goal: Goal::Prepare,
            commands: Commands::default(),
            autopilot: None,
            heard_at: now,
            state: VehicleState { battery_fraction: -1.0, ..VehicleState::default() },
            attitude_at: None,
            imu: VecDeque::new(),
            imu_is_fine: false,
            clock: OffsetFilter::default(),
            boot_ms: 0,
            origin_set: false,
            ekf: EkfStatusFlags::empty(),
            prearm_ok: None,
            took_off: false,
            intervals_left: 0,
            vision_at: None,
            beat_at: now,
            texts: VecDeque::new(),
        }
    }

    // ---- what goes in ----

    /// Takes bytes from the autopilot, in any portions.
    pub fn handle_input(&mut self, now: HostTime, bytes: &[u8]) {
        let mut packets = Vec::new();
        self.decoder.push(bytes, |packet| packets.push(packet));
        for packet in packets {
            self.handle_packet(now, &packet);
        }
        self.advance(now);
    }

    /// Does what is due at `now`.
    pub fn handle_timeout(&mut self, now: HostTime) {
        if now >= self.beat_at {
            self.beat_at = now.plus_seconds(SECOND_S);
            self.every_second(now);
        }
        if self.autopilot.is_some() && now.seconds_since(self.heard_at) > LOST_AFTER_S {
            self.autopilot = None;
            self.commands = Commands::default();
            self.events.push_back(LinkEvent::Lost);
        }
        self.advance(now);
    }

    /// Says what to bring about from `now` on. Repeating the same goal changes nothing.
    pub fn set_goal(&mut self, now: HostTime, goal: Goal) {
        if self.goal != goal {
            self.goal = goal;
            // A command of the former goal must not be repeated: arming after "land".
            self.commands.abandon();
            self.advance(now);
        }
    }

    /// Feeds a localized pose, true at `stamp`, as external navigation. Call it with every pose;
    /// it passes on at most 50 a second.
    pub fn vision(&mut self, now: HostTime, pose: &Pose<World, Body>, stamp: HostTime, resets: u8) {
        let due = self.vision_at.is_none_or(|at| now.seconds_since(at) >= VISION_PERIOD_S);
        if self.autopilot.is_some() && due && pose.is_valid() {
            self.vision_at = Some(now);
            // ArduCopter relates this clock to its own by itself.
            let usec = stamp.as_ns() / 1000;
            let message = vision_to_mavlink(pose, usec, resets, VISION_SIGMA_M);
            self.send(&MavMessage::VISION_POSITION_ESTIMATE(message));
        }
    }

    /// Sends a guarded setpoint; returns whether there is an autopilot to send it to.
    pub fn setpoint(&mut self, now: HostTime, setpoint: &GuidedSetpoint) -> bool {
        let Some(target) = self.autopilot else { return false };
        let message = guided_to_mavlink(setpoint, target, (now.as_ns() / 1_000_000) as u32);
        self.send(&MavMessage::SET_POSITION_TARGET_LOCAL_NED(message));
        true
    }

    // ---- what comes out ----

    /// Returns the next datagram to send to the autopilot.
    pub fn poll_transmit(&mut self) -> Option<Datagram> {
        self.outbox.pop_front()
    }

    /// Returns the next thing that happened.
    pub fn poll_event(&mut self) -> Option<LinkEvent> {
        self.events.pop_front()
    }

    /// Returns when [`Self::handle_timeout`] is due next.
    pub fn poll_timeout(&self) -> Option<HostTime> {
        let beat = self.beat_at;
        Some(self.commands.due_at().map_or(beat, |due| due.min(beat)))
    }

    /// Returns what the autopilot last said of the vehicle, in our frames.
    pub fn state(&self) -> &VehicleState {
        &self.state
    }

    /// Returns when the attitude in [`Self::state`] was true; `None` if none has come. [host]
    pub fn attitude_at(&self) -> Option<HostTime> {
        self.attitude_at
    }

    /// Returns the newest IMU samples, oldest first; at most [`MAX_IMU`].
    pub fn imu(&self) -> &VecDeque<ImuSample> {
        &self.imu
    }

    /// Whether the autopilot's heartbeats come.
    pub fn is_connected(&self) -> bool {
        self.autopilot.is_some()
    }

    /// Whether the autopilot has accepted the take-off.
    pub fn took_off(&self) -> bool {
        self.took_off
    }

    /// Returns the relation of the autopilot's clock to ours.
    pub fn clock(&self) -> &OffsetFilter<Host, Autopilot> {
        &self.clock
    }

    /// Returns packets sent and received since the start.
    pub fn packets(&self) -> u64 {
        self.sent_packets + self.decoder.stats().packets
    }

    /// Whether the vehicle may be armed.
    ///
    /// # Errors
    /// What it still waits for, in words.
    pub fn ready_to_arm(&self) -> Result<(), &'static str> {
        if self.autopilot.is_none() {
            return Err("no heartbeat from an autopilot; check power, link and --mavlink");
        }
        if !self.origin_set {
            return Err("the autopilot has not confirmed its origin yet");
        }
        if self.ekf.contains(EkfStatusFlags::EKF_CONST_POS_MODE)
            || !self.ekf.contains(EkfStatusFlags::EKF_POS_HORIZ_ABS)
        {
            return Err(
                "the autopilot's estimator has no position yet; external navigation needs \
                        VISO_TYPE=1 and EK3_SRC1_* = 6",
            );
        }
        match self.prearm_ok {
            Some(true) => Ok(()),
            Some(false) => Err("the autopilot's pre-arm checks fail"),
            None => Err("the autopilot has not reported its pre-arm checks yet"),
        }
    }

    // ---- inside ----

    fn handle_packet(&mut self, now: HostTime, packet: &Packet) {
        let from = (packet.header.system_id as u8, packet.header.component_id);
        if let MavMessage::HEARTBEAT(heartbeat) = &packet.message {
            self.handle_heartbeat(now, from, heartbeat);
            return;
        }
        // Ground stations, gimbals and other vehicles on the same network are not ours to hear.
        if self.autopilot != Some(from) {
            return;
        }
        self.heard_at = now;
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
            MavMessage::GPS_GLOBAL_ORIGIN(_) => self.origin_set = true,
            MavMessage::TIMESYNC(message) => self.handle_timesync(now, message),
            MavMessage::STATUSTEXT(message) => self.handle_text(now, message),
            MavMessage::COMMAND_ACK(message) => self.handle_ack(now, message),
            _ => {}
        }
    }

    fn handle_heartbeat(&mut self, now: HostTime, from: (u8, u8), heartbeat: &HEARTBEAT_DATA) {
        let copter = heartbeat.autopilot == MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
        match self.autopilot {
            None if copter => {
                self.autopilot = Some(from);
                self.forget();
                self.events.push_back(LinkEvent::Connected { system: from.0 });
            }
            Some(known) if known == from => {}
            _ => return,
        }
        self.heard_at = now;
        let armed = heartbeat.base_mode.contains(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED);
        if armed != self.state.armed {
            self.state.armed = armed;
            if !armed {
                self.took_off = false;
            }
            self.events.push_back(if armed { LinkEvent::Armed } else { LinkEvent::Disarmed });
        }
        if heartbeat.custom_mode != self.state.mode {
            self.state.mode = heartbeat.custom_mode;
            self.events.push_back(LinkEvent::Mode(heartbeat.custom_mode));
        }
    }

    /// Drops what a restarted autopilot does not know any more.
    fn forget(&mut self) {
        self.origin_set = false;
        self.ekf = EkfStatusFlags::empty();
        self.prearm_ok = None;
        self.took_off = false;
        self.boot_ms = 0;
        self.attitude_at = None;
        self.imu.clear();
        self.imu_is_fine = false;
        self.clock = OffsetFilter::default();
        self.intervals_left = INTERVALS.len();
        self.commands.abandon();
    }

    fn handle_boot_time(&mut self, boot_ms: u32) {
        if boot_ms.saturating_add(REBOOT_MS) < self.boot_ms {
            self.events.push_back(LinkEvent::Rebooted);
            self.forget();
        }
        self.boot_ms = boot_ms;
    }

    fn handle_imu(&mut self, now: HostTime, boot_us: u64, (accel, gyro): (DVec3, DVec3)) {
        if !(accel.is_finite() && gyro.is_finite()) {
            return;
        }
        let stamp = self.measured_at(now, boot_us.saturating_mul(1000));
        // Readers tell new samples by their stamps, so these must rise.
        if self.imu.back().is_some_and(|newest| newest.stamp >= stamp) {
            return;
        }
        if self.imu.len() == MAX_IMU {
            self.imu.pop_front();
        }
        self.imu.push_back(ImuSample { stamp, accel_mps2: accel, gyro_radps: gyro });
    }

    /// Returns when something was measured of which the autopilot says so on its clock; `now` as
    /// long as that clock is not known, and never later.
    fn measured_at(&self, now: HostTime, boot_ns: u64) -> HostTime {
        let at = self.clock.to_local(AutopilotTime::from_ns(boot_ns));
        at.filter(|&at| now.seconds_since(at).abs() < SECOND_S).map_or(now, |at| at.min(now))
    }

    fn handle_sys_status(&mut self, message: &SYS_STATUS_DATA) {
        let prearm = MavSysStatusSensor::MAV_SYS_STATUS_PREARM_CHECK;
        self.prearm_ok = Some(message.onboard_control_sensors_health.contains(prearm));
        // 65535 and -1 say "not measured".
        let millivolts = message.voltage_battery;
        self.state.battery_v =
            if millivolts == u16::MAX { 0.0 } else { f32::from(millivolts) / 1000.0 };
        let percent = message.battery_remaining;
        self.state.battery_fraction =
            if percent < 0 { -1.0 } else { (f32::from(percent) / 100.0).min(1.0) };
    }

    fn handle_timesync(&mut self, now: HostTime, message: &TIMESYNC_DATA) {
        if message.tc1 == 0 {
            let reply =
                TIMESYNC_DATA { tc1: now.as_ns() as i64, ts1: message.ts1, ..Default::default() };
            self.send(&MavMessage::TIMESYNC(reply));
        } else if let (Ok(theirs), Ok(ours)) =
            (u64::try_from(message.tc1), u64::try_from(message.ts1))
            // An answer to another companion's request carries another's clock.
            && now.seconds_since(HostTime::from_ns(ours)).abs() < 2.0 * SECOND_S
        {
            self.clock.update(HostTime::from_ns(ours), AutopilotTime::from_ns(theirs), now);
        }
    }

    fn handle_text(&mut self, now: HostTime, message: &STATUSTEXT_DATA) {
        let text = message.text.to_str().unwrap_or("(not UTF-8)").trim().to_owned();
        if self.texts.len() == TEXTS {
            self.texts.pop_front();
        }
        self.texts.push_back((now, text.clone()));
        self.events.push_back(LinkEvent::Text { severity: message.severity as u8, text });
    }

    fn handle_ack(&mut self, now: HostTime, ack: &COMMAND_ACK_DATA) {
        // Acknowledgements to other companions name them; zero is the old form, for everyone.
        let for_us = (ack.target_system == 0 || ack.target_system == SYSTEM_ID)
            && (ack.target_component == 0 || ack.target_component == COMPONENT_ID);
        if !for_us {
            return;
        }
        match self.commands.handle_ack(now, ack.command, ack.result) {
            Answer::Nothing => {}
            Answer::Accepted(command) => self.accepted(command),
            Answer::GivenUp { command, why } => self.given_up(now, command, &why),
        }
    }

    /// Takes an acceptance at its word; the next heartbeat says otherwise if it is not so.
    fn accepted(&mut self, command: Command) {
        match command {
            Command::Mode(mode) => self.state.mode = mode as u32,
            Command::Arm => {
                if !self.state.armed {
                    self.state.armed = true;
                    self.events.push_back(LinkEvent::Armed);
                }
            }
            Command::TakeOff(_) => {
                self.took_off = true;
                self.events.push_back(LinkEvent::TakingOff);
            }
            Command::Land => self.state.mode = CopterMode::Land as u32,
            Command::Interval(..) => self.intervals_left -= 1,
        }
    }

    fn given_up(&mut self, now: HostTime, command: Command, why: &str) {
        if let Command::Interval(..) = command {
            // An autopilot that does not send it at our rate may still send it at its own.
            self.intervals_left -= 1;
            return;
        }
        let said: Vec<&str> = self
            .texts
            .iter()
            .filter(|(at, _)| now.seconds_since(*at) <= TEXT_BELONGS_S)
            .map(|(_, text)| text.as_str())
            .collect();
        let text = events::refusal(command.name(), why, &said);
        self.events.push_back(LinkEvent::Refused(text));
    }

    /// Sends the command that the goal needs next, or repeats the one under way.
    fn advance(&mut self, now: HostTime) {
        let Some(target) = self.autopilot else { return };
        if let Answer::GivenUp { command, why } = self.commands.handle_timeout(now) {
            self.given_up(now, command, &why);
        }
        let guided = self.state.mode == CopterMode::Guided as u32;
        let landing = self.state.mode == CopterMode::Land as u32;
        let wanted = match self.goal {
            Goal::TakeOff(_) if !guided => Some(Command::Mode(CopterMode::Guided)),
            Goal::TakeOff(_) if !self.state.armed => Some(Command::Arm),
            Goal::TakeOff(height_m) if !self.took_off => Some(Command::TakeOff(height_m)),
            // By command first, by mode next, in turn until one of them works.
            Goal::Land if self.state.armed && !landing => Some(if self.commands.is_odd_try() {
                Command::Mode(CopterMode::Land)
            } else {
                Command::Land
            }),
            _ if self.intervals_left > 0 => {
                let (id, period_us) = INTERVALS[INTERVALS.len() - self.intervals_left];
                Some(Command::Interval(id, period_us))
            }
            _ => None,
        };
        let patience = if self.goal == Goal::Land { Patience::Endless } else { Patience::Bounded };
        if let Some(command) = wanted
            && let Some(confirmation) = self.commands.start(now, command, patience)
        {
            let mut message = command.message();
            (message.target_system, message.target_component) = target;
            message.confirmation = confirmation;
            self.send(&MavMessage::COMMAND_LONG(message));
        }
    }

    fn every_second(&mut self, now: HostTime) {
        let Some((system, component)) = self.autopilot else {
            // Heartbeats also tell a bridge or an autopilot that waits where we are.
            return self.send_heartbeat();
        };
        self.send_heartbeat();
        let request = TIMESYNC_DATA {
            tc1: 0,
            ts1: now.as_ns() as i64,
            target_system: system,
            target_component: component,
        };
        self.send(&MavMessage::TIMESYNC(request));
        if !self.origin_set {
            self.send(&MavMessage::SET_GPS_GLOBAL_ORIGIN(SET_GPS_GLOBAL_ORIGIN_DATA {
                latitude: ORIGIN.0,
                longitude: ORIGIN.1,
                altitude: ORIGIN.2,
                target_system: system,
                time_usec: now.as_ns() / 1000,
            }));
        }
    }

    fn send_heartbeat(&mut self) {
        self.send(&MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            custom_mode: 0,
            mavtype: MavType::MAV_TYPE_ONBOARD_CONTROLLER,
            autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
            base_mode: MavModeFlag::empty(),
            system_status: MavState::MAV_STATE_ACTIVE,
            mavlink_version: 3,
        }));
    }

    fn send(&mut self, message: &MavMessage) {
        if self.outbox.len() >= OUTBOX {
            self.outbox.pop_front();
        }
        let header = MavHeader {
            system_id: SYSTEM_ID.into(),
            component_id: COMPONENT_ID,
            sequence: self.sequence,
        };
        self.sequence = self.sequence.wrapping_add(1);
        let mut bytes = [0; MAX_PACKET];
        let len = encode(header, message, &mut bytes).len();
        self.outbox.push_back(Datagram { bytes, len });
        self.sent_packets += 1;
    }
}

impl Command {
    /// Returns the message without target and confirmation.
    fn message(self) -> COMMAND_LONG_DATA {
        let mut message = COMMAND_LONG_DATA { command: self.mavlink(), ..Default::default() };
        match self {
            Self::Mode(mode) => {
                message.param1 = f32::from(MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED.bits());
                message.param2 = mode as u32 as f32;
            }
            Self::Arm => message.param1 = 1.0,
            Self::TakeOff(height_m) => message.param7 = height_m,
            Self::Land => {}
            Self::Interval(id, period_us) => {
                message.param1 = id as f32;
                message.param2 = period_us;
            }
        }
        message
    }

    fn mavlink(self) -> MavCmd {
        match self {
            Self::Mode(_) => MavCmd::MAV_CMD_DO_SET_MODE,
            Self::Arm => MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
            Self::TakeOff(_) => MavCmd::MAV_CMD_NAV_TAKEOFF,
            Self::Land => MavCmd::MAV_CMD_NAV_LAND,
            Self::Interval(..) => MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
        }
    }
}
