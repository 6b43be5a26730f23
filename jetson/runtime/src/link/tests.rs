//! Tests of the link against a scripted autopilot on a virtual clock.

// Why: SET_GPS_GLOBAL_ORIGIN is formally superseded (2025-04), but every ArduCopter accepts it.
#![allow(deprecated)]

mod distances;
mod fence;
mod imu;
mod px4;
mod refusals;
mod signed;
mod vehicles;

use glam::DVec3;
use glam::{DQuat, Vec3};
use proptest::prelude::*;
use vizflyt_protocol::geometry::Pose;
use vizflyt_protocol::mavlink::dialect::{
    COMMAND_ACK_DATA, COMMAND_LONG_DATA, EKF_STATUS_REPORT_DATA, GPS_GLOBAL_ORIGIN_DATA,
    HEARTBEAT_DATA, LOCAL_POSITION_NED_DATA, MavAutopilot, MavModeFlag, MavResult, MavSeverity,
    MavState, MavType, STATUSTEXT_DATA, SYS_STATUS_DATA, TIMESYNC_DATA,
};
use vizflyt_protocol::mavlink::{GuidedMotion, local_position_to_mavlink};
use vizflyt_protocol::messages::YawTarget;
use vizflyt_protocol::time::ServerTime;

use super::*;

/// Autopilot's end of the link.
struct Script {
    link: Link,
    now: HostTime,
    decoder: StreamDecoder,
    sequence: u8,
    sent: Vec<MavMessage>,
    events: Vec<LinkEvent>,
    kind: MavAutopilot,
    mode: u32,
    armed: bool,
    /// Reply to a command; `None`: the script stays silent.
    answer: fn(MavCmd) -> Option<MavResult>,
    chunk: usize,
}

const AUTOPILOT: (u8, u8) = (1, 1);
/// Commands that no goal needs.
const CHORES: [MavCmd; 3] = [
    MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
    MavCmd::MAV_CMD_REQUEST_MESSAGE,
    MavCmd::MAV_CMD_RUN_PREARM_CHECKS,
];

#[allow(clippy::unnecessary_wraps)] // Why: one of the answers a script may give.
fn accept(_: MavCmd) -> Option<MavResult> {
    Some(MavResult::MAV_RESULT_ACCEPTED)
}

impl Script {
    fn new() -> Self {
        Self::with(LinkSettings::default())
    }

    fn with(settings: LinkSettings) -> Self {
        let now = HostTime::from_ns(5_000_000_000);
        Self {
            link: Link::with(now, settings),
            now,
            decoder: StreamDecoder::default(),
            sequence: 0,
            sent: Vec::new(),
            events: Vec::new(),
            kind: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
            mode: 0,
            armed: false,
            answer: accept,
            chunk: 1000,
        }
    }

    /// Returns a script that is connected and ready to arm.
    fn ready() -> Self {
        let mut script = Self::new();
        script.heartbeat();
        script.inject(&MavMessage::GPS_GLOBAL_ORIGIN(GPS_GLOBAL_ORIGIN_DATA::default()));
        script.estimator(EkfStatusFlags::EKF_POS_HORIZ_ABS | EkfStatusFlags::EKF_POS_HORIZ_REL);
        script.prearm(true);
        script.run(1.0);
        script
    }

    fn bytes_of(&mut self, from: (u8, u8), message: &MavMessage) -> Vec<u8> {
        self.sequence = self.sequence.wrapping_add(1);
        let header =
            MavHeader { system_id: from.0.into(), component_id: from.1, sequence: self.sequence };
        encode(header, message, &mut [0; MAX_PACKET]).to_vec()
    }

    fn inject_from(&mut self, from: (u8, u8), message: &MavMessage) {
        let bytes = self.bytes_of(from, message);
        for part in bytes.chunks(self.chunk) {
            self.link.handle_input(self.now, part);
        }
        self.drain();
    }

    fn inject(&mut self, message: &MavMessage) {
        self.inject_from(AUTOPILOT, message);
    }

