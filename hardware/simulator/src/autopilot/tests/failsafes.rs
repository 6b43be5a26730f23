//! Fence, battery, radio control, reboot, and faults of the vehicle.

use super::*;
use crate::autopilot::Radio;
use crate::simulation::faults::{Faults, MotorFault};
use crate::wifi::WifiConfig;
use vizflyt_protocol::mavlink::dialect::FenceBreach;

fn config(params: &[(&str, f32)]) -> SimulationConfig {
    let params = params.iter().map(|&(name, value)| (name.to_owned(), value)).collect();
    SimulationConfig { params, ..Default::default() }
}

const FENCE: [(&str, f32); 4] =
    [("FENCE_ENABLE", 1.0), ("FENCE_RADIUS", 2.0), ("FENCE_ALT_MAX", 2.5), ("FENCE_ACTION", 2.0)];

#[test]
fn a_fence_breach_lands() {
    for (velocity, side) in [
        (DVec3::X, FenceBreach::FENCE_BREACH_BOUNDARY),
        (DVec3::Z * 0.5, FenceBreach::FENCE_BREACH_MAXALT),
    ] {
        let mut c = Companion::hovering(config(&FENCE), 1.2);
        c.fly(GuidedMotion::Velocity(velocity), YawTarget::Angle(0.0));
        c.until(8.0, "LAND", |c| c.mode() == CopterMode::Land);
        assert!(c.texts_contain("fence breached"), "{:?}", c.texts);
        c.wait(1.1);
        let Some(MavMessage::FENCE_STATUS(m)) = c.newest.get(&162) else { panic!() };
        assert_eq!((m.breach_count, m.breach_type), (1, side));
        c.until(15.0, "the disarm", |c| !c.armed());
        assert!(c.p().truncate().length() < 3.0, "{:?}", c.p());
    }
}

#[test]
fn rejects_position_targets_beyond_the_fence() {
    let mut c = Companion::hovering(config(&FENCE), 1.2);
    c.fly(GuidedMotion::Position(DVec3::new(5.0, 0.0, 1.2)), YawTarget::Angle(0.0));
    c.wait(5.0);
    assert!(c.p().truncate().length() < 0.2, "{:?}", c.p());
    c.fly(GuidedMotion::Position(DVec3::new(1.5, 0.0, 1.2)), YawTarget::Angle(0.0));
    c.wait(5.0);
    assert!((c.p().x - 1.5).abs() < 0.1, "{:?}", c.p());
}

#[test]
fn the_fence_can_only_report_and_is_switched_by_command() {
    let mut quiet = FENCE;
    quiet[3].1 = 0.0;
    let mut c = Companion::hovering(config(&quiet), 1.2);
    c.fly(GuidedMotion::Velocity(DVec3::X), YawTarget::Angle(0.0));
    c.wait(4.0);
    assert!(c.texts_contain("Circle fence breached") && c.mode() == CopterMode::Guided);
    c.texts.clear();
    let off = [0.0; 7];
    assert_eq!(c.command(MavCmd::MAV_CMD_DO_FENCE_ENABLE, off), ACCEPTED);
    c.wait(3.0);
    assert!(!c.texts_contain("breached"));
}

/// RTL stays below the fence's ceiling: the published failsafe with an enabled fence.
#[test]
fn the_ceiling_limits_the_climb_of_rtl() {
    let mut params = FENCE.to_vec();
    params.extend([("FS_GCS_ENABLE", 1.0), ("FENCE_MARGIN", 0.5)]);
    let mut c = Companion::hovering(config(&params), 1.0);
    c.heartbeats = false;
    let mut highest = 0f64;
    for _ in 0..20_000 {
        c.tick();
        highest = highest.max(c.p().z);
    }
    assert!(c.texts_contain("GCS Failsafe - RTL") && highest < 2.4, "{highest}");
    assert!(!c.armed() && c.p().z < 0.05);
}

