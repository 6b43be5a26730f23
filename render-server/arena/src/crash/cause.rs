//! Probable cause of a failed flight in words: fixed rules over the record, of which the first match counts. A
//! cause is a starting point for debugging, not a proof.

use glam::{DVec2, DVec3};
use vizflyt_protocol::flight_end::{Collision, EndReason, Obstacle, PluginFault};
use vizflyt_protocol::geometry::wrap_pi;
use vizflyt_protocol::messages::{OutcomeKind, Setpoint};
use vizflyt_protocol::time::ServerTime;

use super::{Flight, since};
use crate::config::CameraConfig;
use crate::verdict::Sample;
use crate::{ArenaConfig, DistanceField};

/// Returns the probable cause of a flight that did not finish; `None` if it finished.
pub fn probable_cause(
    arena: &ArenaConfig,
    field: &DistanceField,
    flight: &Flight<'_>,
) -> Option<String> {
    let reason = &flight.verdict.reason;
    match &flight.verdict.end {
        EndReason::Finished { .. } => None,
        EndReason::Collision(collision) => Some(of_collision(arena, field, flight, collision)),
        EndReason::Geofence(_) => Some(of_fence(arena, flight)),
        EndReason::TimeLimit { .. } => Some(of_timeout(flight)),
        EndReason::Plugin(fault) => Some(of_plugin(flight, fault)),
        end if end.is_by_person() => Some(format!("stopped by hand: {reason}")),
        end if end.outcome() == OutcomeKind::Landed => Some(format!("it gave up: {reason}")),
        _ if flight.asked.is_some_and(<[_]>::is_empty) => {
            Some("no image was ever answered: is `on_image` there, and does it return?".to_owned())
        }
        _ => Some(format!("not the plugin: {reason}")),
    }
}

fn of_plugin(flight: &Flight<'_>, fault: &PluginFault) -> String {
    let reason = &flight.verdict.reason;
    match (fault, flight.last_line) {
        (PluginFault::NoAnswer { .. }, _) => {
            format!("no answer: {reason}; does `on_image` wait for something, or loop?")
        }
        (PluginFault::NoSetpoint, _) if let Some(answers) = flight.asked => {
            let newest = answers.iter().rev().find(|asked| asked.setpoint.is_some());
            match newest.zip(flight.verdict.ended) {
                Some((asked, at)) => format!(
                    "it answers images, but for {:.1} s without a setpoint: what does it wait for?",
                    at.seconds_since(asked.stamp)
                ),
                None => "it answers images, but never with a setpoint: is this the course it is made for?"
                    .to_owned(),
            }
        }
        (PluginFault::Refused(_), _) => {
            format!("its setpoints are invalid: {reason}")
        }
        // The reason may contain the line already.
        (_, Some(line)) if !reason.contains(line) => {
            format!("{reason}; the last it printed: {line}")
        }
        _ => reason.clone(),
    }
}

