mod failsafes;
mod fence;
mod pitfalls;
mod real;
mod signed;

use glam::DVec3;
use vizflyt_protocol::mavlink::dialect::{
    EkfStatusFlags, MavCmd, MavMessage, MavModeFlag, MavResult, MavSysStatusSensor,
    PARAM_REQUEST_READ_DATA, PARAM_SET_DATA, SET_MODE_DATA, TIMESYNC_DATA,
};
use vizflyt_protocol::mavlink::{CopterMode, GuidedMotion};
use vizflyt_protocol::messages::YawTarget;

use crate::simulation::SimulationConfig;
use crate::simulation::companion::Companion;

const ACCEPTED: MavResult = MavResult::MAV_RESULT_ACCEPTED;
const FAILED: MavResult = MavResult::MAV_RESULT_FAILED;

impl Companion {
    fn texts_contain(&self, text: &str) -> bool {
        self.texts.iter().any(|t| t.contains(text))
    }

    fn armed(&self) -> bool {
        self.lab.autopilot().is_armed()
    }

    fn mode(&self) -> CopterMode {
        self.lab.autopilot().mode()
    }

    fn flags(&self) -> EkfStatusFlags {
        match self.newest.get(&193) {
            Some(MavMessage::EKF_STATUS_REPORT(m)) => m.flags,
            other => panic!("no EKF_STATUS_REPORT but {other:?}"),
        }
    }

    fn prearm_good(&self) -> bool {
        match self.newest.get(&1) {
            Some(MavMessage::SYS_STATUS(m)) => m
                .onboard_control_sensors_health
                .contains(MavSysStatusSensor::MAV_SYS_STATUS_PREARM_CHECK),
            other => panic!("no SYS_STATUS but {other:?}"),
        }
    }
}

#[test]
fn the_start_sequence_of_a_real_autopilot_works() {
    let mut c = Companion::new(SimulationConfig::default());
    c.wait(3.0);
    assert!(c.flags().contains(EkfStatusFlags::EKF_CONST_POS_MODE));
    assert!(!c.newest.contains_key(&49) && !c.newest.contains_key(&32));
    c.set_origin();
    let origin = c.until(5.0, "the origin", |c| c.newest.contains_key(&49));
    assert!(origin < 0.1);
    let known = EkfStatusFlags::EKF_POS_HORIZ_REL | EkfStatusFlags::EKF_POS_HORIZ_ABS;
    c.until(5.0, "the position", |c| {
        c.flags().contains(known) && !c.flags().contains(EkfStatusFlags::EKF_CONST_POS_MODE)
    });
    c.until(5.0, "the checks", Companion::prearm_good);
    assert_eq!(c.set_mode(CopterMode::Guided), ACCEPTED);
    assert_eq!(c.arm(), ACCEPTED);
    assert_eq!(c.take_off(1.0), ACCEPTED);
    c.until(10.0, "the height", |c| c.p().z > 0.95);
    let land = c.command(MavCmd::MAV_CMD_NAV_LAND, [0.0; 7]);
    assert_eq!((land, c.mode() as u32), (ACCEPTED, 9));
    c.until(10.0, "the disarm", |c| !c.armed());
}

#[test]
fn without_an_origin_arms_but_refuses_take_off() {
    let mut c = Companion::new(SimulationConfig::default());
    c.wait(4.0);
    assert!(c.prearm_good());
    assert_eq!(c.set_mode(CopterMode::Guided), ACCEPTED);
    assert_eq!(c.arm(), ACCEPTED);
    assert_eq!(c.take_off(1.0), FAILED);
    assert!(c.texts_contain("no EKF origin"));
    // On the ground it disarms after a while.
    c.until(11.0, "the disarm", |c| !c.armed());
    assert!(c.p().z.abs() < 0.01);
}

