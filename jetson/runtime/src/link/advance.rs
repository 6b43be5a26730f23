//! Next message to send: the command that the goal needs, and the messages due every second.

// Why: SET_GPS_GLOBAL_ORIGIN is formally superseded (2025-04), but every ArduCopter accepts it.
#![allow(deprecated)]

use glam::DVec3;
use vizflyt_protocol::geometry::yaw_of;
use vizflyt_protocol::mavlink::dialect::{
    COMMAND_LONG_DATA, HEARTBEAT_DATA, MISSION_COUNT_DATA, MavAutopilot, MavCmd, MavMessage,
    MavMissionType, MavModeFlag, MavSeverity, MavState, MavType, PARAM_REQUEST_LIST_DATA,
    PARAM_REQUEST_READ_DATA, PARAM_SET_DATA, SET_GPS_GLOBAL_ORIGIN_DATA, STATUSTEXT_DATA,
    TIMESYNC_DATA,
};
use vizflyt_protocol::mavlink::{CopterMode, GuidedMotion, GuidedSetpoint, guided_to_mavlink};
use vizflyt_protocol::messages::YawTarget;
use vizflyt_protocol::time::HostTime;

use super::commands::{Command, CommandOutcome, Patience};
use super::companions::ANNOUNCES;
use super::dialect::Rise;
use super::params::Request;
use super::rates::RateAction;
use super::{FenceEvent, Goal, Link, LinkEvent, Rising, Target};

/// Origin of the local frame on the globe. Indoors, any position works: ArduCopter's test field. [1e-7 degrees, 1e-7
/// degrees, mm]
const ORIGIN: (i32, i32, i32) = (-353_632_621, 1_491_652_374, 584_000);
/// Period of setpoints during take-off: 20 Hz. PX4 enters OFFBOARD only after a second of setpoints at more than 2 Hz.
/// [s]
const RISE_PERIOD_S: f64 = 0.05;
/// Duration of the stream before the mode change is requested. [s]
const RISE_LEAD_S: f64 = 1.2;
/// Period of announcing our name while another companion commands the vehicle. [s]
const ANNOUNCE_S: f64 = 5.0;
/// Period of requests for pre-arm texts while checks fail; without requests, ArduCopter sends them every 30 s. [s]
const PREARM_S: f64 = 5.0;

impl Link {
    /// Sends the command that the goal needs next, or repeats the command in progress.
    pub(super) fn advance(&mut self, now: HostTime) {
        let Some(target) = self.autopilot else { return };
        if let CommandOutcome::GivenUp { command, why } = self.commands.handle_timeout(now) {
            self.given_up(now, command, &why);
        }
        self.advance_params(now, target);
        self.advance_fence(now, target);
        let Some(command) = self.wanted(now, target) else { return };
        let endless = self.goal == Goal::Land && !command.is_chore();
        let patience = if endless { Patience::Endless } else { Patience::Bounded };
        if let Some(confirmation) = self.commands.start(now, command, patience) {
            let mut message = self.message(command);
            message.confirmation = confirmation;
            self.send_command(now, target, message);
        }
    }

    fn wanted(&mut self, now: HostTime, target: Target) -> Option<Command> {
        let guided = self.state.mode == CopterMode::Guided as u32;
        let landing = self.state.mode == CopterMode::Land as u32;
        let chore = self.chores.front().copied();
        if self.goal_is_stale || self.own_mode.is_hands_off(self.goal) {
            return chore;
        }
        match self.goal {
            Goal::TakeOff(height_m) if self.dialect.rise() == Rise::BySetpoint => {
                self.rise(now, target, height_m)
            }
            Goal::TakeOff(_) if !guided => Some(Command::Mode(CopterMode::Guided)),
            Goal::TakeOff(_) if !self.state.armed => Some(Command::Arm),
            Goal::TakeOff(height_m) if !self.took_off => Some(Command::TakeOff(height_m)),
            // Alternate between command and mode until one of them works.
            Goal::Land if self.state.armed && !landing => Some(if self.commands.is_odd_try() {
                Command::Mode(CopterMode::Land)
            } else {
                Command::Land
            }),
            _ => chore,
        }
    }

