//! The probable cause of a failed flight, in words: fixed rules over what was recorded, the first that
//! holds. They say what to look at first; they prove nothing.

use glam::{DVec2, DVec3};
use vizflyt_arena::verdict::{Outcome, Sample};
use vizflyt_arena::{ArenaConfig, DistanceField};
use vizflyt_protocol::geometry::wrap_pi;
use vizflyt_protocol::messages::{EventKind, Setpoint};
use vizflyt_protocol::time::ServerTime;

use super::trial::{Delays, Flown};

/// An answer older than this at a contact was not steered by. [s]
const SILENT_S: f64 = 0.5;
/// A turn faster than this moves the camera's view by a sixth in an image's age and answer. [rad/s]
const TURNING_RADPS: f64 = 0.7;
/// Over so long before a contact speed and turn are looked at. [s]
const BEFORE_S: f64 = 0.5;
/// A vehicle that moved less than this in [`STUCK_S`] was stuck. [m]
const STUCK_M: f64 = 1.0;
/// See [`STUCK_M`]. [s]
const STUCK_S: f64 = 10.0;
/// Along the contact's direction, less than this share of the speed is a graze.
const GRAZE: f64 = 0.35;

/// Returns what a flight that did not finish probably failed of; `None` if it finished.
pub(crate) fn probable_cause(
    arena: &ArenaConfig,
    field: &DistanceField,
    delays: &Delays,
    flown: &Flown,
) -> Option<String> {
    let verdict = &flown.verdict;
    match verdict.outcome {
        Outcome::Finished => None,
        Outcome::Collided => Some(of_collision(arena, field, delays, flown)),
        Outcome::Geofence => Some(of_fence(arena, flown)),
        Outcome::Timeout => Some(of_timeout(flown)),
        Outcome::Landed => Some(format!("it gave up: {}", verdict.reason)),
        Outcome::PluginFailed => Some(of_plugin(flown)),
        Outcome::Error if flown.images == 0 => {
            Some("no image was ever answered: is `on_image` there, and does it return?".to_owned())
        }
        Outcome::Error => Some(format!("not the plugin: {}", verdict.reason)),
    }
}

fn of_plugin(flown: &Flown) -> String {
    let reason = &flown.verdict.reason;
    // Two seconds without a setpoint end a flight; were there answers meanwhile?
    let newest = flown.asked.last().zip(end_of(flown));
    if let Some((asked, at)) = newest
        && at.seconds_since(asked.stamp) < SILENT_S
        && (reason.contains("without a setpoint") || reason.contains("has not answered"))
    {
        let since = flown.asked.iter().rev().find(|asked| asked.setpoint.is_some());
        return match since {
            Some(asked) => format!(
                "it answers images, but for {:.1} s without a setpoint: what does it wait for?",
                at.seconds_since(asked.stamp)
            ),
            None => {
                "it answers images, but never with a setpoint: is this the course it is made for?"
                    .to_owned()
            }
        };
    }
    if reason.contains("has not answered image") {
        return format!("no answer: {reason}; does `on_image` wait for something, or loop?");
    }
    if reason.contains("setpoints are refused") {
        return format!("its setpoints are no numbers to fly by: {reason}");
    }
    match flown.lines.back() {
        Some(line) if !reason.contains(line.as_str()) => {
            format!("{reason}; the last it printed: {line}")
        }
        _ => reason.clone(),
    }
}

