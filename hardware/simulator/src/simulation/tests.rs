use super::companion::Companion;
use super::*;
use crate::mocap::formats::encode_object;
use proptest::prelude::*;
use vizflyt_protocol::geometry::{wrap_pi, yaw_of};
use vizflyt_protocol::mavlink::dialect::{
    EkfStatusFlags, MavCmd, MavFrame, MavMessage, MavResult, PARAM_REQUEST_LIST_DATA,
    PositionTargetTypemask, SET_POSITION_TARGET_LOCAL_NED_DATA,
};
use vizflyt_protocol::mavlink::{CopterMode, GuidedMotion, MavHeader, encode};
use vizflyt_protocol::messages::YawTarget;

#[test]
fn takes_off_hovers_and_lands() {
    let spawn_m = DVec3::new(2.0, -1.0, 0.0);
    let config = SimulationConfig { spawn_m, spawn_yaw_rad: 0.5, seed: 3, ..Default::default() };
    let mut c = Companion::hovering(config, 1.2);
    let (mut worst, mut errors) = (0f64, Vec::new());
    for _ in 0..2000 {
        c.tick();
        worst = worst.max((c.p() - spawn_m - DVec3::Z * 1.2).length());
        let estimate = c.lab.autopilot().estimator().estimate();
        errors.push((estimate.p_world_m - c.p()).truncate().length());
    }
    errors.sort_by(f64::total_cmp);
    let median = errors[errors.len() / 2];
    println!("hover: worst {worst:.3} m, estimate median {median:.4} m");
    assert!(worst < 0.15, "hover wanders {worst}");
    assert!(median < 0.02, "estimate off by {median}");
    assert!(wrap_pi(yaw_of(c.lab.state().world_from_body) - 0.5).abs() < 0.05);
    c.set_mode(CopterMode::Land);
    let seconds = c.until(15.0, "the disarm", |c| !c.lab.autopilot().is_armed());
    println!("landed after {seconds:.1} s");
    c.wait(1.0);
    let report = c.lab.report();
    assert!(report.truth.landed && !report.truth.collided);
    assert!(c.p().z.abs() < 0.01 && c.v().length() < 0.01);
}

/// Returns when the vehicle is armed, and when it is in the air [s], with a companion that repeats its commands ten
/// times a second.
fn started(startup: Startup) -> (f64, f64) {
    let config = SimulationConfig { startup, ..SimulationConfig::airframe() };
    let mut c = Companion::new(config);
    let mut armed_s = None;
    for _ in 0..200 {
        c.wait(0.1);
        let now_s = c.lab.since_start_s();
        c.set_origin();
        c.set_mode(CopterMode::Guided);
        if c.lab.autopilot().estimator().health(c.lab.autopilot_now()).position {
            c.arm();
        }
        if c.lab.autopilot().is_armed() {
            armed_s.get_or_insert(now_s);
            c.take_off(1.2);
        }
        if c.p().z > 0.9 * 1.2 {
            return (armed_s.unwrap_or(f64::NAN), now_s);
        }
    }
    panic!("no take-off: {:?}", c.texts);
}

#[test]
fn a_quick_start_saves_seconds() {
    let (quick_armed_s, quick_risen_s) = started(Startup::Quick);
    let (armed_s, risen_s) = started(Startup::Realistic);
    println!(
        "quick {quick_armed_s:.2}, {quick_risen_s:.2} s; realistic {armed_s:.2}, {risen_s:.2} s"
    );
    assert!(quick_armed_s <= 0.5, "armed after {quick_armed_s} s");
    assert!((3.0..3.5).contains(&armed_s), "a realistic start takes {armed_s} s");
    // The climb has the same physics.
    let climbs_s = (quick_risen_s - quick_armed_s, risen_s - armed_s);
    assert!((climbs_s.0 - climbs_s.1).abs() < 0.15, "{climbs_s:?}");
    assert!(quick_risen_s < 3.5, "in the air after {quick_risen_s} s");
}