    fn heartbeat(&mut self) {
        let mut base_mode = MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED;
        base_mode.set(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED, self.armed);
        self.inject(&MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            custom_mode: self.mode,
            mavtype: MavType::MAV_TYPE_QUADROTOR,
            autopilot: self.kind,
            base_mode,
            system_status: MavState::MAV_STATE_STANDBY,
            mavlink_version: 3,
        }));
    }

    fn estimator(&mut self, flags: EkfStatusFlags) {
        self.inject(&MavMessage::EKF_STATUS_REPORT(EKF_STATUS_REPORT_DATA {
            flags,
            ..Default::default()
        }));
    }

    fn prearm(&mut self, good: bool) {
        let mut health = MavSysStatusSensor::empty();
        health.set(MavSysStatusSensor::MAV_SYS_STATUS_PREARM_CHECK, good);
        self.inject(&MavMessage::SYS_STATUS(SYS_STATUS_DATA {
            onboard_control_sensors_health: health,
            voltage_battery: 15_200,
            battery_remaining: 80,
            ..Default::default()
        }));
    }

    fn text(&mut self, text: &str) {
        self.inject(&MavMessage::STATUSTEXT(STATUSTEXT_DATA {
            severity: MavSeverity::MAV_SEVERITY_CRITICAL,
            text: text.into(),
            ..Default::default()
        }));
    }

    /// Receives what the link sent and answers its commands.
    fn drain(&mut self) {
        loop {
            let mut received = Vec::new();
            while let Some(datagram) = self.link.poll_transmit() {
                self.decoder.push(&datagram, |packet| {
                    assert_eq!((packet.header.system_id, packet.header.component_id), (255, 191));
                    received.push(packet.message);
                });
            }
            while let Some(event) = self.link.poll_event() {
                self.events.push(event);
            }
            if received.is_empty() {
                return;
            }
            for message in received {
                if let MavMessage::COMMAND_LONG(command) = &message
                    && let Some(result) = (self.answer)(command.command)
                {
                    if result == MavResult::MAV_RESULT_ACCEPTED {
                        self.obey(command);
                    }
                    let ack = COMMAND_ACK_DATA {
                        command: command.command,
                        result,
                        target_system: 255,
                        target_component: 191,
                        ..Default::default()
                    };
                    let bytes = self.bytes_of(AUTOPILOT, &MavMessage::COMMAND_ACK(ack));
                    self.link.handle_input(self.now, &bytes);
                }
                self.sent.push(message);
            }
        }
    }

    fn obey(&mut self, command: &COMMAND_LONG_DATA) {
        match command.command {
            MavCmd::MAV_CMD_DO_SET_MODE if self.kind == MavAutopilot::MAV_AUTOPILOT_PX4 => {
                self.mode = (command.param2 as u32) << 16 | (command.param3 as u32) << 24;
            }
            MavCmd::MAV_CMD_DO_SET_MODE => self.mode = command.param2 as u32,
            MavCmd::MAV_CMD_COMPONENT_ARM_DISARM => self.armed = command.param1 == 1.0,
            MavCmd::MAV_CMD_NAV_LAND => self.mode = 9,
            _ => {}
        }
    }

    /// Advances time in ticks of 20 ms, with one heartbeat a second.
    fn run(&mut self, seconds: f64) {
        for tick in 0..(seconds * 50.0) as usize {
            self.now = self.now.plus_ns(20_000_000);
            if tick % 50 == 49 {
                self.heartbeat();
            }
            self.link.handle_timeout(self.now);
            self.drain();
        }
    }

    /// Advances time without heartbeats and replies.
    fn run_silently(&mut self, seconds: f64) {
        let answer = std::mem::replace(&mut self.answer, |_| None);
        for _ in 0..(seconds * 50.0) as usize {
            self.now = self.now.plus_ns(20_000_000);
            self.link.handle_timeout(self.now);
            self.drain();
        }
        self.answer = answer;
    }

    fn commands(&self) -> Vec<(MavCmd, u8)> {
        let command = |message: &MavMessage| match message {
            MavMessage::COMMAND_LONG(c) if !CHORES.contains(&c.command) => {
                Some((c.command, c.confirmation))
            }
            _ => None,
        };
        self.sent.iter().filter_map(command).collect()
    }

    fn refusals(&self) -> Vec<&str> {
        let mut refusals = Vec::new();
        for event in &self.events {
            if let LinkEvent::Refused(text) = event {
                refusals.push(text.as_str());
            }
        }
        refusals
    }

    fn missing(&self) -> String {
        self.link.ready_to_arm(self.now).unwrap_err().into_owned()
    }

    fn count(&self, wanted: impl Fn(&MavMessage) -> bool) -> usize {
        self.sent.iter().filter(|message| wanted(message)).count()
    }
}

