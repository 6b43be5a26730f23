//! Other senders of heartbeats on the link: gimbals, other vehicles, a second multirotor.

use super::*;

/// Returns a heartbeat whose sender names ArduPilot as its autopilot, as gimbals also do.
fn beat_of(mavtype: MavType) -> MavMessage {
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        mavtype,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode: MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED,
        ..Default::default()
    })
}

/// Returns the neighbors reported by events.
fn named(script: &Script) -> Vec<&str> {
    let name = |event: &'_ LinkEvent| matches!(event, LinkEvent::Neighbor(_));
    let events = script.events.iter().filter(|event| name(event));
    events
        .map(|event| if let LinkEvent::Neighbor(name) = event { name.as_str() } else { "" })
        .collect()
}

const DEVICES: [((u8, u8), MavType, &str); 6] = [
    ((1, 154), MavType::MAV_TYPE_GIMBAL, "a gimbal (system 1, component 154)"),
    ((71, 67), MavType::MAV_TYPE_GIMBAL, "a gimbal (system 71, component 67)"),
    ((1, 100), MavType::MAV_TYPE_CAMERA, "a camera (system 1, component 100)"),
    ((1, 156), MavType::MAV_TYPE_ADSB, "an ADS-B receiver (system 1, component 156)"),
    ((1, 154), MavType::MAV_TYPE_QUADROTOR, "a quadrotor (system 1, component 154)"),
    ((2, 1), MavType::MAV_TYPE_ANTENNA_TRACKER, "an antenna tracker (system 2, component 1)"),
];

#[test]
fn a_device_before_or_after_the_autopilot_changes_nothing() {
    for (from, mavtype, name) in DEVICES {
        // Before the autopilot: no packet is sent to it.
        let mut script = Script::new();
        script.inject_from(from, &beat_of(mavtype));
        assert!(!script.link.is_connected(), "{name}");
        script.heartbeat();
        assert_eq!(script.link.system(), Some(1), "{name}");
        // Next to a vehicle that is ready to arm.
        let mut script = Script::ready();
        for _ in 0..3 {
            script.inject_from(from, &beat_of(mavtype));
            script.run(1.0);
        }
        assert_eq!(script.link.ready_to_arm(script.now), Ok(()), "{name}");
        assert!(!script.link.state().armed, "{name}");
        assert_eq!(named(&script), [format!("{name} is on the link; it is left alone")], "once");
    }
}

#[test]
fn refuses_another_vehicle_by_name() {
    for (mavtype, name) in [
        (MavType::MAV_TYPE_GROUND_ROVER, "a rover"),
        (MavType::MAV_TYPE_FIXED_WING, "a plane"),
        (MavType::MAV_TYPE_SURFACE_BOAT, "a boat"),
        (MavType::MAV_TYPE_SUBMARINE, "a submarine"),
        (MavType::MAV_TYPE_HELICOPTER, "a helicopter"),
        (MavType::MAV_TYPE_VTOL_FIXEDROTOR, "a VTOL aircraft"),
        (MavType::MAV_TYPE_ANTENNA_TRACKER, "an antenna tracker"),
    ] {
        let mut script = Script::new();
        for _ in 0..3 {
            script.inject_from((1, 1), &beat_of(mavtype));
            script.run_silently(1.0);
        }
        assert!(!script.link.is_connected(), "{name}");
        let expected =
            format!("system 1 is {name}, not a multirotor; connect the autopilot of a multirotor");
        assert!(script.missing().starts_with(&expected), "{}", script.missing());
        script.run_silently(4.0);
        assert!(script.missing().contains("no heartbeat"), "it has gone: {}", script.missing());
    }
    let mut script = Script::new();
    script.inject_from((1, 1), &beat_of(MavType::MAV_TYPE_GENERIC));
    assert!(script.missing().contains("set FRAME_CLASS"), "{}", script.missing());
    let other = MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot: MavAutopilot::MAV_AUTOPILOT_GENERIC,
        ..Default::default()
    });
    script.inject_from((1, 1), &other);
    assert!(script.missing().contains("neither ArduPilot nor PX4"), "{}", script.missing());
}

#[test]
fn lists_all_multirotors_of_the_link() {
    let mut script = Script::ready();
    for system in [4, 2] {
        script.inject_from((system, 1), &beat_of(MavType::MAV_TYPE_HEXAROTOR));
    }
    let missing = script.missing();
    assert!(missing.contains("systems 1, 2 and 4; select one with `system`"), "{missing}");
    assert!(!script.link.state().armed, "the first keeps its place");
    let selected = LinkSettings { system: Some(4), ..LinkSettings::default() };
    let mut script = Script::with(selected);
    script.heartbeat();
    script.inject_from((4, 1), &beat_of(MavType::MAV_TYPE_HEXAROTOR));
    assert_eq!((script.link.system(), script.link.several(script.now)), (Some(4), None));
}

#[test]
fn a_flood_of_senders_hides_no_multirotor_and_prints_few_lines() {
    let mut script = Script::ready();
    for system in 2..=200 {
        script.inject_from((system, 1), &beat_of(MavType::MAV_TYPE_GROUND_ROVER));
    }
    script.inject_from((250, 1), &beat_of(MavType::MAV_TYPE_QUADROTOR));
    assert!(script.missing().contains("systems 1 and 250"), "{}", script.missing());
    assert!(named(&script).len() <= 16, "{}", named(&script).len());
}

#[test]
fn no_other_vehicle_replaces_one_that_was_lost_in_flight() {
    let mut script = Script::ready();
    script.inject(&beat_of(MavType::MAV_TYPE_QUADROTOR));
    assert!(script.link.state().armed);
    script.run_silently(4.0);
    assert!(!script.link.is_connected());
    script.inject_from((9, 1), &beat_of(MavType::MAV_TYPE_QUADROTOR));
    assert!(!script.link.is_connected(), "another team's vehicle must not get LAND");
    script.inject(&beat_of(MavType::MAV_TYPE_QUADROTOR));
    assert_eq!(script.link.system(), Some(1), "the flown one has returned");
}