fn of_collision(
    arena: &ArenaConfig,
    field: &DistanceField,
    delays: &Delays,
    flown: &Flown,
) -> String {
    let Some(at) = end_of(flown) else { return flown.verdict.reason.clone() };
    let before = since(&flown.samples, at, BEFORE_S);
    let (Some(first), Some(last)) = (before.first(), before.last()) else {
        return flown.verdict.reason.clone();
    };
    let speed_mps = last.v_world_mps.length();
    if flown.verdict.reason.contains("the floor") {
        let down_mps = -last.v_world_mps.z;
        return format!("it came down onto the floor at {down_mps:.1} m/s");
    }
    if let Some(name) = flown.verdict.reason.split('\'').nth(1) {
        return format!(
            "it met '{name}', which moves, at {speed_mps:.1} m/s: when it was seen clear, it was not yet \
             where it would be"
        );
    }
    let newest = flown.asked.iter().rev().find(|asked| asked.stamp <= at);
    let silent_s = newest.map_or(f64::INFINITY, |asked| at.seconds_since(asked.stamp));
    if silent_s > SILENT_S {
        return format!("no answer: the newest setpoint was {silent_s:.1} s old at the contact");
    }
    let seconds = last.stamp.seconds_since(first.stamp).max(1e-3);
    let turn_radps = wrap_pi(last.yaw_rad - first.yaw_rad) / seconds;
    // Away from the obstacle: where the distance grows.
    let away = gradient(field, last.p_world_m);
    let bearing = away.map(|away| wrap_pi((-away.y).atan2(-away.x) - last.yaw_rad));
    let half_view = arena.cameras.first().map(half_view_rad);
    let side = |bearing: f64| if bearing > 0.0 { "left" } else { "right" };
    if let (Some(bearing), Some(half_view)) = (bearing, half_view)
        && bearing.abs() > half_view
    {
        let degrees = bearing.abs().to_degrees();
        let turning = if turn_radps.abs() > TURNING_RADPS { " while it turned" } else { "" };
        return format!(
            "it flew into what it could not see: the obstacle was {degrees:.0} degrees to the {} of the \
             nose, outside the camera's view{turning}",
            side(bearing)
        );
    }
    if turn_radps.abs() > TURNING_RADPS {
        let degrees = turn_radps.abs().to_degrees();
        return format!(
            "hit while turning: {degrees:.0} degrees a second to the {}, at {speed_mps:.1} m/s; an image \
             is {:.0} ms old when its answer counts",
            side(turn_radps),
            (delays.image_ns + delays.answer_ns) as f64 * 1e-6
        );
    }
    if let (Some(away), true) = (away, speed_mps > 0.1) {
        let towards = -away.dot(last.v_world_mps) / speed_mps;
        if towards < GRAZE {
            return format!(
                "it passed too close: a graze at {speed_mps:.1} m/s, the obstacle beside its way; keep \
                 more than {:.2} m from what is seen",
                arena.body_radius_m
            );
        }
    }
    let delay_s = (delays.image_ns + delays.answer_ns) as f64 * 1e-9;
    let stop_m = speed_mps * delay_s
        + speed_mps * speed_mps / (2.0 * arena.limits.max_acceleration_mps2.max(0.1));
    // What it saw ahead a second before, when there was room yet.
    let earlier = flown.asked.iter().rev().find(|asked| at.seconds_since(asked.stamp) >= 1.0);
    if let Some(seen_m) = earlier.and_then(|asked| asked.ahead_m)
        && seen_m - speed_mps < stop_m
    {
        return format!(
            "too fast for its depth horizon: at {speed_mps:.1} m/s it needs {stop_m:.1} m to stop, and a \
             second before the contact it saw {seen_m:.1} m ahead"
        );
    }
    let asked_mps = newest.and_then(|asked| speed_of(asked.setpoint.as_ref()));
    match asked_mps {
        Some(asked_mps) if asked_mps > 0.3 => format!(
            "it saw the obstacle and flew on: {asked_mps:.1} m/s was asked for {silent_s:.2} s before \
             the contact"
        ),
        _ => format!("it braked too late: at {speed_mps:.1} m/s it needs {stop_m:.1} m to stop"),
    }
}

