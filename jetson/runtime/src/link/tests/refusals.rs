//! Messages for people: why arming waits, why a command was rejected, which other companions are present.

use vizflyt_protocol::mavlink::dialect::{MavParamType, PARAM_VALUE_DATA};

use super::*;

fn companion(own: u32) -> MavMessage {
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        custom_mode: own,
        mavtype: MavType::MAV_TYPE_ONBOARD_CONTROLLER,
        autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
        ..Default::default()
    })
}

pub(super) fn param(script: &mut Script, name: &str, value: f32) {
    script.inject(&MavMessage::PARAM_VALUE(PARAM_VALUE_DATA {
        param_value: value,
        param_count: 900,
        param_index: u16::MAX,
        param_id: name.into(),
        param_type: MavParamType::MAV_PARAM_TYPE_REAL32,
    }));
}

#[test]
fn reports_failing_pre_arm_checks() {
    let mut script = Script::ready();
    let battery = MavSysStatusSensor::MAV_SYS_STATUS_SENSOR_BATTERY;
    script.inject(&MavMessage::SYS_STATUS(SYS_STATUS_DATA {
        onboard_control_sensors_present: battery,
        onboard_control_sensors_enabled: battery,
        ..Default::default()
    }));
    script.text("PreArm: RC not found");
    script.text("PreArm: Battery 1 low voltage failsafe");
    script.text("PreArm: RC not found");
    let missing = script.missing();
    for expected in [
        "checks fail: \"Battery 1 low",
        "(charge or change",
        "\"RC not found\" (connect",
        "not healthy: battery",
    ] {
        assert!(missing.contains(expected), "{missing}");
    }
    assert_eq!(missing.matches("RC not found").count(), 1);
    script.run(11.0);
    let asked = |script: &Script| {
        script.count(|m| matches!(m, MavMessage::COMMAND_LONG(c) if c.command == MavCmd::MAV_CMD_RUN_PREARM_CHECKS))
    };
    assert_eq!(asked(&script), 3, "requested every 5 s");
    script.run(30.0);
    assert!(!script.missing().contains("RC not found"), "taken back");
    script.prearm(true);
    assert_eq!(script.link.ready_to_arm(script.now), Ok(()));
    script.prearm(false);
    assert!(!script.missing().contains("Battery 1"), "an old text");
}

#[test]
fn requests_pre_arm_texts_only_once_if_unsupported() {
    let mut script = Script::ready();
    script.answer = |command| match command {
        MavCmd::MAV_CMD_RUN_PREARM_CHECKS => Some(MavResult::MAV_RESULT_UNSUPPORTED),
        _ => Some(MavResult::MAV_RESULT_ACCEPTED),
    };
    script.prearm(false);
    script.run(20.0);
    let asked = script.count(|m| matches!(m, MavMessage::COMMAND_LONG(c) if c.command == MavCmd::MAV_CMD_RUN_PREARM_CHECKS));
    assert_eq!(asked, 1);
}

/// Rejections that ArduCopter sends without a text.
#[test]
fn explains_a_rejection_without_text_by_the_observed_state() {
    let check = |spoil: fn(&mut Script), expected: &str| {
        let mut script = Script::new();
        script.heartbeat();
        script.run(1.0);
        spoil(&mut script);
        script.answer = |command| match command {
            MavCmd::MAV_CMD_NAV_TAKEOFF => Some(MavResult::MAV_RESULT_FAILED),
            _ => Some(MavResult::MAV_RESULT_ACCEPTED),
        };
        script.link.set_goal(script.now, Goal::TakeOff(1.0));
        script.run(15.0);
        let [refusal] = script.refusals()[..] else { panic!("{:?}", script.events) };
        assert!(refusal.starts_with("take-off refused (failed): "), "{refusal}");
        assert!(refusal.contains(expected), "{refusal}");
    };
    check(|_| {}, "no EKF origin");
    let origin = |script: &mut Script| {
        script.inject(&MavMessage::GPS_GLOBAL_ORIGIN(GPS_GLOBAL_ORIGIN_DATA::default()));
        param(script, "VISO_TYPE", 0.0);
    };
    check(origin, "VISO_TYPE is 0, it must be 1");
}

#[test]
fn reports_a_second_companion_by_name() {
    let mut script = Script::ready();
    let own = script.sent.iter().find_map(|message| match message {
        MavMessage::HEARTBEAT(m) => Some(m.custom_mode),
        _ => None,
    });
    let own = own.unwrap();
    for _ in 0..5 {
        script.run(1.0);
        script.inject_from((255, 191), &companion(own));
    }
    assert_eq!(script.link.ready_to_arm(script.now), Ok(()), "that was our own echo");
    for _ in 0..3 {
        script.run(1.0);
        script.inject_from((255, 191), &companion(own + 1));
    }
    assert!(script.missing().contains("another companion (system 255, component 191)"));
    script.inject_from(
        (255, 191),
        &MavMessage::STATUSTEXT(STATUSTEXT_DATA {
            text: "companion bee on jetson-2".into(),
            ..Default::default()
        }),
    );
    let missing = script.missing();
    assert!(
        missing.starts_with("\"bee on jetson-2\" (system 255, component 191) commands"),
        "{missing}"
    );
    script.run(6.0);
    assert_eq!(script.link.ready_to_arm(script.now), Ok(()), "it has gone");
}