#[test]
fn the_estimate_is_accurate_after_a_quick_start() {
    for seed in 0..4 {
        let startup = Startup::Quick;
        let mut c = Companion::new(SimulationConfig { seed, startup, ..Default::default() });
        let attitude =
            |c: &Companion| c.lab.autopilot().estimator().health(c.lab.autopilot_now()).attitude;
        assert!(attitude(&c), "aligned before the start");
        c.prepare();
        assert_eq!(c.set_mode(CopterMode::Guided), MavResult::MAV_RESULT_ACCEPTED);
        assert_eq!(c.arm(), MavResult::MAV_RESULT_ACCEPTED);
        assert_eq!(c.take_off(1.2), MavResult::MAV_RESULT_ACCEPTED);
        let mut worst_m = 0f64;
        for _ in 0..8 * TICK_HZ {
            c.tick();
            let p_world_m = c.lab.autopilot().estimator().estimate().p_world_m;
            worst_m = worst_m.max((p_world_m - c.p()).truncate().length());
        }
        assert!(worst_m < 0.1, "seed {seed}: the estimate is {worst_m:.3} m off");
        // A power failure requires a new alignment.
        c.lab.reboot();
        c.wait(BOOT_S + 0.1);
        assert!(!attitude(&c), "it aligns again");
    }
}

#[test]
fn a_quick_start_reports_readiness_at_once() {
    let position_reported_s = |startup| {
        let mut c = Companion::new(SimulationConfig { startup, ..Default::default() });
        c.wait(2.6);
        c.set_origin();
        let reported = |c: &Companion| match c.newest.get(&193) {
            Some(MavMessage::EKF_STATUS_REPORT(m)) => {
                m.flags.contains(EkfStatusFlags::EKF_POS_HORIZ_ABS)
            }
            _ => false,
        };
        let health =
            |c: &Companion| c.lab.autopilot().estimator().health(c.lab.autopilot_now()).position;
        c.until(5.0, "a position", health);
        c.until(5.0, "its report", reported)
    };
    assert!(position_reported_s(Startup::Quick) <= TICK_S);
    assert!(position_reported_s(Startup::Realistic) > TICK_S);
}

#[test]
fn velocity_steps_are_followed_with_little_overshoot() {
    for (speed, yaw) in [(1.0, 0.0), (3.0, 1.0), (6.0, -2.0)] {
        let mut c = Companion::hovering(SimulationConfig::airframe(), 1.5);
        let v = DVec3::new(speed, 0.0, 0.0);
        c.fly(GuidedMotion::Velocity(v), YawTarget::Angle(yaw));
        let (mut reached, mut peak, mut lowest) = (None, 0f64, f64::INFINITY);
        for tick in 0..1600 {
            c.tick();
            peak = peak.max(c.v().x);
            lowest = lowest.min(c.p().z);
            if c.v().x > 0.9 * speed {
                reached.get_or_insert(f64::from(tick) * TICK_S);
            }
        }
        println!(
            "{speed} m/s: 90 % after {reached:?} s, peak {peak:.2}, lowest {lowest:.2} m, now {:?}",
            c.v()
        );
        assert!(peak < 1.15 * speed, "overshoot to {peak} of {speed}");
        assert!((c.v() - v).length() < 0.15, "{:?}", c.v());
        assert!(reached.unwrap() < 0.9 + speed / 6.0);
        assert!((c.p().z - 1.5).abs() < 0.15 && lowest > 1.2);
        // Then full reverse.
        c.fly(GuidedMotion::Velocity(-v), YawTarget::Angle(yaw));
        let mut trough = 0f64;
        for _ in 0..2000 {
            c.tick();
            trough = trough.min(c.v().x);
        }
        assert!(trough > -1.15 * speed && (c.v() + v).length() < 0.15, "{trough} {:?}", c.v());
    }
}

#[test]
fn position_steps_are_reached_and_held() {
    let config = SimulationConfig {
        params: vec![("WP_SPD".into(), 3.0), ("WP_SPD_UP".into(), 1.5)],
        ..Default::default()
    };
    let mut c = Companion::hovering(config, 1.0);
    let target = DVec3::new(4.0, -3.0, 2.0);
    // Sent once: a position needs no resending.
    c.set_once(GuidedMotion::Position(target), YawTarget::Angle(1.0));
    let (mut beyond, mut fastest) = (0f64, 0f64);
    let way = target - c.p();
    for _ in 0..4000 {
        c.tick();
        beyond = beyond.max((c.p() - target).dot(way.normalize()));
        fastest = fastest.max(c.v().truncate().length());
    }
    println!(
        "position step: beyond {beyond:.3} m, fastest {fastest:.2} m/s, left {:.3} m",
        (c.p() - target).length()
    );
    assert!(beyond < 0.15 * way.length());
    assert!((c.p() - target).length() < 0.08, "{:?}", c.p());
    assert!(fastest < 3.3, "WP_SPD holds for positions: {fastest}");
    assert!(wrap_pi(yaw_of(c.lab.state().world_from_body) - 1.0).abs() < 0.05);
}

