//! Handles received messages: commands with acknowledgements, setpoints, vision, parameters.

use vizflyt_protocol::mavlink::{
    CopterMode, Packet, dialect, vision_from_mavlink, world_from_ned, world_rotation_from_ned,
};
use vizflyt_protocol::time::AutopilotTime;

use super::dialect::{MavCmd, MavMessage, MavResult, MavSeverity};
use super::failsafe::needs_position;
use super::signing::Signing;
use super::telemetry::autopilot_version;
use super::{
    AUTOPILOT_COMPONENT, Autopilot, Guided, Landing, Param, Params, Return, TABLE, name_of,
};
use crate::estimator::VisionMeasurement;
use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::messages::YawTarget;

/// Values of param2 that force arming or disarming without checks (ArduPilot's magic numbers).
const FORCE_ARM: f32 = 2989.0;
const FORCE_DISARM: f32 = 21196.0;
/// Value of param6 that forces a reboot while armed.
const FORCE_REBOOT: f32 = 20_190_226.0;

/// Value of EK3_SRC1_POSXY for external navigation.
const EXTERNAL_NAVIGATION: f64 = 6.0;

/// Command from COMMAND_LONG or COMMAND_INT.
struct Command {
    kind: MavCmd,
    params: [f32; 7],
    sender: (u8, u8),
}

impl Autopilot {
    pub(super) fn handle_packet(&mut self, now: AutopilotTime, packet: &Packet) {
        let sender = (packet.header.system_id as u8, packet.header.component_id);
        if self.handle_mission(now, sender, &packet.message) {
            return;
        }
        match &packet.message {
            MavMessage::HEARTBEAT(_)
                if f64::from(sender.0) == self.params.value(Param::GcsSystemId) =>
            {
                self.last_ground_station = Some(now);
            }
            MavMessage::COMMAND_LONG(m) if self.is_for_us(m.target_system, m.target_component) => {
                let params = [m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7];
                self.handle_command(now, &Command { kind: m.command, params, sender });
            }
            MavMessage::COMMAND_INT(m) if self.is_for_us(m.target_system, m.target_component) => {
                let params = [m.param1, m.param2, m.param3, m.param4, m.x as f32, m.y as f32, m.z];
                self.handle_command(now, &Command { kind: m.command, params, sender });
            }
            MavMessage::SETUP_SIGNING(m) if self.is_for_us(m.target_system, m.target_component) => {
                self.signing = Signing::set_up(now, m);
            }
            MavMessage::SET_MODE(m) if m.target_system == self.system_id() => {
                self.change_mode(now, m.custom_mode);
            }
            MavMessage::SET_POSITION_TARGET_LOCAL_NED(m)
                if self.is_for_us(m.target_system, m.target_component) =>
            {
                self.handle_setpoint(now, m);
            }
            MavMessage::VISION_POSITION_ESTIMATE(m) => {
                let variance = m.covariance[0];
                let pose = vision_from_mavlink(m);
                self.handle_vision(now, pose, m.usec, m.reset_counter, variance);
            }
            MavMessage::ODOMETRY(m) => {
                // Positions in a local north-east-down (or forward-right-down) frame.
                let p = DVec3::new(m.x.into(), m.y.into(), m.z.into());
                let [w, x, y, z] = m.q.map(f64::from);
                let q = DQuat::from_xyzw(x, y, z, w);
                if q.is_finite() && q.length_squared() > 0.5 {
                    let pose = Pose::new(world_from_ned(p), world_rotation_from_ned(q.normalize()));
                    let variance = m.pose_covariance[0];
                    self.handle_vision(now, pose, m.time_usec, m.reset_counter, variance);
                }
            }
            MavMessage::SET_GPS_GLOBAL_ORIGIN(m) if m.target_system == self.system_id() => {
                self.handle_origin(now, (m.latitude, m.longitude, m.altitude));
            }
            // tc1 = 0 is a request; other values are replies to other systems.
            MavMessage::TIMESYNC(m)
                if m.tc1 == 0 && self.is_for_us(m.target_system, m.target_component) =>
            {
                self.send(MavMessage::TIMESYNC(dialect::TIMESYNC_DATA {
                    tc1: now.as_ns().cast_signed(),
                    ts1: m.ts1,
                    target_system: sender.0,
                    target_component: sender.1,
                }));
            }
            MavMessage::PARAM_REQUEST_LIST(m)
                if self.is_for_us(m.target_system, m.target_component) =>
            {
                for index in 0..TABLE.len() {
                    self.send_param(index);
                }
            }
            MavMessage::PARAM_REQUEST_READ(m)
                if self.is_for_us(m.target_system, m.target_component) =>
            {
                let index = match usize::try_from(m.param_index) {
                    Ok(index) => Some(index),
                    Err(_) => m.param_id.to_str().ok().and_then(Params::index_of),
                };
                if let Some(index) = index {
                    self.send_param(index);
                }
            }
            MavMessage::PARAM_SET(m) if self.is_for_us(m.target_system, m.target_component) => {
                if let Some(index) = m.param_id.to_str().ok().and_then(Params::index_of) {
                    self.params.set(index, m.param_value);
                    self.send_param(index);
                }
            }
            MavMessage::REQUEST_DATA_STREAM(m)
                if self.is_for_us(m.target_system, m.target_component) =>
            {
                let rate_hz = if m.start_stop == 0 { 0 } else { m.req_message_rate };
                self.streams.request_group(m.req_stream_id, rate_hz);
            }
            _ => {}
        }
    }