#[test]
fn sends_the_sequence_that_a_real_arducopter_accepted() {
    let mut script = Script::ready();
    assert_eq!(script.link.ready_to_arm(script.now), Ok(()));
    let intervals = script.count(|m| {
        matches!(m, MavMessage::COMMAND_LONG(c) if c.command == MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL)
    });
    assert_eq!(intervals, 5);
    assert!(script.commands().is_empty(), "nothing but telemetry before the goal");

    script.link.set_goal(script.now, Goal::TakeOff(1.2));
    script.run(1.0);
    assert_eq!(
        script.commands(),
        [
            (MavCmd::MAV_CMD_DO_SET_MODE, 0),
            (MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, 0),
            (MavCmd::MAV_CMD_NAV_TAKEOFF, 0)
        ]
    );
    let takeoff = script.sent.iter().find_map(|message| match message {
        MavMessage::COMMAND_LONG(c) if c.command == MavCmd::MAV_CMD_NAV_TAKEOFF => Some(c.param7),
        _ => None,
    });
    assert_eq!(takeoff, Some(1.2));
    assert!(script.link.took_off() && script.link.state().armed && script.link.state().mode == 4);

    script.link.set_goal(script.now, Goal::Land);
    script.run(0.5);
    assert_eq!(script.commands().last(), Some(&(MavCmd::MAV_CMD_NAV_LAND, 0)));
    assert_eq!(script.link.state().mode, 9);
    script.armed = false;
    script.run(1.0);
    assert!(script.events.ends_with(&[LinkEvent::Disarmed]));
    assert_eq!(script.commands().len(), 4);
}

#[test]
fn never_overrides_a_mode_that_was_not_requested() {
    // ArduCopter's STABILIZE, ALT_HOLD, LOITER, RTL, LAND, BRAKE, and one without a name here.
    for mode in [0, 2, 5, 6, 9, 17, 16] {
        for phase in 0..4 {
            let mut script = Script::ready();
            script.link.set_goal(script.now, Goal::TakeOff(1.2));
            script.run(2.0);
            match phase {
                1 => script.link.set_goal(script.now, Goal::Fly),
                2 => script.link.set_goal(script.now, Goal::Land),
                // LAND was ordered, but not acknowledged yet.
                3 => {
                    script.answer = |_| None;
                    script.link.set_goal(script.now, Goal::Land);
                }
                _ => {}
            }
            if phase < 3 {
                script.run(2.0);
            }
            script.drain();
            script.answer = accept;
            let before = script.commands().len();
            // ArduCopter sends a heartbeat at once when the mode changes.
            script.mode = mode;
            script.heartbeat();
            script.run(20.0);
            let after = &script.commands()[before..];
            let is_own = mode == 9 && phase >= 2;
            assert!(after.is_empty() || is_own, "{mode} {phase}: {after:?}");
            assert_eq!(script.link.taken_mode(), (!is_own).then_some(mode), "{phase}");
            assert_eq!(script.link.state().mode, mode, "{phase}");
        }
    }
}

#[test]
fn reports_what_arming_waits_for() {
    let mut script = Script::new();
    let missing = |script: &Script| script.link.ready_to_arm(script.now).unwrap_err();
    assert!(missing(&script).contains("heartbeat"));
    script.heartbeat();
    assert!(missing(&script).contains("origin"));
    script.inject(&MavMessage::GPS_GLOBAL_ORIGIN(GPS_GLOBAL_ORIGIN_DATA::default()));
    assert!(missing(&script).contains("position"));
    script.estimator(EkfStatusFlags::EKF_POS_HORIZ_ABS | EkfStatusFlags::EKF_CONST_POS_MODE);
    assert!(missing(&script).contains("position"));
    script.estimator(EkfStatusFlags::EKF_POS_HORIZ_ABS);
    assert!(missing(&script).contains("not reported"));
    script.prearm(false);
    assert!(missing(&script).contains("pre-arm checks fail"));
    script.prearm(true);
    assert_eq!(script.link.ready_to_arm(script.now), Ok(()));
}