#[test]
fn follows_a_moving_point() {
    let mut c = Companion::hovering(SimulationConfig::default(), 1.2);
    let (start, v) = (c.p(), DVec3::new(0.0, 1.5, 0.0));
    // Resent at 10 Hz, like a trajectory follower.
    for i in 0..60 {
        let p = start + v * (f64::from(i) * 0.1);
        c.set_once(GuidedMotion::PositionVelocity(p, v), YawTarget::Angle(0.0));
        c.wait(0.1);
    }
    let wanted = start + v * 6.0;
    assert!((c.p() - wanted).length() < 0.35, "{:?} wanted {wanted:?}", c.p());
    assert!((c.v() - v).length() < 0.2);
}

#[test]
fn accelerations_are_flown_and_zero_keeps_the_velocity() {
    let mut c = Companion::hovering(SimulationConfig::default(), 1.5);
    c.fly(GuidedMotion::Acceleration(DVec3::new(2.0, 0.0, 0.0)), YawTarget::Angle(0.0));
    c.wait(1.0);
    assert!((1.2..2.3).contains(&c.v().x), "{:?}", c.v());
    c.fly(GuidedMotion::Acceleration(DVec3::ZERO), YawTarget::Angle(0.0));
    c.wait(1.0);
    let kept = c.v().x;
    assert!((1.7..2.5).contains(&kept), "{kept}");
    c.wait(1.0);
    assert!((c.v().x - kept).abs() < 0.35 && (c.p().z - 1.5).abs() < 0.3, "{:?}", c.v());
}

/// Zigzag at 5 m/s with the hardest turns: the estimate must follow the truth.
#[test]
fn the_estimate_is_accurate_in_aggressive_flight() {
    let check = |latency_s: f64, set_ms: f32, most_m: f64| {
        let params = vec![("VISO_DELAY_MS".into(), set_ms)];
        let mut c = Companion::hovering(SimulationConfig { params, ..Default::default() }, 1.5);
        c.vision_latency_s = latency_s;
        let mut errors = Vec::new();
        for i in 0..12 {
            let side = if i % 2 == 0 { 5.0 } else { -5.0 };
            c.fly(GuidedMotion::Velocity(DVec3::new(2.0, side, 0.0)), YawTarget::Angle(0.3));
            for _ in 0..400 {
                c.tick();
                let estimate = c.lab.autopilot().estimator().estimate();
                errors.push((estimate.p_world_m - c.p()).truncate().length());
            }
        }
        errors.sort_by(f64::total_cmp);
        let (median, worst) = (errors[errors.len() / 2], errors[errors.len() - 1]);
        println!(
            "latency {latency_s} s, set to {set_ms} ms: median {median:.3} m, worst {worst:.3} m"
        );
        assert!(median < most_m, "{median}");
        assert!(worst < 8.0 * most_m, "{worst}");
    };
    // This companion sends without delay: nothing to compensate.
    check(0.0, 0.0, 0.03);
    // The parameter's default of 10 ms then causes 5 cm of error at 5 m/s.
    check(0.0, 10.0, 0.08);
    check(0.06, 60.0, 0.06);
}

#[test]
fn a_velocity_setpoint_expires_after_three_seconds_but_a_position_is_held() {
    let mut c = Companion::hovering(SimulationConfig::default(), 1.2);
    let start = c.p();
    c.set_once(GuidedMotion::Velocity(DVec3::new(0.5, 0.0, 0.0)), YawTarget::Angle(0.0));
    c.wait(2.9);
    assert!((c.v().x - 0.5).abs() < 0.1);
    // A real ArduCopter stopped after 3.7 s and 1.4 m.
    c.wait(1.3);
    let stopped = c.p();
    assert!(c.v().length() < 0.1, "{:?}", c.v());
    assert!((1.2..1.7).contains(&(stopped - start).length()), "{:?}", stopped - start);
    c.wait(10.0);
    assert!((c.p() - stopped).length() < 0.15);
    c.set_once(GuidedMotion::Position(start), YawTarget::Angle(0.0));
    c.wait(20.0);
    assert!((c.p() - start).length() < 0.1);
}

