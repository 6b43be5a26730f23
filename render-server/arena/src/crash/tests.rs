//! One flight for each rule of the probable cause, and the drawings of a flight.

use glam::{DVec3, Quat, Vec3};
use vizflyt_protocol::flight_end::{
    Boundary, Collision, EndReason, FenceBreach, Obstacle, PluginFault,
};
use vizflyt_protocol::messages::{
    Axes, Event, EventKind, FlightPhase, InvalidSetpoint, Setpoint, YawTarget, bounded,
};
use vizflyt_protocol::time::ServerTime;

use super::*;
use crate::config::{CameraConfig, StageConfig};
use crate::referee::tests::arena;
use crate::verdict::judge;
use crate::{ArenaConfig, BakeSpec, DistanceField, Ellipsoid, OccupancyGrid};

/// Time of the end of every flight here, since its start. [s]
const END_S: f64 = 12.0;

fn at(s: f64) -> ServerTime {
    ServerTime::ZERO.plus_seconds(1.0 + s)
}

/// Returns the arena of the referee's tests with a forward camera, and a wall across it at x = 4.
fn room() -> (ArenaConfig, DistanceField) {
    let mut config = arena();
    config.cameras = vec![CameraConfig::ahead("front", [320, 240], 90.0, DVec3::ZERO)];
    config.stages = vec![StageConfig {
        name: "window".into(),
        center_m: DVec3::new(2.0, 0.0, 1.0),
        normal: DVec3::X,
        width_m: 1.0,
        height_m: 0.8,
        ..StageConfig::default()
    }];
    let cell = |y: usize, z: usize| Ellipsoid {
        center_m: Vec3::new(4.0, y as f32 * 0.05 - 3.0, z as f32 * 0.05),
        scales_m: Vec3::splat(0.05),
        rotation: Quat::IDENTITY,
        opacity: 0.95,
    };
    let wall = (0..120).flat_map(|y| (0..80).map(move |z| cell(y, z)));
    let field = DistanceField::of(OccupancyGrid::bake(wall, &BakeSpec::of(&config)));
    (config, field)
}

/// Parameters of a flight.
#[derive(Clone)]
struct Case {
    /// Position at the end. [m, world]
    end_m: DVec3,
    v_mps: DVec3,
    /// Deceleration at the end. [m/s^2]
    braking_mps2: f64,
    /// Yaw at the end. [rad]
    yaw_rad: f64,
    turn_radps: f64,
    end: Option<EndReason>,
    /// Times of replies before the end [s]; `None` if not recorded.
    asked_before_s: Option<Vec<f64>>,
    setpoint: Option<Setpoint>,
    /// Distance within which the obstacle is visible; from farther away, the image shows 20 m. [m]
    in_sight_m: f64,
    last_line: Option<&'static str>,
}

fn towards(v_mps: DVec3) -> Setpoint {
    Setpoint::Velocity { v_mps, axes: Axes::Heading, yaw: YawTarget::Keep }
}

fn hit(with: Obstacle) -> EndReason {
    let (p_world_m, clearance_m, speed_mps) = (DVec3::ZERO, -0.01, 2.0);
    EndReason::Collision(Collision { p_world_m, clearance_m, with, speed_mps })
}

/// A frontal collision with the wall at 2 m/s, with a responsive plugin and the wall visible from 10 m on.
fn head_on() -> Case {
    Case {
        end_m: DVec3::new(3.8, 0.0, 1.0),
        v_mps: DVec3::X * 2.0,
        braking_mps2: 0.0,
        yaw_rad: 0.0,
        turn_radps: 0.0,
        end: Some(hit(Obstacle::Scene)),
        asked_before_s: Some(vec![1.1, 0.1, 0.03]),
        setpoint: Some(Setpoint::Hold),
        in_sight_m: 10.0,
        last_line: None,
    }
}