#[test]
fn detects_companions_by_replies_to_them() {
    let mut script = Script::ready();
    let answer = |ts1| {
        MavMessage::TIMESYNC(TIMESYNC_DATA {
            tc1: 7_000_000_000,
            ts1,
            target_system: 255,
            target_component: 191,
        })
    };
    for i in 0..3 {
        script.run(1.0);
        script.inject(&answer(900 + i));
    }
    assert!(script.link.clock().offset_ns(script.now).is_none(), "another's clock is not ours");
    assert!(script.missing().contains("another companion"));
    script.run(6.0);
    assert_eq!(script.link.ready_to_arm(script.now), Ok(()));
    // Acknowledgement of arming that this runtime did not request.
    for _ in 0..3 {
        script.inject(&MavMessage::COMMAND_ACK(COMMAND_ACK_DATA {
            command: MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
            target_system: 255,
            target_component: 191,
            ..Default::default()
        }));
    }
    assert!(script.missing().contains("another companion"));
}

#[test]
fn announces_the_name_once_and_again_to_another_companion() {
    let name = "wasp on jetson-1".to_owned();
    let mut script = Script::with(LinkSettings { name, ..LinkSettings::default() });
    let announced = |script: &Script| {
        script.count(|m| matches!(m, MavMessage::STATUSTEXT(m) if m.text.to_str() == Ok("companion wasp on jetson-1")))
    };
    script.heartbeat();
    script.run(10.0);
    assert_eq!(announced(&script), 1);
    for _ in 0..12 {
        script.inject_from((255, 191), &companion(1));
        script.run(1.0);
    }
    assert!((2..=4).contains(&announced(&script)), "{}", announced(&script));
}

#[test]
fn slow_streams_are_requested_again_then_reported() {
    let mut script = Script::ready();
    script.run(12.0);
    let asked = script.count(|m| {
        matches!(m, MavMessage::COMMAND_LONG(c)
            if c.command == MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL && c.param1 == 30.0)
    });
    assert!((2..=3).contains(&asked), "{asked}");
    let slow = |event: &&LinkEvent| matches!(event, LinkEvent::Slow(rate) if rate.id == 30);
    assert_eq!(script.events.iter().filter(slow).count(), 1);
    let warning = script.events.iter().find(slow).unwrap().warning().unwrap();
    assert!(warning.contains("message 30 at 0 Hz, 50 Hz requested"), "{warning}");
}

#[test]
fn measures_the_latency_of_external_navigation() {
    let mut script = Script::ready();
    param(&mut script, "VISO_DELAY_MS", 10.0);
    let request = script.sent.iter().rev().find_map(|message| match message {
        MavMessage::TIMESYNC(m) if m.tc1 == 0 => Some(m.ts1),
        _ => None,
    });
    let ts1 = request.unwrap();
    script.now = HostTime::from_ns(ts1 as u64).plus_ns(4_000_000);
    script.inject(&MavMessage::TIMESYNC(TIMESYNC_DATA {
        tc1: 9_000_000_000,
        ts1,
        ..Default::default()
    }));
    let pose = Pose::new(DVec3::ONE, DQuat::IDENTITY);
    let sample = PoseSample::still(ServerTime::ZERO, pose);
    for tick in 0..400 {
        let age_ns = 55_000_000 + (tick % 5) * 2_000_000;
        script.link.vision(script.now, &sample, script.now.plus_ns(-age_ns));
        script.run(0.02);
    }
    script.run(2.0);
    let delays: Vec<_> =
        script.events.iter().filter(|e| matches!(e, LinkEvent::Delay(_))).collect();
    let [LinkEvent::Delay(delay)] = delays[..] else { panic!("{delays:?}") };
    assert!((57.0..59.0).contains(&delay.measured_ms), "{delay:?}");
    let warning = delays[0].warning().unwrap();
    assert!(warning.contains("VISO_DELAY_MS is 10; set VISO_DELAY_MS=5"), "{warning}");
}

#[test]
fn does_not_take_off_by_itself_after_a_restart() {
    let mut script = Script::ready();
    script.link.set_goal(script.now, Goal::TakeOff(1.0));
    script.run(1.0);
    assert!(script.link.took_off());
    let at = |ms| {
        MavMessage::LOCAL_POSITION_NED(local_position_to_mavlink(DVec3::ZERO, DVec3::ZERO, ms))
    };
    script.inject(&at(90_000));
    (script.armed, script.mode) = (false, 0);
    script.sent.clear();
    script.inject(&at(100));
    script.heartbeat();
    script.run(5.0);
    assert!(script.events.contains(&LinkEvent::Rebooted));
    assert_eq!(script.commands(), [], "not even with the same goal");
    // Streams and important parameters are requested again.
    let asks = |id: f32| {
        script.count(|m| {
            matches!(m, MavMessage::COMMAND_LONG(c)
            if c.command == MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL && c.param1 == id)
        })
    };
    assert!(asks(30.0) >= 1 && asks(32.0) >= 1);
    assert!(script.count(|m| matches!(m, MavMessage::PARAM_REQUEST_READ(_))) >= 11);
    script.link.set_goal(script.now, Goal::Prepare);
    script.link.set_goal(script.now, Goal::TakeOff(1.0));
    script.run(1.0);
    assert_eq!(script.commands().len(), 3, "a new goal counts");
}

#[test]
fn selects_one_of_two_vehicles() {
    let settings = LinkSettings { system: Some(2), ..LinkSettings::default() };
    let mut script = Script::with(settings);
    script.run(2.0);
    assert!(!script.link.is_connected(), "system 1 is not selected");
    let beat = HEARTBEAT_DATA {
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        ..Default::default()
    };
    script.inject_from((2, 1), &MavMessage::HEARTBEAT(beat));
    assert_eq!(script.link.system(), Some(2));
    script.run(1.0);
    assert!(script.missing().contains("origin"), "{}", script.missing());
}