#[test]
fn ignored_yaw_turns_the_nose_into_travel() {
    let turned_by = |behavior: f32, yaw: YawTarget| {
        let params = vec![("WP_YAW_BEHAVIOR".into(), behavior)];
        let mut c = Companion::hovering(SimulationConfig { params, ..Default::default() }, 1.2);
        c.fly(GuidedMotion::Velocity(DVec3::new(-1.0, 0.0, 0.0)), yaw);
        c.wait(4.0);
        wrap_pi(yaw_of(c.lab.state().world_from_body)).abs()
    };
    assert!(turned_by(2.0, YawTarget::Keep) > 3.0, "the pitfall");
    assert!(turned_by(0.0, YawTarget::Keep) < 0.1);
    assert!(turned_by(2.0, YawTarget::Angle(0.0)) < 0.1);
    // 0.5 rad/s for 4 s.
    let rate = turned_by(2.0, YawTarget::Rate(0.5));
    assert!((1.7..2.2).contains(&rate), "{rate}");
}

#[test]
fn compensates_steady_wind() {
    let mut c = Companion::hovering(SimulationConfig::default(), 1.2);
    let start = c.p();
    c.lab.set_wind(DVec3::new(2.0, -1.0, 0.0));
    c.wait(8.0);
    assert!((c.p() - start).length() < 0.2, "{:?}", c.p() - start);
}

#[test]
fn the_same_seed_sends_the_same_bytes() {
    let run = |seed| {
        let mut lab = Simulation::new(SimulationConfig { seed, ..Default::default() }).unwrap();
        let mut sent = Vec::new();
        for _ in 0..2000 {
            lab.tick();
            while let Some(packet) = lab.poll_mavlink(&mut [0; MAX_PACKET]) {
                sent.extend_from_slice(packet);
            }
            while let Some(sight) = lab.poll_mocap() {
                sent.extend(encode_object(sight.frame, "vizflyt", &sight.world_from_body));
            }
        }
        sent
    };
    assert_eq!(run(4), run(4));
    assert_ne!(run(4), run(5));
}

/// The impact clips the accelerometer, and the estimate must not integrate the clipped values; otherwise it estimates a
/// descent and climbs away.
#[test]
fn a_crash_landing_does_not_end_in_a_fly_away() {
    let mut c = Companion::hovering(SimulationConfig::airframe(), 4.0);
    c.set_mode(CopterMode::Stabilize);
    c.until(2.0, "the floor", |c| c.p().z < 0.0);
    assert!(c.lab.autopilot().is_armed() && c.v().z < -5.0, "{:?}", c.v());
    c.wait(0.1);
    c.set_mode(CopterMode::Land);
    let mut highest = 0f64;
    for _ in 0..4000 {
        c.tick();
        highest = highest.max(c.p().z);
    }
    assert!(highest < 0.5, "climbed to {highest}");
    assert!(!c.lab.autopilot().is_armed());
    let estimate = c.lab.autopilot().estimator().estimate();
    assert!((estimate.p_world_m - c.p()).length() < 0.1);
}

/// One operation on a flying vehicle.
#[derive(Clone, Debug)]
enum Operation {
    Setpoint(u16, [f32; 11]),
    Mode(u32),
    Vision(bool),
    Arm,
    TakeOff(f32),
    Garbage(Vec<u8>),
    Wait(f64),
    Wind([f64; 3]),
}

fn number() -> impl Strategy<Value = f32> {
    prop_oneof![
        12 => -10.0..10.0f32,
        1 => prop::num::f32::ANY,
        1 => Just(f32::NAN),
        1 => Just(1e30f32),
    ]
}