#[test]
fn low_battery_voltage_lands() {
    let low = [("BATT_LOW_TIMER", 2.0), ("BATT_CRT_VOLT", 0.0)];
    let mut c = Companion::hovering(SimulationConfig { battery_share: 0.33, ..config(&low) }, 1.0);
    c.until(120.0, "LAND", |c| c.mode() == CopterMode::Land);
    assert!(c.texts_contain("Battery 1 is low 13.9"), "{:?}", c.texts);
    c.until(15.0, "the disarm", |c| !c.armed());
    assert_eq!(c.set_mode(CopterMode::Guided), ACCEPTED);
    assert_eq!(c.arm(), FAILED);
    assert!(c.texts_contain("low voltage failsafe"));
    // The battery started at a third; the autopilot counts from boot and reports more.
    let Some(MavMessage::SYS_STATUS(m)) = c.newest.get(&1) else { panic!() };
    assert!(m.battery_remaining > 60, "{}", m.battery_remaining);
}

#[test]
fn low_charge_is_reported_and_no_monitor_means_no_failsafe() {
    let mah = [("BATT_LOW_MAH", 845.0), ("BATT_FS_LOW_ACT", 0.0), ("BATT_LOW_VOLT", 0.0)];
    let mut c = Companion::hovering(config(&mah), 1.0);
    c.until(30.0, "the warning", |c| c.texts_contain("Battery 1 is low"));
    assert_eq!(c.mode(), CopterMode::Guided);

    let none = [("BATT_MONITOR", 0.0)];
    let mut c = Companion::hovering(SimulationConfig { battery_share: 0.1, ..config(&none) }, 1.0);
    c.wait(15.0);
    let Some(MavMessage::SYS_STATUS(m)) = c.newest.get(&1) else { panic!() };
    assert_eq!((m.voltage_battery, m.current_battery, m.battery_remaining), (0, -1, -1));
    assert!(c.mode() == CopterMode::Guided && !c.newest.contains_key(&147));

    let mut c = Companion::new(SimulationConfig {
        battery_share: 0.5,
        ..config(&[("BATT_ARM_VOLT", 16.0)])
    });
    c.prepare();
    assert_eq!(c.arm(), FAILED);
    assert!(c.texts_contain("below minimum arming voltage"));
}

#[test]
fn lost_radio_control_acts_after_its_timeout() {
    let faults = Faults { radio_lost_after_s: Some(8.0), ..Default::default() };
    for (setting, options, expected) in [
        (3.0, 16.0, CopterMode::Land),
        (1.0, 16.0, CopterMode::Rtl),
        (3.0, 4.0, CopterMode::Guided),
        (0.0, 16.0, CopterMode::Guided),
    ] {
        let params = [("FS_THR_ENABLE", setting), ("FS_OPTIONS", options), ("RTL_ALT_M", 1.0)];
        let mut c =
            Companion::hovering(SimulationConfig { radio: true, faults, ..config(&params) }, 1.0);
        c.wait(6.0);
        assert_eq!(c.mode(), expected, "FS_THR_ENABLE {setting} FS_OPTIONS {options}");
        assert_eq!(c.texts_contain("Radio Failsafe"), setting != 0.0);
        if expected == CopterMode::Guided && setting != 0.0 {
            c.lab.set_radio(Radio::Receiving);
            c.wait(0.1);
            assert!(c.texts_contain("Radio Failsafe Cleared"));
        }
    }
}

/// A pilot continues without a ground station if FS_OPTIONS allows it.
#[test]
fn pilot_control_continues_if_configured() {
    for (options, expected) in [(24.0, CopterMode::AltHold), (8.0, CopterMode::Land)] {
        let params = [("FS_GCS_ENABLE", 5.0), ("FS_OPTIONS", options)];
        let mut c = Companion::hovering(config(&params), 1.5);
        c.heartbeats = false;
        c.set_mode(CopterMode::AltHold);
        c.until(7.0, "the failsafe", |c| c.texts_contain("GCS Failsafe"));
        assert_eq!(c.mode(), expected, "{:?}", c.texts);
    }
}