#[test]
fn sends_the_origin_every_second_until_confirmed() {
    let mut script = Script::new();
    script.heartbeat();
    let origins = |script: &Script| {
        script.count(|message| matches!(message, MavMessage::SET_GPS_GLOBAL_ORIGIN(_)))
    };
    script.run(3.5);
    assert_eq!(origins(&script), 4);
    script.inject(&MavMessage::GPS_GLOBAL_ORIGIN(GPS_GLOBAL_ORIGIN_DATA::default()));
    script.run(3.0);
    assert_eq!(origins(&script), 4);
    let beats = script.count(|message| matches!(message, MavMessage::HEARTBEAT(_)));
    assert!((25..=27).contains(&beats), "four heartbeats a second: {beats}");
}

#[test]
fn sends_the_origin_at_once_to_an_autopilot_that_connects_later() {
    let mut script = Script::new();
    script.run_silently(0.5);
    script.heartbeat();
    script.run_silently(0.02);
    let origin = |message: &MavMessage| matches!(message, MavMessage::SET_GPS_GLOBAL_ORIGIN(_));
    assert_eq!(script.count(origin), 1);
}

#[test]
fn repeats_an_unanswered_command_with_a_count_and_gives_up() {
    let mut script = Script::ready();
    script.answer = |_| None;
    script.link.set_goal(script.now, Goal::TakeOff(1.0));
    script.run(10.0);
    let mode = MavCmd::MAV_CMD_DO_SET_MODE;
    assert_eq!(script.commands(), [(mode, 0), (mode, 1), (mode, 2), (mode, 3), (mode, 4)]);
    let refused: Vec<_> =
        script.events.iter().filter(|event| matches!(event, LinkEvent::Refused(_))).collect();
    assert_eq!(refused, [&LinkEvent::Refused("mode change not answered (5 times)".into())]);
}

#[test]
fn refusal_is_retried_then_reported_with_the_autopilots_text_and_advice() {
    let mut script = Script::ready();
    script.answer = |command| match command {
        MavCmd::MAV_CMD_COMPONENT_ARM_DISARM => Some(MavResult::MAV_RESULT_FAILED),
        _ => Some(MavResult::MAV_RESULT_ACCEPTED),
    };
    script.link.set_goal(script.now, Goal::TakeOff(1.0));
    for _ in 0..9 {
        script.run(1.0);
        script.text("Arm: RC not found");
    }
    script.run(3.0);
    let arm = |(command, _): &&(MavCmd, u8)| *command == MavCmd::MAV_CMD_COMPONENT_ARM_DISARM;
    assert_eq!(script.commands().iter().filter(arm).count(), 8);
    let Some(LinkEvent::Refused(text)) =
        script.events.iter().find(|event| matches!(event, LinkEvent::Refused(_)))
    else {
        panic!("no refusal in {:?}", script.events)
    };
    assert!(
        text.starts_with("arming refused (failed); the autopilot says \"Arm: RC not found\""),
        "{text}"
    );
    assert!(text.ends_with("set FS_THR_ENABLE=0 to fly without one"), "{text}");
}

#[test]
fn retries_after_a_temporary_rejection() {
    let mut script = Script::ready();
    script.answer = |command| match command {
        MavCmd::MAV_CMD_NAV_TAKEOFF => Some(MavResult::MAV_RESULT_TEMPORARILY_REJECTED),
        _ => Some(MavResult::MAV_RESULT_ACCEPTED),
    };
    script.link.set_goal(script.now, Goal::TakeOff(1.0));
    script.run(2.5);
    script.answer = accept;
    script.run(1.5);
    assert!(script.link.took_off());
    assert!(!script.events.iter().any(|event| matches!(event, LinkEvent::Refused(_))));
}