fn of_collision(
    arena: &ArenaConfig,
    field: &DistanceField,
    flight: &Flight<'_>,
    collision: &Collision,
) -> String {
    let reason = &flight.verdict.reason;
    let Some(at) = flight.verdict.ended else { return reason.clone() };
    let before = since(flight.samples, at, BEFORE_S);
    let (Some(first), Some(last)) = (before.first(), before.last()) else {
        return reason.clone();
    };
    let speed_mps = last.v_world_mps.length();
    match &collision.with {
        Obstacle::Floor => {
            let down_mps = -last.v_world_mps.z;
            return format!("it came down onto the floor at {down_mps:.1} m/s");
        }
        Obstacle::Object(name) | Obstacle::Vehicle(name) => {
            return format!(
                "it collided with '{name}' at {speed_mps:.1} m/s: the way was clear in the image, but not on arrival"
            );
        }
        Obstacle::Unseen => {
            return format!(
                "it flew into unseen space at {speed_mps:.1} m/s: no photo of the capture has seen it, \
                 and the arena treats unseen space as solid"
            );
        }
        Obstacle::Scene => {}
    }
    let asked = flight.asked.unwrap_or_default();
    let newest = asked.iter().rev().find(|asked| asked.stamp <= at);
    let silent_s = newest.map_or(f64::INFINITY, |asked| at.seconds_since(asked.stamp));
    if flight.asked.is_some() && newest.is_none() {
        return "no answer: no setpoint came before the contact".to_owned();
    }
    if flight.asked.is_some() && silent_s > SILENT_S {
        return format!("no answer: the newest setpoint was {silent_s:.1} s old at the contact");
    }
    let seconds = last.stamp.seconds_since(first.stamp).max(1e-3);
    let turn_radps = wrap_pi(last.yaw_rad - first.yaw_rad) / seconds;
    // Away from the obstacle: the direction in which the distance grows.
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
            "it flew into an obstacle that it could not see: it was {degrees:.0} degrees to the {} of the \
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
            flight.delay_s * 1e3
        );
    }
    if let (Some(away), true) = (away, speed_mps > 0.1) {
        let towards = -away.dot(last.v_world_mps) / speed_mps;
        if towards < GRAZE {
            return format!(
                "it passed too close: a graze at {speed_mps:.1} m/s, the obstacle next to its path; keep \
                 more than {:.2} m from visible obstacles",
                arena.body_radius_m
            );
        }
    }
    let braking_mps2 = arena.limits.max_acceleration_mps2.max(0.1);
    let stop_m = |v_mps: f64| v_mps * flight.delay_s + v_mps * v_mps / (2.0 * braking_mps2);
    if let Some(sighting) = sighting(flight, arena.body_radius_m, at)
        && sighting.room_m < stop_m(sighting.speed_mps)
    {
        let Sighting { room_m, speed_mps } = sighting;
        return format!(
            "too fast for its depth horizon: at {speed_mps:.1} m/s it needs {:.1} m to stop, and it first \
             saw the obstacle {room_m:.1} m ahead",
            stop_m(speed_mps)
        );
    }
    let asked_mps = newest.and_then(|asked| speed_of(asked.setpoint.as_ref()));
    match asked_mps {
        Some(asked_mps) if asked_mps > 0.3 => format!(
            "it saw the obstacle and flew on: {asked_mps:.1} m/s was asked for {silent_s:.2} s before \
             the contact"
        ),
        _ if speed_mps > SLOWED * first.v_world_mps.length() => {
            format!("it did not brake: it flew on at {speed_mps:.1} m/s until the contact")
        }
        _ => format!(
            "it braked too late: at {speed_mps:.1} m/s it needs {:.2} m to stop",
            stop_m(speed_mps)
        ),
    }
}

/// Start of the time in which an obstacle was visible ahead.
struct Sighting {
    /// Distance from the body's surface to the contact at that time. [m]
    room_m: f64,
    speed_mps: f64,
}

/// Returns the time from which the obstacle hit at `at` was visible: in each later image, except single ones,
/// the obstacle ahead was at most as far as the contact. Returns `None` if it was never visible, or already in
/// the oldest stored image.
fn sighting(flight: &Flight<'_>, radius_m: f64, at: ServerTime) -> Option<Sighting> {
    let sample_at = |stamp: ServerTime| -> Option<&Sample> {
        let after = flight.samples.partition_point(|sample| sample.stamp <= stamp);
        flight.samples.get(after.checked_sub(1)?)
    };
    let contact_m = sample_at(at)?.p_world_m;
    let (mut first, mut unseen) = (None, 0);
    for seen in flight.seen.iter().rev().filter(|seen| seen.stamp <= at) {
        let Some(then) = sample_at(seen.stamp) else { break };
        let left_m = then.p_world_m.distance(contact_m) + radius_m;
        if seen.ahead_m.is_some_and(|ahead_m| ahead_m <= left_m * (1.0 + FARTHER) + FARTHER_M) {
            let room_m = left_m - radius_m;
            first = Some(Sighting { room_m, speed_mps: then.v_world_mps.length() });
            unseen = 0;
        } else {
            unseen += 1;
        }
        if unseen == UNSEEN {
            return first;
        }
    }
    None
}