/// A landing continues despite further failsafes if FS_OPTIONS allows it; otherwise the later failsafe acts.
#[test]
fn a_landing_continues_if_configured_by_fs_options() {
    for (options, expected) in [(8.0, CopterMode::Land), (0.0, CopterMode::Rtl)] {
        let params = [("FS_GCS_ENABLE", 1.0), ("FS_OPTIONS", options)];
        let mut c = Companion::hovering(config(&params), 6.0);
        c.heartbeats = false;
        c.set_mode(CopterMode::Land);
        c.until(7.0, "the failsafe", |c| c.texts_contain("GCS Failsafe"));
        assert_eq!(c.mode(), expected, "{:?}", c.texts);
    }
}

#[test]
fn a_reboot_in_flight_drops_the_vehicle_and_restarts_its_clock() {
    let faults = Faults { reboot_after_s: Some(8.0), ..Default::default() };
    let params = [("GUID_TIMEOUT", 2.0)];
    let mut c = Companion::hovering(SimulationConfig { faults, ..config(&params) }, 1.2);
    let start = c.p();
    c.until(10.0, "the reboot", |c| c.lab.report().reboots == 1);
    let (before, sent) = (c.lab.autopilot_now(), c.counts[&0]);
    assert_eq!(before.as_ns(), 0);
    c.wait(1.4);
    assert_eq!(c.counts[&0], sent, "no messages during the boot");
    assert!(c.p().z < 0.05 && (c.p() - start).truncate().length() < 0.3, "{:?}", c.p());
    c.wait(4.0);
    let Some(MavMessage::ATTITUDE(m)) = c.newest.get(&30) else { panic!() };
    assert!(m.time_boot_ms < 4000, "{}", m.time_boot_ms);
    assert!(!c.armed() && c.mode() == CopterMode::Stabilize);
    // The autopilot has lost the origin, but kept its parameters.
    let health = c.lab.autopilot().estimator().health(c.lab.autopilot_now());
    assert!(health.attitude && !health.origin);
    c.set_origin();
    c.until(8.0, "the checks", Companion::prearm_good);
    c.wait(3.0);
    c.set_mode(CopterMode::Guided);
    assert_eq!((c.arm(), c.take_off(1.0)), (ACCEPTED, ACCEPTED));
    c.until(10.0, "the height", |c| c.p().z > 0.9);
}

#[test]
fn rejects_a_reboot_while_armed_unless_forced() {
    let reboot = |force: f32| [1.0, 0.0, 0.0, 0.0, 0.0, force, 0.0];
    let command = MavCmd::MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN;
    let mut c = Companion::hovering(SimulationConfig::default(), 1.0);
    assert_eq!(c.command(command, reboot(0.0)), FAILED);
    assert!(c.armed());
    c.ask(command, reboot(20_190_226.0));
    c.wait(2.0);
    assert!(!c.armed() && c.lab.report().reboots == 1);
}

#[test]
fn a_dead_motor_crashes_and_a_weak_one_does_not() {
    let with = |share: f64| {
        let motor = Some(MotorFault { motor: 1, share, after_s: 8.0 });
        let faults = Faults { motor, ..Default::default() };
        // Hard climbs, so that the vehicle topples with a dead motor.
        let hard =
            [("WP_ACC_Z", 4.0), ("PSC_JERK_D", 50.0), ("WP_ACC", 8.0), ("PSC_JERK_NE", 80.0)];
        let mut c = Companion::hovering(SimulationConfig { faults, ..config(&hard) }, 1.5);
        c.wait(9.0);
        c
    };
    // Without any thrust it may land upright; with a little it topples.
    let dead = with(0.2);
    assert!(
        dead.p().z < 0.3 && !dead.armed() && dead.texts_contain("Crash: Disarming"),
        "{:?} {:?}",
        dead.p(),
        dead.texts
    );
    let weak = with(0.7);
    assert!((weak.p().z - 1.5).abs() < 0.2 && weak.armed(), "{:?}", weak.p());
}