/// Returns the reported cause of the failure.
fn cause_of(case: &Case) -> Option<String> {
    let (arena, field) = room();
    let sample = |tick: u32| {
        let before_s = END_S - f64::from(tick) / 50.0;
        Sample {
            stamp: at(END_S - before_s),
            p_world_m: case.end_m - case.v_mps * before_s,
            v_world_mps: case.v_mps + case.v_mps.normalize_or_zero() * case.braking_mps2 * before_s,
            yaw_rad: case.yaw_rad - case.turn_radps * before_s,
            clearance_m: 0.2 * before_s,
        }
    };
    let samples: Vec<Sample> = (0..=600).map(sample).collect();
    let took_off =
        Event { stamp: at(0.0), kind: EventKind::Phase(FlightPhase::TakingOff), text: bounded("") };
    let ended = case.end.clone().map(|end| Event::ending(at(END_S), EventKind::Ended(end)));
    let events: Vec<Event> = [took_off].into_iter().chain(ended).collect();
    let verdict = judge(&arena, &events, &samples);
    let answer = |&s: &f64| TimedSetpoint { stamp: at(END_S - s), setpoint: case.setpoint.clone() };
    let asked: Option<Vec<TimedSetpoint>> =
        case.asked_before_s.as_ref().map(|times| times.iter().map(answer).collect());
    // Two seconds of images at 30 Hz, oldest first.
    let image = |number: u32| {
        let before_s = f64::from(number) / 30.0;
        let left_m = case.v_mps.length() * before_s;
        let ahead_m = if left_m <= case.in_sight_m { left_m + arena.body_radius_m } else { 20.0 };
        ClearanceAhead { stamp: at(END_S - before_s), ahead_m: Some(ahead_m) }
    };
    let seen: Vec<ClearanceAhead> = (0..=60).rev().map(image).collect();
    let flight = Flight {
        verdict: &verdict,
        samples: &samples,
        asked: asked.as_deref(),
        seen: &seen,
        last_line: case.last_line,
        delay_s: 0.04,
    };
    probable_cause(&arena, &field, &flight)
}

#[track_caller]
fn check(case: &Case, expected: &str) {
    let cause = cause_of(case).unwrap_or_default();
    assert!(cause.contains(expected), "not {expected:?}: {cause:?}");
}

#[test]
fn first_matching_rule_names_the_cause_of_a_collision() {
    let case = head_on();
    check(&case, "it did not brake: it flew on at 2.0 m/s");
    check(
        &Case { braking_mps2: 3.0, ..case.clone() },
        "it braked too late: at 2.0 m/s it needs 0.33 m",
    );
    let flew_on = Some(towards(DVec3::X * 1.5));
    check(
        &Case { setpoint: flew_on, ..case.clone() },
        "flew on: 1.5 m/s was asked for 0.03 s before",
    );
    check(
        &Case { in_sight_m: 0.2, ..case.clone() },
        "too fast for its depth horizon: at 2.0 m/s it needs 0.3 m to stop, and it first saw",
    );
    // Fast enough along the wall to graze it only.
    let graze = DVec3::new(0.3, 2.0, 0.0);
    check(&Case { v_mps: graze, ..case.clone() }, "passed too close: a graze at 2.0 m/s");
    check(
        &Case { turn_radps: 1.0, ..case.clone() },
        "hit while turning: 57 degrees a second to the left",
    );
    check(
        &Case { turn_radps: -1.0, ..case.clone() },
        "to the right, at 2.0 m/s; an image is 40 ms old",
    );
    // The camera sees 45 degrees to each side.
    let aside = Case { yaw_rad: -1.0, ..case.clone() };
    check(&aside, "could not see: it was 57 degrees to the left");
    check(&Case { turn_radps: 1.0, ..aside }, "outside the camera's view while it turned");
    let asleep = Case { asked_before_s: Some(vec![3.0, 0.9]), ..case.clone() };
    check(&asleep, "the newest setpoint was 0.9 s old at the contact");
    check(&Case { asked_before_s: Some(vec![]), ..case.clone() }, "no setpoint came before");
    let door = Some(hit(Obstacle::Object(bounded("door"))));
    check(&Case { end: door, ..case.clone() }, "it collided with 'door' at 2.0 m/s");
    let bee = Some(hit(Obstacle::Vehicle(bounded("bee"))));
    check(&Case { end: bee, ..case.clone() }, "it collided with 'bee' at 2.0 m/s");
    let fell = Case { end: Some(hit(Obstacle::Floor)), v_mps: DVec3::Z * -2.5, ..case };
    check(&fell, "came down onto the floor at 2.5 m/s");
}