    pub(super) fn is_for_us(&self, system: u8, component: u8) -> bool {
        (system == 0 || system == self.system_id())
            && (component == 0 || component == AUTOPILOT_COMPONENT)
    }

    fn handle_command(&mut self, now: AutopilotTime, c: &Command) {
        let [p1, p2, ..] = c.params;
        let result = match c.kind {
            MavCmd::MAV_CMD_DO_SET_MODE => self.change_mode(now, p2 as u32),
            MavCmd::MAV_CMD_COMPONENT_ARM_DISARM if p1 == 1.0 => self.arm(now, p2 == FORCE_ARM),
            MavCmd::MAV_CMD_COMPONENT_ARM_DISARM if p1 == 0.0 => {
                self.disarm_on_command(p2 == FORCE_DISARM)
            }
            MavCmd::MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN => {
                self.reboot_on_command(p1, c.params[5] == FORCE_REBOOT)
            }
            MavCmd::MAV_CMD_DO_FENCE_ENABLE if p1 == 0.0 || p1 == 1.0 => {
                self.params.set(Param::FenceEnable as usize, p1);
                MavResult::MAV_RESULT_ACCEPTED
            }
            MavCmd::MAV_CMD_NAV_TAKEOFF => self.take_off(now, f64::from(c.params[6])),
            MavCmd::MAV_CMD_NAV_LAND => self.change_mode(now, CopterMode::Land as u32),
            MavCmd::MAV_CMD_NAV_RETURN_TO_LAUNCH => self.change_mode(now, CopterMode::Rtl as u32),
            MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL => {
                if self.streams.set_interval(p1 as u32, p2) {
                    MavResult::MAV_RESULT_ACCEPTED
                } else {
                    MavResult::MAV_RESULT_FAILED
                }
            }
            MavCmd::MAV_CMD_GET_MESSAGE_INTERVAL => {
                let id = p1 as u16;
                let interval_us = self.streams.interval_us(u32::from(id)).unwrap_or(0);
                self.send(MavMessage::MESSAGE_INTERVAL(dialect::MESSAGE_INTERVAL_DATA {
                    interval_us,
                    message_id: id,
                }));
                MavResult::MAV_RESULT_ACCEPTED
            }
            MavCmd::MAV_CMD_REQUEST_MESSAGE => match self.message(now, p1 as u32) {
                Some(message) => {
                    self.send(message);
                    MavResult::MAV_RESULT_ACCEPTED
                }
                None => MavResult::MAV_RESULT_FAILED,
            },
            MavCmd::MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES => {
                self.send(autopilot_version());
                MavResult::MAV_RESULT_ACCEPTED
            }
            _ => MavResult::MAV_RESULT_UNSUPPORTED,
        };
        self.send(MavMessage::COMMAND_ACK(dialect::COMMAND_ACK_DATA {
            command: c.kind,
            result,
            target_system: c.sender.0,
            target_component: c.sender.1,
            ..Default::default()
        }));
    }