fn of_fence(arena: &ArenaConfig, flown: &Flown) -> String {
    let last = end_of(flown).and_then(|at| since(&flown.samples, at, BEFORE_S).last());
    let Some(last) = last else { return flown.verdict.reason.clone() };
    let (p, fence) = (last.p_world_m, &arena.geofence);
    let faces = [
        ("west", p.x - fence.min_m.x),
        ("east", fence.max_m.x - p.x),
        ("south", p.y - fence.min_m.y),
        ("north", fence.max_m.y - p.y),
        ("lower", p.z - fence.min_m.z),
        ("upper", fence.max_m.z - p.z),
    ];
    let nearest = faces.into_iter().min_by(|a, b| a.1.total_cmp(&b.1));
    let (face, left_m) = nearest.unwrap_or(("west", 0.0));
    format!(
        "it flew at the {face} face of the geofence with {:.1} m/s, {left_m:.2} m from it",
        last.v_world_mps.length()
    )
}

fn of_timeout(flown: &Flown) -> String {
    let Some(at) = end_of(flown) else { return flown.verdict.reason.clone() };
    let window = since(&flown.samples, at, STUCK_S);
    let first = window.first().map_or(DVec3::ZERO, |sample| sample.p_world_m);
    let moved_m = window.iter().map(|s| s.p_world_m.distance(first)).fold(0.0, f64::max);
    let next = flown.verdict.stages.iter().find(|stage| stage.passed_s.is_none());
    let before = next.map_or("the goal", |stage| stage.name.as_str());
    if moved_m < STUCK_M {
        format!("stuck before {before}: it moved {moved_m:.1} m in its last {STUCK_S:.0} s")
    } else {
        let (path_m, seconds) = (flown.verdict.path_m, flown.verdict.seconds.max(1e-3));
        format!(
            "too slow, or astray before {before}: {path_m:.0} m in {seconds:.0} s, {:.1} m/s",
            path_m / seconds
        )
    }
}

/// Returns when the flight was decided.
pub(crate) fn end_of(flown: &Flown) -> Option<ServerTime> {
    let decided = flown.events.iter().find(|event| {
        matches!(
            event.kind,
            EventKind::Collision { .. }
                | EventKind::Geofence { .. }
                | EventKind::Finished { .. }
                | EventKind::TimeLimit
                | EventKind::PluginFailed
        )
    });
    decided.map(|event| event.stamp).or_else(|| flown.samples.last().map(|sample| sample.stamp))
}

/// Returns the samples of the last `seconds` until `at`.
pub(crate) fn since(samples: &[Sample], at: ServerTime, seconds: f64) -> &[Sample] {
    let begin = samples.partition_point(|sample| at.seconds_since(sample.stamp) > seconds);
    let end = samples.partition_point(|sample| sample.stamp <= at);
    samples.get(begin..end).unwrap_or_default()
}

/// Returns the direction in which the obstacle's distance grows most; `None` where it does not change.
fn gradient(field: &DistanceField, p_m: DVec3) -> Option<DVec3> {
    let step_m = field.grid().voxel_m;
    let along = |axis: DVec3| {
        field.obstacle_distance_m(p_m + axis * step_m)
            - field.obstacle_distance_m(p_m - axis * step_m)
    };
    let rise = DVec3::new(along(DVec3::X), along(DVec3::Y), along(DVec3::Z));
    // The heading to it is of interest: straight above or below there is none.
    let level = DVec2::new(rise.x, rise.y).length();
    (level > 1e-6).then(|| rise.normalize())
}

fn half_view_rad(camera: &vizflyt_arena::config::CameraConfig) -> f64 {
    let k = camera.intrinsics();
    (f64::from(k.width_px) / (2.0 * k.fx_px)).atan()
}

/// Returns the speed that a setpoint asks for, if it asks for one. [m/s]
fn speed_of(setpoint: Option<&Setpoint>) -> Option<f64> {
    match setpoint? {
        Setpoint::Velocity { v_mps, .. } => Some(v_mps.length()),
        _ => None,
    }
}