    /// Streams the take-off setpoint; returns the command that is needed in addition.
    fn rise(&mut self, now: HostTime, target: Target, height_m: f32) -> Option<Command> {
        if !self.position_known {
            return self.chores.front().copied();
        }
        let rising = *self.rising.get_or_insert_with(|| {
            let p_world_m = self.state.p_world_m + DVec3::Z * f64::from(height_m);
            let setpoint = GuidedSetpoint {
                motion: GuidedMotion::Position(p_world_m),
                yaw: YawTarget::Angle(yaw_of(self.state.world_from_body)),
            };
            Rising { setpoint, since: now, due_at: now }
        });
        if now >= rising.due_at {
            let boot_ms = (now.as_ns() / 1_000_000) as u32;
            let to = (target.system, target.component);
            let message = guided_to_mavlink(&rising.setpoint, to, boot_ms);
            self.send(now, &MavMessage::SET_POSITION_TARGET_LOCAL_NED(message));
            self.rising = Some(Rising { due_at: now.plus_seconds(RISE_PERIOD_S), ..rising });
        }
        if now.seconds_since(rising.since) < RISE_LEAD_S {
            return None;
        }
        if self.state.mode != CopterMode::Guided as u32 {
            Some(Command::Mode(CopterMode::Guided))
        } else if !self.state.armed {
            Some(Command::Arm)
        } else {
            if !self.took_off {
                self.rose();
            }
            None
        }
    }

    fn advance_params(&mut self, now: HostTime, target: Target) {
        let mut requests = Vec::new();
        if let Some(event) = self.params.poll(now, |request| requests.push(request)) {
            self.param_event(event);
        }
        let (target_system, target_component) = (target.system, target.component);
        for request in requests {
            let message = match request {
                Request::List => MavMessage::PARAM_REQUEST_LIST(PARAM_REQUEST_LIST_DATA {
                    target_system,
                    target_component,
                }),
                Request::ByIndex(index) => {
                    MavMessage::PARAM_REQUEST_READ(PARAM_REQUEST_READ_DATA {
                        param_index: index as i16,
                        target_system,
                        target_component,
                        ..Default::default()
                    })
                }
                Request::ByName(name) => MavMessage::PARAM_REQUEST_READ(PARAM_REQUEST_READ_DATA {
                    param_index: -1,
                    param_id: name.as_str().into(),
                    target_system,
                    target_component,
                }),
                Request::Set { name, value, kind } => MavMessage::PARAM_SET(PARAM_SET_DATA {
                    param_value: self.dialect.value_to_wire(value, kind),
                    param_id: name.as_str().into(),
                    param_type: kind,
                    target_system,
                    target_component,
                }),
            };
            self.send(now, &message);
        }
    }

    /// Offers the fence polygons, but only on the ground: the fence of a flying vehicle must not change.
    fn advance_fence(&mut self, now: HostTime, target: Target) {
        if !self.dialect.keeps_polygons() {
            if self.fence.give_up() {
                let why = "it has no global position when it flies by external navigation";
                self.events.push_back(LinkEvent::Fence(FenceEvent::Rejected(why.to_owned())));
            }
            return;
        }
        // Parameters first: a serial link has capacity for one conversation at a time.
        if self.state.armed || self.params.is_talking() {
            return;
        }
        match self.fence.poll(now) {
            Some(Ok(count)) => {
                let message = MISSION_COUNT_DATA {
                    count,
                    target_system: target.system,
                    target_component: target.component,
                    mission_type: MavMissionType::MAV_MISSION_TYPE_FENCE,
                    ..Default::default()
                };
                self.send(now, &MavMessage::MISSION_COUNT(message));
            }
            Some(Err(event)) => self.events.push_back(LinkEvent::Fence(event)),
            None => {}
        }
    }

    pub(super) fn every_second(&mut self, now: HostTime) {
        if let Some(signatures) = &mut self.signatures {
            while let Some((fault, count)) = signatures.poll_refused(now) {
                self.events.push_back(LinkEvent::NotSigned { fault, count });
            }
        }
        let Some(target) = self.autopilot else { return };
        let request = TIMESYNC_DATA {
            tc1: 0,
            ts1: now.as_ns() as i64,
            target_system: target.system,
            target_component: target.component,
        };
        self.note_clock_request(request.ts1);
        self.send(now, &MavMessage::TIMESYNC(request));
        if self.dialect.needs_origin() && self.origin.is_none() {
            self.send(
                now,
                &MavMessage::SET_GPS_GLOBAL_ORIGIN(SET_GPS_GLOBAL_ORIGIN_DATA {
                    latitude: ORIGIN.0,
                    longitude: ORIGIN.1,
                    altitude: ORIGIN.2,
                    target_system: target.system,
                    time_usec: now.as_ns() / 1000,
                }),
            );
        }
        self.check_rates(now);
        self.report_delay(now);
        self.announce(now);
        self.request_prearm_texts(now, target);
    }