fn operation() -> impl Strategy<Value = Operation> {
    let masks = prop_oneof![
        Just(0xDF8u16),
        Just(0x9F8),
        Just(0x9C7),
        Just(0x5C7),
        Just(0x9C0),
        Just(0x83F),
        Just(0xDC7),
        0..4096u16,
    ];
    prop_oneof![
        6 => (masks, prop::array::uniform11(number())).prop_map(|(m, v)| Operation::Setpoint(m, v)),
        1 => prop_oneof![Just(0u32), Just(4), Just(6), Just(9), Just(17), 0..30u32].prop_map(Operation::Mode),
        1 => any::<bool>().prop_map(Operation::Vision),
        1 => Just(Operation::Arm),
        1 => number().prop_map(Operation::TakeOff),
        1 => prop::collection::vec(any::<u8>(), 0..400).prop_map(Operation::Garbage),
        5 => (0.01..2.0f64).prop_map(Operation::Wait),
        1 => prop::array::uniform3(-3.0..3.0f64).prop_map(Operation::Wind),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 128, failure_persistence: None, ..Default::default() })]
    /// `Companion::tick` asserts after every tick that the state is finite and the attitude is normalized; here the
    /// estimate is also checked.
    #[test]
    fn the_flight_stays_finite_for_any_input(
        operations in prop::collection::vec(operation(), 1..40), seed in 0..1000u64,
    ) {
        let mut c = Companion::hovering(SimulationConfig { seed, ..Default::default() }, 1.0);
        for operation in operations {
            match operation {
                Operation::Setpoint(mask, v) => {
                    let message = SET_POSITION_TARGET_LOCAL_NED_DATA {
                        x: v[0], y: v[1], z: v[2], vx: v[3], vy: v[4], vz: v[5],
                        afx: v[6], afy: v[7], afz: v[8], yaw: v[9], yaw_rate: v[10],
                        type_mask: PositionTargetTypemask::from_bits_retain(mask),
                        target_system: 1, target_component: 1,
                        coordinate_frame: MavFrame::MAV_FRAME_LOCAL_NED,
                        time_boot_ms: 0,
                    };
                    c.send(&MavMessage::SET_POSITION_TARGET_LOCAL_NED(message));
                }
                Operation::Mode(number) => {
                    c.command(MavCmd::MAV_CMD_DO_SET_MODE, [1.0, number as f32, 0.0, 0.0, 0.0, 0.0, 0.0]);
                }
                Operation::Vision(on) => c.vision = on,
                Operation::Arm => { c.arm(); }
                Operation::TakeOff(height) => { c.take_off(height); }
                Operation::Garbage(bytes) => {
                    c.lab.handle_mavlink(0, &bytes);
                    // Ends a packet that the garbage may have begun.
                    c.lab.handle_mavlink(0, &[0; 600]);
                }
                Operation::Wait(seconds) => c.wait(seconds),
                Operation::Wind(wind) => c.lab.set_wind(DVec3::from(wind)),
            }
            c.tick();
            let estimate = c.lab.autopilot().estimator().estimate();
            prop_assert!(estimate.p_world_m.is_finite() && estimate.v_world_mps.is_finite());
            prop_assert!(estimate.world_from_body.is_normalized());
            prop_assert!(c.v().length() < 80.0, "{:?}", c.v());
        }
        // It can still land, unless it is far away or high up.
        c.lab.set_wind(DVec3::ZERO);
        c.vision = true;
        // A few good packets flush garbage from the decoder.
        c.wait(2.0);
        if c.lab.autopilot().is_armed() && c.p().z < 20.0 && c.v().length() < 3.0 {
            c.set_mode(CopterMode::Land);
            c.until(60.0, "a landing", |c| !c.lab.autopilot().is_armed());
        }
    }

    #[test]
    fn accepts_packets_after_garbage(garbage in prop::collection::vec(any::<u8>(), 0..600)) {
        let mut lab = Simulation::new(SimulationConfig::default()).unwrap();
        lab.tick();
        lab.handle_mavlink(0, &garbage);
        // Ends a packet that the garbage may have begun.
        lab.handle_mavlink(0, &[0; 600]);
        while lab.poll_mavlink(&mut [0; MAX_PACKET]).is_some() {}
        let request = MavMessage::PARAM_REQUEST_LIST(
            PARAM_REQUEST_LIST_DATA { target_system: 1, target_component: 1 },
        );
        let header = MavHeader { system_id: 255, component_id: 1, sequence: 0 };
        lab.handle_mavlink(0, encode(header, &request, &mut [0; MAX_PACKET]));
        let mut answers = 0;
        while lab.poll_mavlink(&mut [0; MAX_PACKET]).is_some() {
            answers += 1;
        }
        prop_assert_eq!(answers, crate::autopilot::TABLE.len());
    }
}