fn of_fence(arena: &ArenaConfig, flight: &Flight<'_>) -> String {
    let at = flight.verdict.ended;
    let last = at.and_then(|at| since(flight.samples, at, BEFORE_S).last());
    let Some(last) = last else { return flight.verdict.reason.clone() };
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

fn of_timeout(flight: &Flight<'_>) -> String {
    let verdict = flight.verdict;
    let Some(at) = verdict.ended else { return verdict.reason.clone() };
    let window = since(flight.samples, at, STUCK_S);
    let first = window.first().map_or(DVec3::ZERO, |sample| sample.p_world_m);
    let moved_m = window.iter().map(|s| s.p_world_m.distance(first)).fold(0.0, f64::max);
    let next = verdict.stages.iter().find(|stage| stage.passed_s.is_none());
    let before = next.map_or("the goal", |stage| stage.name.as_str());
    if moved_m < STUCK_M {
        format!("stuck before {before}: it moved {moved_m:.1} m in its last {STUCK_S:.0} s")
    } else {
        let (path_m, seconds) = (verdict.path_m, verdict.seconds.max(1e-3));
        format!(
            "too slow, or astray before {before}: {path_m:.0} m in {seconds:.0} s, {:.1} m/s",
            path_m / seconds
        )
    }
}

/// Returns the direction in which the obstacle distance grows most; `None` if it is constant.
fn gradient(field: &DistanceField, p_m: DVec3) -> Option<DVec3> {
    let step_m = field.grid().voxel_m;
    let along = |axis: DVec3| {
        field.obstacle_distance_m(p_m + axis * step_m)
            - field.obstacle_distance_m(p_m - axis * step_m)
    };
    let rise = DVec3::new(along(DVec3::X), along(DVec3::Y), along(DVec3::Z));
    // Only the heading to the obstacle matters: straight above or below there is none.
    let level = DVec2::new(rise.x, rise.y).length();
    (level > 1e-6).then(|| rise.normalize())
}

fn half_view_rad(camera: &CameraConfig) -> f64 {
    let k = camera.intrinsics();
    (f64::from(k.width_px) / (2.0 * k.fx_px)).atan()
}

/// Returns the speed that a setpoint commands, if it commands one. [m/s]
fn speed_of(setpoint: Option<&Setpoint>) -> Option<f64> {
    match setpoint? {
        Setpoint::Velocity { v_mps, .. } => Some(v_mps.length()),
        _ => None,
    }
}

/// Maximum age of the newest reply at a contact; an older one counts as no reply. [s]
const SILENT_S: f64 = 0.5;
/// Yaw rate that moves the camera's view by a sixth within the age of an image and its reply. [rad/s]
const TURNING_RADPS: f64 = 0.7;
/// Time before a contact over which speed and turn are evaluated. [s]
const BEFORE_S: f64 = 0.5;
/// Maximum motion of a stuck vehicle within [`STUCK_S`]. [m]
const STUCK_M: f64 = 1.0;
/// See [`STUCK_M`]. [s]
const STUCK_S: f64 = 10.0;
/// Minimum share of the speed [`BEFORE_S`] ago at which the vehicle counts as not braking.
const SLOWED: f64 = 0.8;
/// Maximum share of the speed towards the obstacle in a graze.
const GRAZE: f64 = 0.35;
/// Number of consecutive images without the obstacle before which it counts as not visible. Single misses are
/// ignored.
const UNSEEN: usize = 2;
/// Tolerance of the distance ahead compared with that to the contact, as a share, because the path was not
/// quite straight.
const FARTHER: f64 = 0.1;
/// Constant part of this tolerance. [m]
const FARTHER_M: f64 = 0.3;