    fn check_rates(&mut self, now: HostTime) {
        let (chores, events) = (&mut self.chores, &mut self.events);
        // A non-empty queue already requests the streams.
        let may_ask = chores.is_empty();
        self.rates.check(now, |action| match action {
            RateAction::Request((id, period_us)) if may_ask => {
                chores.push_back(Command::Interval(id, period_us));
            }
            RateAction::Request(_) => {}
            RateAction::Slow(rate) => events.push_back(LinkEvent::Slow(rate)),
        });
    }

    /// Compares the latency of external navigation with the autopilot's setting, once, on the ground.
    fn report_delay(&mut self, now: HostTime) {
        if self.delay_reported || self.state.armed || self.params.is_busy() {
            return;
        }
        if let Some(delay) = self.delay(now) {
            self.delay_reported = true;
            if !delay.is_close() {
                self.events.push_back(LinkEvent::Delay(delay));
            }
        }
    }

    /// Announces our name to other companions on the vehicle: once, and periodically while there are others.
    fn announce(&mut self, now: HostTime) {
        let due = match self.announced_at {
            None => true,
            Some(at) => now.seconds_since(at) >= ANNOUNCE_S && self.companions.other(now).is_some(),
        };
        if due && !self.settings.name.is_empty() {
            self.announced_at = Some(now);
            let text = self.own_name();
            self.send(
                now,
                &MavMessage::STATUSTEXT(STATUSTEXT_DATA {
                    severity: MavSeverity::MAV_SEVERITY_INFO,
                    text: text.as_str().into(),
                    ..Default::default()
                }),
            );
        }
    }

    fn own_name(&self) -> String {
        let mut text = format!("{ANNOUNCES}{}", self.settings.name);
        while text.len() > 50 {
            text.pop();
        }
        text
    }

    /// Whether a text is an echo of our announcement.
    pub(super) fn is_own_name(&self, text: &str) -> bool {
        !self.settings.name.is_empty() && text == self.own_name()
    }

    /// Requests the texts of failing pre-arm checks.
    fn request_prearm_texts(&mut self, now: HostTime, target: Target) {
        let due = self.prearm.asked_at.is_none_or(|at| now.seconds_since(at) >= PREARM_S);
        let wanted = self.prearm.ok == Some(false) && self.goal == Goal::Prepare;
        if wanted && due && !self.prearm.is_unsupported && !self.state.armed {
            self.prearm.asked_at = Some(now);
            let command = MavCmd::MAV_CMD_RUN_PREARM_CHECKS;
            self.send_command(now, target, COMMAND_LONG_DATA { command, ..Default::default() });
        }
    }

    fn send_command(&mut self, now: HostTime, target: Target, mut message: COMMAND_LONG_DATA) {
        (message.target_system, message.target_component) = (target.system, target.component);
        self.commanded.retain(|(command, _)| *command != message.command);
        self.commanded.push((message.command, now));
        self.send(now, &MavMessage::COMMAND_LONG(message));
    }

    pub(super) fn send_heartbeat(&mut self, now: HostTime) {
        let heartbeat = HEARTBEAT_DATA {
            // Companions do not use this field; we use it to distinguish two runtimes.
            custom_mode: self.companions.own(),
            mavtype: MavType::MAV_TYPE_ONBOARD_CONTROLLER,
            autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
            base_mode: MavModeFlag::empty(),
            system_status: MavState::MAV_STATE_ACTIVE,
            mavlink_version: 3,
        };
        self.send(now, &MavMessage::HEARTBEAT(heartbeat));
    }

    /// Returns the message of a command, without target and confirmation.
    fn message(&self, command: Command) -> COMMAND_LONG_DATA {
        let mut message = COMMAND_LONG_DATA { command: command.mavlink(), ..Default::default() };
        match command {
            Command::Mode(mode) => {
                message.param1 = f32::from(MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED.bits());
                (message.param2, message.param3) = self.dialect.mode_parameters(mode);
            }
            Command::Arm => message.param1 = 1.0,
            Command::TakeOff(height_m) => message.param7 = height_m,
            Command::Land => {}
            Command::Interval(id, period_us) => {
                message.param1 = id as f32;
                message.param2 = period_us;
            }
            Command::Message(id) => message.param1 = id as f32,
        }
        message
    }
}