    fn change_mode(&mut self, now: AutopilotTime, number: u32) -> MavResult {
        let Some(mode) = CopterMode::from_number(number) else {
            let text = format!("Mode change failed: no mode {number}");
            self.send_status_text(MavSeverity::MAV_SEVERITY_WARNING, &text);
            return MavResult::MAV_RESULT_FAILED;
        };
        // A disarmed vehicle accepts any mode; the arming checks follow later.
        if self.armed && needs_position(mode) && !self.estimator.health(now).position {
            let text = format!("Mode change to {} failed: requires position", name_of(mode));
            self.send_status_text(MavSeverity::MAV_SEVERITY_WARNING, &text);
            return MavResult::MAV_RESULT_FAILED;
        }
        self.enter(mode);
        MavResult::MAV_RESULT_ACCEPTED
    }

    /// Enters a mode. Has no effect if the mode is the present one.
    pub(super) fn enter(&mut self, mode: CopterMode) {
        if mode != self.mode {
            tracing::info!(target: "autopilot", "mode {}", name_of(mode));
            self.mode = mode;
            self.guided = Guided::Hold;
            self.returning = Return::Climb;
            self.landing = Landing { began: self.now, pauses: false };
            self.flight.yaw = YawTarget::Keep;
            self.streams.heartbeat_now();
        }
    }

    fn handle_vision(
        &mut self,
        now: AutopilotTime,
        world_from_body: Pose<World, Body>,
        usec: u64,
        reset_counter: u8,
        variance_m2: f32,
    ) {
        if self.params.value(Param::VisoType) == 0.0 {
            return;
        }
        // Received, but not used, unless external navigation is the source.
        if self.params.value(Param::Ek3PosXy) != EXTERNAL_NAVIGATION {
            self.estimator.note_vision_alive(now);
            return;
        }
        let least_m = self.params.value(Param::VisoPosNoise);
        // Senders without a covariance send NaN.
        let sigma_m = f64::from(variance_m2).max(0.0).sqrt().clamp(least_m, 100.0);
        let measurement = VisionMeasurement {
            world_from_body,
            usec,
            reset_counter,
            sigma_m: if sigma_m.is_finite() { sigma_m } else { least_m },
            sigma_rad: self.params.value(Param::VisoYawNoise),
            latency_s: self.params.value(Param::VisoDelayMs) / 1000.0,
        };
        self.estimator.handle_vision(now, &measurement);
    }

    fn handle_origin(&mut self, now: AutopilotTime, origin: (i32, i32, i32)) {
        let (latitude, longitude, _) = origin;
        let on_earth = (-900_000_000..=900_000_000).contains(&latitude)
            && (-1_800_000_000..=1_800_000_000).contains(&longitude);
        if on_earth && self.estimator.set_origin() {
            self.origin = Some(origin);
            self.send_status_text(MavSeverity::MAV_SEVERITY_INFO, "EKF3 IMU0 origin set");
        }
        // Answered even if already set, because the first answer may have been lost.
        if let Some(message) = self.message(now, super::streams::GPS_GLOBAL_ORIGIN) {
            self.send(message);
        }
    }

    fn send_param(&mut self, index: usize) {
        if let Some((spec, value)) = self.params.at(index) {
            self.send(MavMessage::PARAM_VALUE(dialect::PARAM_VALUE_DATA {
                param_value: value,
                param_count: TABLE.len() as u16,
                param_index: index as u16,
                param_id: spec.name.into(),
                param_type: spec.kind,
            }));
        }
    }
}