#[test]
fn refusals_state_their_reason() {
    let mut c = Companion::new(SimulationConfig::default());
    c.vision = false;
    assert_eq!(c.arm(), FAILED);
    assert!(c.texts_contain("PreArm: AHRS: not healthy"));
    c.wait(3.0);
    assert_eq!(c.arm(), FAILED);
    assert!(c.texts_contain("PreArm: VisOdom: not healthy") && !c.prearm_good());
    c.vision = true;
    c.prepare();
    assert_eq!(c.take_off(1.0), FAILED);
    assert!(c.texts_contain("not in GUIDED"));
    c.set_mode(CopterMode::Guided);
    assert_eq!(c.take_off(1.0), FAILED);
    assert!(c.texts_contain("Takeoff refused: not armed"));
    c.set_mode(CopterMode::Land);
    assert_eq!(c.arm(), FAILED);
    assert!(c.texts_contain("LAND mode not armable"));
    assert_eq!(
        c.command(MavCmd::MAV_CMD_DO_SET_MODE, [1.0, 27.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        FAILED
    );
    c.set_mode(CopterMode::Guided);
    assert_eq!(c.arm(), ACCEPTED);
    for height in [f32::NAN, -1.0, 0.0, f32::INFINITY] {
        assert_eq!(c.take_off(height), FAILED);
    }
    assert_eq!(c.take_off(1.0), ACCEPTED);
    assert_eq!(c.take_off(1.0), FAILED);
    c.wait(3.0);
    let disarm = |p2| [0.0, p2, 0.0, 0.0, 0.0, 0.0, 0.0];
    assert_eq!(c.command(MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, disarm(0.0)), FAILED);
    assert!(c.armed() && c.texts_contain("not landed"));
    assert_eq!(c.command(MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, disarm(21196.0)), ACCEPTED);
    assert!(!c.armed());
    c.wait(2.0);
    assert!(c.p().z < 0.1, "it must have fallen: {:?}", c.p());
    assert_eq!(
        c.command(MavCmd::MAV_CMD_DO_CHANGE_SPEED, [0.0; 7]),
        MavResult::MAV_RESULT_UNSUPPORTED
    );
}

#[test]
fn ignores_setpoints_on_the_ground() {
    let mut c = Companion::new(SimulationConfig::default());
    c.prepare();
    c.set_mode(CopterMode::Guided);
    c.arm();
    c.fly(GuidedMotion::Position(DVec3::new(1.0, 0.0, 1.0)), YawTarget::Angle(0.0));
    c.wait(3.0);
    assert!(c.p().length() < 0.01, "{:?}", c.p());
}

#[test]
fn heartbeats_contain_mode_and_arming() {
    let mut c = Companion::hovering(SimulationConfig::default(), 1.0);
    let Some(MavMessage::HEARTBEAT(m)) = c.newest.get(&0) else { panic!() };
    assert_eq!((m.mavtype as u8, m.autopilot as u8, m.custom_mode), (2, 3, 4));
    assert!(m.base_mode.contains(
        MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED | MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    ));
    assert_eq!(m.system_status as u8, 4);
    let before = c.counts[&0];
    c.wait(5.0);
    assert_eq!(c.counts[&0] - before, 5);
}

#[test]
fn detects_lost_vision_after_seven_seconds_and_lands() {
    let mut c = Companion::hovering(SimulationConfig { seed: 2, ..Default::default() }, 1.5);
    let start = c.p();
    c.vision = false;
    let flags = EkfStatusFlags::EKF_POS_HORIZ_ABS;
    let lost = c.until(9.0, "the loss", |c| !c.flags().contains(flags));
    assert!((7.0..7.5).contains(&lost), "{lost}");
    let land = c.until(3.0, "LAND", |c| c.mode() == CopterMode::Land);
    assert!((7.8..8.4).contains(&(lost + land)), "{}", lost + land);
    assert!(c.texts_contain("EKF Failsafe"));
    c.until(20.0, "the disarm", |c| !c.armed());
    let drift = (c.p() - start).truncate().length();
    println!("drift without vision {drift:.2} m");
    assert!(drift > 0.05 && drift < 8.0, "{drift}");
    assert!(c.p().z.abs() < 0.05);
}

#[test]
fn continues_if_vision_returns_in_time() {
    let mut c = Companion::hovering(SimulationConfig::default(), 1.5);
    let start = c.p();
    c.vision = false;
    c.wait(3.0);
    c.vision = true;
    c.wait(4.0);
    assert_eq!(c.mode(), CopterMode::Guided);
    assert!((c.p() - start).length() < 0.2, "{:?}", c.p() - start);
}

#[test]
fn lands_five_seconds_after_lost_heartbeats() {
    let mut c = Companion::hovering(SimulationConfig::default(), 1.5);
    c.heartbeats = false;
    let seconds = c.until(8.0, "LAND", |c| c.mode() == CopterMode::Land);
    assert!((4.0..6.1).contains(&seconds), "{seconds}");
    assert!(c.texts_contain("GCS Failsafe - Landing"));
    c.until(15.0, "the disarm", |c| !c.armed());

    // Without any heartbeat, the failsafe is inactive.
    let mut c = Companion::new(SimulationConfig::default());
    c.heartbeats = false;
    c.prepare();
    c.set_mode(CopterMode::Guided);
    c.arm();
    c.take_off(1.0);
    c.wait(12.0);
    assert_eq!(c.mode(), CopterMode::Guided);

    // Disabled by parameter.
    let params = vec![("FS_GCS_ENABLE".to_owned(), 0.0)];
    let mut c = Companion::hovering(SimulationConfig { params, ..Default::default() }, 1.0);
    c.heartbeats = false;
    c.wait(12.0);
    assert_eq!(c.mode(), CopterMode::Guided);
}

/// Behaviour with a published lab's parameters in a cage of 3.65 m.
#[test]
fn the_published_failsafe_exceeds_the_ceiling() {
    let params = vec![("FS_GCS_ENABLE".to_owned(), 1.0)];
    let mut c = Companion::hovering(SimulationConfig { params, ..Default::default() }, 1.0);
    c.heartbeats = false;
    c.until(30.0, "the ceiling", |c| c.p().z > 3.65);
    assert_eq!(c.mode(), CopterMode::Rtl);
}

#[test]
fn rtl_returns_home_and_lands() {
    let params = vec![("RTL_ALT_M".to_owned(), 1.5), ("WP_SPD".to_owned(), 2.0)];
    let mut c = Companion::hovering(SimulationConfig { params, ..Default::default() }, 1.2);
    c.set_once(GuidedMotion::Position(DVec3::new(3.0, 2.0, 1.2)), YawTarget::Angle(0.0));
    c.wait(5.0);
    assert!((c.p().truncate().length()) > 3.0);
    assert_eq!(c.command(MavCmd::MAV_CMD_NAV_RETURN_TO_LAUNCH, [0.0; 7]), ACCEPTED);
    c.until(30.0, "the disarm", |c| !c.armed());
    assert!(c.p().truncate().length() < 0.4, "{:?}", c.p());
}

#[test]
fn brake_stops_and_stabilize_without_a_pilot_falls() {
    let mut c = Companion::hovering(SimulationConfig::airframe(), 1.5);
    c.fly(GuidedMotion::Velocity(DVec3::new(4.0, 0.0, 0.0)), YawTarget::Angle(0.0));
    c.wait(2.0);
    c.setpoint = None;
    c.set_mode(CopterMode::Brake);
    let before = c.p();
    c.wait(3.0);
    assert!(c.v().length() < 0.15 && (c.p() - before).length() < 3.0);
    c.send(&MavMessage::SET_MODE(SET_MODE_DATA {
        custom_mode: 0,
        target_system: 1,
        ..Default::default()
    }));
    c.wait(2.0);
    assert_eq!(c.mode(), CopterMode::Stabilize);
    assert!(c.p().z < 0.1);
}

/// On a real vehicle, vision at z = 0.59 on the ground became 1.17, so a take-off to 1 m ended at another height.
#[test]
fn resets_the_height_datum_once() {
    let spawn_m = DVec3::new(0.0, 0.0, 0.59);
    let mut c = Companion::new(SimulationConfig { spawn_m, ..Default::default() });
    c.prepare();
    c.until(5.0, "the text", |c| c.texts_contain("Field Elevation Set"));
    c.wait(1.0);
    let z = c.lab.autopilot().estimator().estimate().p_world_m.z;
    assert!((z - 1.18).abs() < 0.05, "{z}");
}

#[test]
fn streams_have_the_requested_rates() {
    let mut c = Companion::new(SimulationConfig::default());
    c.prepare();
    let count = |c: &mut Companion, id: u32, seconds: f64| {
        let before = c.counts.get(&id).copied().unwrap_or(0);
        c.wait(seconds);
        c.counts.get(&id).copied().unwrap_or(0) - before
    };
    assert_eq!(count(&mut c, 30, 5.0), 20);
    let interval = |id: f32, us: f32| [id, us, 0.0, 0.0, 0.0, 0.0, 0.0];
    let set = MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL;
    for (us, expected) in [(10_000.0, 500), (20_000.0, 250), (-1.0, 0), (0.0, 20), (1.0, 2000)] {
        assert_eq!(c.command(set, interval(30.0, us)), ACCEPTED);
        let got = count(&mut c, 30, 5.0);
        assert!(got.abs_diff(expected) <= 1, "{us}: {got} of {expected}");
    }
    assert_eq!(c.command(set, interval(60_000.0, 1e4)), FAILED);
    assert_eq!(c.command(set, interval(30.0, f32::NAN)), FAILED);
    // Only on request.
    assert!(!c.newest.contains_key(&148));
    let request = [148.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    assert_eq!(c.command(MavCmd::MAV_CMD_REQUEST_MESSAGE, request), ACCEPTED);
    assert!(c.newest.contains_key(&148));
    assert_eq!(
        c.command(MavCmd::MAV_CMD_REQUEST_MESSAGE, [9999.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        FAILED
    );
}

#[test]
fn answers_timesync_with_the_time_since_boot() {
    let mut c = Companion::new(SimulationConfig::default());
    c.wait(1.0);
    let now_ns = c.lab.now().as_ns().cast_signed();
    c.send(&MavMessage::TIMESYNC(TIMESYNC_DATA { tc1: 0, ts1: 4242, ..Default::default() }));
    c.tick();
    let Some(MavMessage::TIMESYNC(m)) = c.newest.get(&111) else { panic!() };
    assert_eq!((m.tc1, m.ts1, m.target_system), (now_ns, 4242, 255));
    let before = c.counts[&111];
    // Replies to other systems are ignored.
    c.send(&MavMessage::TIMESYNC(TIMESYNC_DATA { tc1: 5, ts1: 4242, ..Default::default() }));
    c.wait(0.5);
    assert_eq!(c.counts[&111], before);
}

#[test]
fn reads_and_sets_parameters_by_name() {
    let mut c = Companion::new(SimulationConfig::default());
    c.wait(0.1);
    let newest = |c: &Companion| match c.newest.get(&22) {
        Some(MavMessage::PARAM_VALUE(m)) => {
            (m.param_id.to_str().unwrap().to_owned(), m.param_value)
        }
        other => panic!("{other:?}"),
    };
    c.send(&MavMessage::PARAM_REQUEST_READ(PARAM_REQUEST_READ_DATA {
        param_index: -1,
        target_system: 1,
        target_component: 1,
        param_id: "GUID_TIMEOUT".into(),
    }));
    c.tick();
    assert_eq!(newest(&c), ("GUID_TIMEOUT".to_owned(), 3.0));
    let set = |value| {
        MavMessage::PARAM_SET(PARAM_SET_DATA {
            param_value: value,
            target_system: 1,
            target_component: 1,
            param_id: "FS_GCS_ENABLE".into(),
            ..Default::default()
        })
    };
    c.send(&set(0.0));
    c.tick();
    assert_eq!(newest(&c), ("FS_GCS_ENABLE".to_owned(), 0.0));
    c.send(&set(f32::NAN));
    c.tick();
    assert_eq!(newest(&c).1, 0.0);
}

/// Messages for another vehicle on the same link.
#[test]
fn ignores_messages_to_other_systems() {
    let mut c = Companion::new(SimulationConfig::default());
    c.prepare();
    c.send(&MavMessage::SET_MODE(SET_MODE_DATA {
        custom_mode: 4,
        target_system: 7,
        ..Default::default()
    }));
    c.wait(0.1);
    assert_eq!(c.mode(), CopterMode::Stabilize);
    assert!(c.acks.is_empty());
}