#[test]
fn unrecorded_replies_are_not_blamed() {
    // A lab does not record the plugin's replies.
    let live = Case { asked_before_s: None, ..head_on() };
    check(&live, "it did not brake");
    check(&Case { in_sight_m: 0.2, ..live.clone() }, "too fast for its depth horizon");
    let never_in_sight = Case { in_sight_m: -1.0, ..live };
    check(&never_in_sight, "it did not brake");
}

#[test]
fn too_fast_if_the_stopping_distance_exceeds_the_first_sighting() {
    for speed_mps in [0.5, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0] {
        let stop_m = speed_mps * 0.04 + speed_mps * speed_mps / (2.0 * 8.0);
        let head_on = Case { v_mps: DVec3::X * speed_mps, ..head_on() };
        let late = Case { in_sight_m: 0.7 * stop_m, ..head_on.clone() };
        check(&late, "too fast for its depth horizon");
        // There was room to stop; an obstacle that was always visible was visible early enough.
        for in_sight_m in [1.3 * stop_m + speed_mps / 30.0, 100.0] {
            check(&Case { in_sight_m, ..head_on.clone() }, "it did not brake");
        }
    }
}

#[test]
fn each_other_end_has_its_cause() {
    let case = Case { end: None, ..head_on() };
    let fence = FenceBreach {
        p_world_m: DVec3::ZERO,
        margin_m: -0.1,
        boundary: Boundary::Geofence,
        speed_mps: 3.0,
        overshoot_m: 0.5,
    };
    let outside = Case {
        end_m: DVec3::new(1.0, 2.8, 1.0),
        v_mps: DVec3::Y * 3.0,
        end: Some(EndReason::Geofence(fence)),
        ..case.clone()
    };
    check(&outside, "at the north face of the geofence with 3.0 m/s, 0.20 m from it");
    let above = Case { end_m: DVec3::new(1.0, 0.0, 3.9), v_mps: DVec3::Z, ..outside };
    check(&above, "at the upper face of the geofence with 1.0 m/s, 0.10 m from it");

    let time = Some(EndReason::TimeLimit { limit_s: 12.0 });
    let stuck = Case { v_mps: DVec3::ZERO, end: time.clone(), ..case.clone() };
    check(&stuck, "stuck before window: it moved 0.0 m in its last 10 s");
    let astray = Case { v_mps: DVec3::Y * 0.5, end: time, ..case.clone() };
    check(&astray, "astray before window: 6 m in 12 s, 0.5 m/s");

    let end = |reason| Case { end: Some(reason), ..case.clone() };
    check(&end(EndReason::StopButton), "stopped by hand: the stop button was pressed");
    check(&end(EndReason::Interrupted), "stopped by hand: stopped by a person");
    check(&end(EndReason::PluginLanded), "it gave up: the plugin asked to land");
    check(&end(EndReason::PoseLost { age_s: 0.5 }), "not the plugin: pose lost for 0.5 s");
    check(&case, "not the plugin: the record ends before the flight");
    assert_eq!(cause_of(&end(EndReason::Finished { seconds: 12.0 })), None);

    // It never rose from the floor.
    let ground = Case { end_m: DVec3::ZERO, v_mps: DVec3::ZERO, ..case };
    check(&ground, "not the plugin: the vehicle never took off");
    check(&Case { asked_before_s: Some(vec![]), ..ground }, "no image was ever answered");
}