#[test]
fn reports_vibration_and_flies_with_it() {
    let level = |vibration_mps2: f64| {
        let config = SimulationConfig { vibration_mps2, ..SimulationConfig::airframe() };
        let mut c = Companion::hovering(config, 1.2);
        c.wait(5.0);
        assert!((c.p() - DVec3::Z * 1.2).length() < 0.25, "{:?}", c.p());
        let Some(MavMessage::VIBRATION(m)) = c.newest.get(&241) else { panic!() };
        m.vibration_x
    };
    let (still, shaken) = (level(0.0), level(200.0));
    assert!(still < 1.0, "{still}");
    // Rotors of nearly equal speed beat: up to four times the amplitude of one.
    assert!((8.0..100.0).contains(&shaken), "{shaken}");
}

#[test]
fn holds_position_in_gusts() {
    let config = SimulationConfig { gust_mps: 2.0, seed: 6, ..Default::default() };
    let mut c = Companion::hovering(config, 1.2);
    let start = c.p();
    let (mut worst, mut fastest) = (0f64, 0f64);
    for _ in 0..8000 {
        c.tick();
        worst = worst.max((c.p() - start).length());
        fastest = fastest.max(c.v().length());
    }
    println!("gusts of 2 m/s: maximum error {worst:.2} m, maximum speed {fastest:.2} m/s");
    assert!(worst < 0.4 && fastest > 0.1, "{worst} {fastest}");
}

/// Vision, commands and telemetry all pass the Wi-Fi model, and the vehicle still flies.
#[test]
fn flies_over_a_lossy_wifi() {
    let wifi = WifiConfig { seed: 3, loss: 0.1, latency_s: 0.01, ..Default::default() };
    let mut c = Companion::new(SimulationConfig { wifi: Some(wifi), ..Default::default() });
    c.wait(2.5);
    // Any packet may be lost, so each request is repeated until its effect is visible.
    let until_heard =
        |c: &mut Companion, ask: &dyn Fn(&mut Companion), received: &dyn Fn(&Companion) -> bool| {
            for _ in 0..40 {
                ask(c);
                c.wait(0.5);
                if received(c) {
                    return;
                }
            }
            panic!("not received; texts {:?}", c.texts);
        };
    let one = |param1: f32, param2: f32, param7: f32| [param1, param2, 0.0, 0.0, 0.0, 0.0, param7];
    until_heard(&mut c, &Companion::set_origin, &|c| c.newest.contains_key(&49));
    c.wait(4.0);
    let guided = |c: &mut Companion| c.ask(MavCmd::MAV_CMD_DO_SET_MODE, one(1.0, 4.0, 0.0));
    until_heard(&mut c, &guided, &|c| c.mode() == CopterMode::Guided);
    let arm = |c: &mut Companion| c.ask(MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, one(1.0, 0.0, 0.0));
    until_heard(&mut c, &arm, &Companion::armed);
    let take_off = |c: &mut Companion| c.ask(MavCmd::MAV_CMD_NAV_TAKEOFF, one(0.0, 0.0, 1.2));
    until_heard(&mut c, &take_off, &|c| c.p().z > 0.1);
    c.wait(4.0);
    let start = c.p();
    c.fly(GuidedMotion::Velocity(DVec3::X), YawTarget::Angle(0.0));
    c.wait(3.0);
    assert!((c.v() - DVec3::X).length() < 0.2, "{:?}", c.v());
    assert!((2.0..3.2).contains(&(c.p() - start).x), "{:?}", c.p());
    let land = |c: &mut Companion| c.ask(MavCmd::MAV_CMD_NAV_LAND, [0.0; 7]);
    until_heard(&mut c, &land, &|c| c.mode() == CopterMode::Land);
    c.until(15.0, "the disarm", |c| !c.armed());
    let report = c.lab.report();
    let share = report.wifi_packets_lost as f64
        / (report.mavlink_packets_in + report.mavlink_packets_out) as f64;
    assert!((0.04..0.25).contains(&share), "{share}");
}
