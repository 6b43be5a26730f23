//! PX4 dialect: setpoints are streamed before OFFBOARD is requested.

use vizflyt_protocol::mavlink::CopterMode;
use vizflyt_protocol::mavlink::dialect::{ESTIMATOR_STATUS_DATA, EstimatorStatusFlags};

use super::*;

const OFFBOARD: u32 = 6 << 16;

fn px4() -> Script {
    let mut script = Script::new();
    script.kind = MavAutopilot::MAV_AUTOPILOT_PX4;
    script.heartbeat();
    script.inject(&MavMessage::ESTIMATOR_STATUS(ESTIMATOR_STATUS_DATA {
        flags: EstimatorStatusFlags::ESTIMATOR_POS_HORIZ_REL,
        ..Default::default()
    }));
    script.prearm(true);
    let position = local_position_to_mavlink(DVec3::new(1.0, 2.0, 0.1), DVec3::ZERO, 7);
    script.inject(&MavMessage::LOCAL_POSITION_NED(position));
    script.run(3.0);
    script
}

/// Returns the setpoints and commands that were sent, in order.
fn order(script: &Script) -> Vec<&'static str> {
    let name = |message: &MavMessage| match message {
        MavMessage::SET_POSITION_TARGET_LOCAL_NED(_) => Some("setpoint"),
        MavMessage::COMMAND_LONG(c) if c.command == MavCmd::MAV_CMD_DO_SET_MODE => Some("mode"),
        MavMessage::COMMAND_LONG(c) if c.command == MavCmd::MAV_CMD_COMPONENT_ARM_DISARM => {
            Some("arm")
        }
        MavMessage::COMMAND_LONG(c) if c.command == MavCmd::MAV_CMD_NAV_TAKEOFF => Some("takeoff"),
        _ => None,
    };
    script.sent.iter().filter_map(name).collect()
}

#[test]
fn streams_setpoints_before_offboard_to_take_off() {
    let mut script = px4();
    assert_eq!(script.link.ready_to_arm(script.now), Ok(()));
    let origins = script.count(|m| matches!(m, MavMessage::SET_GPS_GLOBAL_ORIGIN(_)));
    assert_eq!(origins, 0, "PX4 needs none");
    script.sent.clear();
    script.link.set_goal(script.now, Goal::TakeOff(1.5));
    script.run(1.0);
    let lead = order(&script);
    assert!(lead.len() >= 15 && lead.iter().all(|what| *what == "setpoint"), "{lead:?}");
    script.run(1.0);
    let order = order(&script);
    let at = |what| order.iter().position(|name| *name == what).unwrap();
    assert!(at("mode") < at("arm") && !order.contains(&"takeoff"));
    assert_eq!((script.mode, script.armed), (OFFBOARD, true));
    assert_eq!(script.link.state().mode, CopterMode::Guided as u32);
    assert!(script.link.took_off() && script.events.contains(&LinkEvent::TakingOff));
    let Some(MavMessage::SET_POSITION_TARGET_LOCAL_NED(target)) =
        script.sent.iter().rfind(|m| matches!(m, MavMessage::SET_POSITION_TARGET_LOCAL_NED(_)))
    else {
        panic!("no setpoint")
    };
    assert_eq!((target.x, target.y, target.type_mask.bits()), (2.0, 1.0, 0x9F8));
    assert!((target.z + 1.6).abs() < 1e-5, "{}", target.z);

    // The setpoints of the guard replace those of the link.
    script.link.set_goal(script.now, Goal::Fly);
    script.sent.clear();
    script.run(1.0);
    assert_eq!(script.count(|m| matches!(m, MavMessage::SET_POSITION_TARGET_LOCAL_NED(_))), 0);
    script.link.set_goal(script.now, Goal::Land);
    script.run(0.5);
    assert_eq!(script.commands().last(), Some(&(MavCmd::MAV_CMD_NAV_LAND, 0)));
}

#[test]
fn setpoints_keep_streaming_while_the_mode_is_refused() {
    let mut script = px4();
    script.answer = |command| match command {
        MavCmd::MAV_CMD_DO_SET_MODE => Some(MavResult::MAV_RESULT_DENIED),
        _ => Some(MavResult::MAV_RESULT_ACCEPTED),
    };
    script.link.set_goal(script.now, Goal::TakeOff(1.0));
    script.run(5.0);
    script.text("Offboard denied: no offboard signal");
    script.run(8.0);
    let rate_hz =
        script.count(|m| matches!(m, MavMessage::SET_POSITION_TARGET_LOCAL_NED(_))) as f64 / 13.0;
    assert!(rate_hz > 10.0, "{rate_hz}");
    assert!(!script.armed && script.refusals().len() == 1, "{:?}", script.events);
    assert!(script.refusals()[0].starts_with("mode change refused (denied)"));
}