#[test]
fn landing_is_never_given_up_and_tries_both_ways() {
    let mut script = Script::ready();
    script.link.set_goal(script.now, Goal::TakeOff(1.0));
    script.run(1.0);
    script.answer = |_| None;
    script.sent.clear();
    script.link.set_goal(script.now, Goal::Land);
    script.run(60.0);
    let commands = script.commands();
    assert!(commands.len() > 100, "{}", commands.len());
    for command in [MavCmd::MAV_CMD_NAV_LAND, MavCmd::MAV_CMD_DO_SET_MODE] {
        assert!(commands.iter().filter(|(sent, _)| *sent == command).count() > 50);
    }
    assert!(!script.events.iter().any(|event| matches!(event, LinkEvent::Refused(_))));
    script.answer = accept;
    script.run(1.0);
    assert_eq!(script.link.state().mode, 9);
}

#[test]
fn stops_arming_when_the_goal_becomes_landing() {
    let mut script = Script::ready();
    script.answer = |command| match command {
        MavCmd::MAV_CMD_COMPONENT_ARM_DISARM => None,
        _ => Some(MavResult::MAV_RESULT_ACCEPTED),
    };
    script.link.set_goal(script.now, Goal::TakeOff(1.0));
    script.run(1.0);
    script.sent.clear();
    script.link.set_goal(script.now, Goal::Land);
    script.run(3.0);
    assert_eq!(script.commands(), [], "disarmed: there is nothing to land");
}

#[test]
fn silence_is_reported_and_the_connection_resumes() {
    let mut script = Script::ready();
    script.run_silently(3.2);
    assert!(script.events.contains(&LinkEvent::Lost));
    assert!(!script.link.setpoint(script.now, &hover()));
    script.heartbeat();
    assert!(script.events.ends_with(&[LinkEvent::Connected { system: 1 }]));
    assert!(script.link.ready_to_arm(script.now).is_err(), "it may have restarted");
}

#[test]
fn detects_a_restart_by_the_boot_clock() {
    let mut script = Script::ready();
    let at = |time_boot_ms| {
        MavMessage::LOCAL_POSITION_NED(LOCAL_POSITION_NED_DATA {
            time_boot_ms,
            ..Default::default()
        })
    };
    script.inject(&at(90_000));
    script.inject(&at(89_990));
    assert_eq!(script.link.ready_to_arm(script.now), Ok(()), "reordered packets are not a restart");
    script.inject(&at(500));
    assert!(script.events.ends_with(&[LinkEvent::Rebooted]));
    assert!(script.link.ready_to_arm(script.now).unwrap_err().contains("origin"));
}

#[test]
fn ignores_packets_of_other_senders_on_the_network() {
    let mut script = Script::new();
    let gcs = HEARTBEAT_DATA {
        mavtype: MavType::MAV_TYPE_GCS,
        autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
        ..Default::default()
    };
    script.inject_from((254, 190), &MavMessage::HEARTBEAT(gcs));
    assert!(!script.link.is_connected());
    script.heartbeat();
    let armed = HEARTBEAT_DATA {
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode: MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED,
        ..Default::default()
    };
    script.inject_from((2, 1), &MavMessage::HEARTBEAT(armed));
    assert!(!script.link.state().armed, "that was another vehicle");
    script.inject_from((2, 1), &MavMessage::GPS_GLOBAL_ORIGIN(GPS_GLOBAL_ORIGIN_DATA::default()));
    let missing = |script: &Script| script.link.ready_to_arm(script.now).unwrap_err();
    assert!(missing(&script).contains("systems 1 and 2"), "two autopilots");
    script.run(4.0);
    assert!(missing(&script).contains("origin"), "it has gone");
}

fn hover() -> GuidedSetpoint {
    GuidedSetpoint { motion: GuidedMotion::Velocity(DVec3::ZERO), yaw: YawTarget::Angle(0.0) }
}