#[test]
fn quotes_a_failed_plugin() {
    let failed = |fault| Case { end: Some(EndReason::Plugin(fault)), ..head_on() };
    let ended = failed(PluginFault::ended("ended with exit status 3"));
    let with_message = Case { last_line: Some("no such model"), ..ended.clone() };
    check(&with_message, "ended with exit status 3; the last it printed: no such model");
    check(&ended, "ended with exit status 3");
    let hung = failed(PluginFault::NoAnswer { image: 7, silent_s: 2.0 });
    // In lock-step, the clock stands still while the plugin hangs, so the reply before it is recent.
    check(&hung, "no answer: the plugin has not answered image 7 for 2.0 s; does `on_image` wait");
    check(&failed(PluginFault::NoSetpoint), "it answers images, but for 0.0 s without a setpoint");
    let never = Case { setpoint: None, ..failed(PluginFault::NoSetpoint) };
    check(&never, "but never with a setpoint");
    let live = Case { asked_before_s: None, ..never };
    check(&live, "the plugin answers images without a setpoint");
    check(&failed(PluginFault::Refused(InvalidSetpoint::NotFinite)), "its setpoints are invalid");
    // The message is not repeated.
    let once = Case { last_line: Some("exit status 3"), ..ended };
    assert_eq!(cause_of(&once).as_deref(), Some("ended with exit status 3"));
    // A text that only resembles another fault is not classified as that fault.
    let quoted = failed(PluginFault::ended("it has not answered image 7 without a setpoint"));
    check(&quoted, "it has not answered image 7 without a setpoint");
}

#[test]
fn distance_ahead_ignores_single_pixels_and_the_border() {
    let (width, height) = (30, 30);
    let mut depth = vec![9000_u16; width * height];
    let mut scratch = Vec::new();
    assert_eq!(ahead_m(&depth, width, &mut scratch), Some(9.0));
    // A few pixels are noise, a tenth is an obstacle; pixels at the border do not count.
    depth[15 * width + 15] = 500;
    depth[0] = 100;
    assert_eq!(ahead_m(&depth, width, &mut scratch), Some(9.0));
    depth[14 * width + 10..][..10].fill(1500);
    depth[15 * width + 10..][..10].fill(1500);
    assert_eq!(ahead_m(&depth, width, &mut scratch), Some(1.5));
    depth.fill(0);
    assert_eq!(ahead_m(&depth, width, &mut scratch), None);
    assert_eq!(ahead_m(&[], 0, &mut scratch), None);
    assert_eq!(ahead_m(&[1], 30, &mut scratch), None);
}

#[test]
fn drawings_contain_every_part_and_only_finite_numbers() {
    let (arena, field) = room();
    let sample = |tick: u32| Sample {
        stamp: at(f64::from(tick) / 200.0),
        p_world_m: DVec3::new(f64::from(tick) / 100.0, 0.0, 1.0),
        v_world_mps: DVec3::X * 2.0,
        yaw_rad: 0.1,
        clearance_m: 1.0,
    };
    let samples: Vec<Sample> = (0..6000).map(sample).collect();
    let end = samples[5999].stamp;
    let last = since(&samples, end, 4.0);
    assert_eq!(last.len(), 801);
    let slice = field.obstacle_slice(1.0);
    let top = plot::top_view(&arena, &slice, last, &samples);
    let course = plot::clearance(last, end);
    for class in ["class=\"solid\"", "class=\"gate\"", "class=\"way\"", "class=\"end\""] {
        assert!(top.contains(class), "{class}");
    }
    assert!(course.contains("class=\"speed\"") && course.contains("4.0 s before"), "{course}");
    // Bounded for any duration; the page's policy forbids inline styles.
    assert!(top.len() < 60_000, "{}", top.len());
    for text in
        [&top, &course, &plot::clearance(&[], end), &plot::top_view(&arena, &slice, &[], &[])]
    {
        assert!(
            !text.contains("NaN") && !text.contains("inf") && !text.contains("style="),
            "{text}"
        );
    }
}