#[test]
fn sends_poses_at_50_hz() {
    let mut script = Script::ready();
    let pose = Pose::new(DVec3::new(1.0, 2.0, 0.05), DQuat::IDENTITY);
    let sample = PoseSample {
        resets: 3,
        position_sigma_m: Vec3::new(0.1, 0.2, 0.001),
        ..PoseSample::still(ServerTime::ZERO, pose)
    };
    for _ in 0..200 {
        script.now = script.now.plus_ns(10_000_000);
        script.link.vision(script.now, &sample, script.now.plus_ns(-5_000_000));
        script.drain();
    }
    let bad = PoseSample::still(ServerTime::ZERO, Pose::new(DVec3::NAN, DQuat::IDENTITY));
    script.link.vision(script.now.plus_seconds(1.0), &bad, script.now);
    script.drain();
    let sent: Vec<_> = script
        .sent
        .iter()
        .filter_map(|message| match message {
            MavMessage::VISION_POSITION_ESTIMATE(m) => Some(m),
            _ => None,
        })
        .collect();
    assert_eq!(sent.len(), 100);
    let last = sent[99];
    assert_eq!((last.x, last.y, last.z, last.reset_counter), (2.0, 1.0, -0.05, 3));
    assert!(last.usec + 5_000 <= script.now.as_ns() / 1000);
}

#[test]
fn synchronizes_clocks_in_both_directions() {
    let mut script = Script::ready();
    let ahead_ns = 77_000_000_000i64;
    let request = script
        .sent
        .iter()
        .rev()
        .find_map(|message| match message {
            MavMessage::TIMESYNC(m) if m.tc1 == 0 => Some(m.ts1),
            _ => None,
        })
        .unwrap();
    script.inject(&MavMessage::TIMESYNC(TIMESYNC_DATA {
        tc1: request + ahead_ns,
        ts1: request,
        ..Default::default()
    }));
    let offset = |script: &Script| {
        let theirs = script.link.clock().to_remote(script.now).unwrap();
        theirs.as_ns() as i64 - script.now.as_ns() as i64
    };
    // The reply arrived when the clock was within 1.1 s of the request.
    assert!((offset(&script) - ahead_ns).abs() < 1_100_000_000, "{}", offset(&script));
    // The link answers a request of the autopilot.
    script.sent.clear();
    script.inject(&MavMessage::TIMESYNC(TIMESYNC_DATA { tc1: 0, ts1: 4711, ..Default::default() }));
    assert!(matches!(script.sent[..], [MavMessage::TIMESYNC(ref m)]
        if m.ts1 == 4711 && m.tc1 == script.now.as_ns() as i64));
}

/// Returns the telemetry of a flight as bytes.
fn telemetry(script: &mut Script) -> Vec<u8> {
    let messages = [
        MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            custom_mode: 4,
            mavtype: MavType::MAV_TYPE_QUADROTOR,
            autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
            base_mode: MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED,
            ..Default::default()
        }),
        MavMessage::LOCAL_POSITION_NED(local_position_to_mavlink(DVec3::ONE, DVec3::X, 7)),
        MavMessage::STATUSTEXT(STATUSTEXT_DATA {
            text: "EKF3 active".into(),
            ..Default::default()
        }),
        MavMessage::GPS_GLOBAL_ORIGIN(GPS_GLOBAL_ORIGIN_DATA::default()),
    ];
    messages.iter().flat_map(|message| script.bytes_of(AUTOPILOT, message)).collect()
}

#[test]
fn parses_telemetry_in_chunks_of_every_size() {
    let bytes = telemetry(&mut Script::new());
    for chunk in 1..=bytes.len() {
        let mut link = Link::new(HostTime::ZERO);
        for part in bytes.chunks(chunk) {
            link.handle_input(HostTime::ZERO, part);
        }
        assert!(
            link.state().armed && link.state().mode == 4 && link.origin.is_some(),
            "chunk {chunk}"
        );
        assert!((link.state().p_world_m - DVec3::ONE).length() < 1e-6);
        let events: Vec<_> = std::iter::from_fn(|| link.poll_event()).collect();
        assert_eq!(events.len(), 4, "{events:?}");
    }
}

proptest! {
    /// No input makes the link panic or arm.
    #[test]
    fn garbage_is_harmless(garbage in prop::collection::vec(any::<u8>(), 0..600), chunk in 1usize..99) {
        let mut script = Script::ready();
        script.sent.clear();
        script.chunk = chunk;
        for part in garbage.chunks(chunk) {
            script.link.handle_input(script.now, part);
        }
        script.run(0.5);
        prop_assert_eq!(script.commands(), []);
    }
}
