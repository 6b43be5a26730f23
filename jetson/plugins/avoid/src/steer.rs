//! The choice of a velocity: every candidate is flown ahead in the mind, and the best one wins.
//!
//! A plain potential field pushes on where the vehicle *is*; at 4 m/s that is too late, and it
//! shakes between two trunks. So the field is asked where the vehicle *will be*: each candidate
//! velocity is followed for 1.5 s with the lag and acceleration of a real vehicle, and judged by
//! the way it gains towards the goal and by how near it comes to obstacles (compare D. Fox et al.,
//! "The dynamic window approach to collision avoidance", IEEE RAM 4(1), 1997).

use std::f64::consts::{PI, TAU};

use vizflyt_sdk::glam::DVec2;

use crate::field::{Field, TOUCH_M};

/// The vehicle as steering sees it: a point in the plane.
#[derive(Clone, Copy, Debug, Default)]
pub struct PlanarState {
    /// Position. [m, world]
    pub p_m: DVec2,
    /// Velocity. [m/s, world]
    pub v_mps: DVec2,
    /// The velocity asked for last. [m/s, world]
    pub setpoint_mps: DVec2,
    /// Where the camera looks: angle from world x. [rad, world]
    pub heading_rad: f64,
    /// How much later than usual what is asked now may act. [s]
    pub late_s: f64,
}

/// Returns the velocity to ask for, at most `max_speed_mps`, so that the vehicle gets on towards
/// the goal and does not hit anything in `field`. [m/s, world]
pub fn choose_velocity(field: &Field, motion: &PlanarState, max_speed_mps: f64) -> DVec2 {
    // The first candidate is to stop; the ring starts at the last choice, so that keeping it is
    // one of the candidates.
    let mut best = DVec2::ZERO;
    let mut best_score = score(field, motion, best);
    let start_rad = motion.setpoint_mps.to_angle();
    for direction in 0..DIRECTIONS {
        let angle_rad = start_rad + TAU * direction as f64 / DIRECTIONS as f64;
        let cap_mps = max_speed_mps.min(sight_limit_mps(angle_rad - motion.heading_rad));
        for speed in 1..=SPEEDS {
            let candidate = DVec2::from_angle(angle_rad) * (cap_mps * speed as f64 / SPEEDS as f64);
            let score = score(field, motion, candidate);
            if score > best_score {
                (best, best_score) = (candidate, score);
            }
        }
    }
    best
}

/// Returns the speed allowed in a direction, by how far it is from where the camera looks: what
/// is out of sight may have appeared since it was last seen. [m/s]
fn sight_limit_mps(from_nose_rad: f64) -> f64 {
    let off_rad = ((from_nose_rad + PI).rem_euclid(TAU) - PI).abs();
    if off_rad < IN_SIGHT_RAD { f64::INFINITY } else { UNSEEN_MPS }
}

/// Returns how good it is to ask for a velocity, as a speed towards the goal. [m/s]
fn score(field: &Field, motion: &PlanarState, candidate_mps: DVec2) -> f64 {
    // What is asked now acts a little later.
    let mut p_m = motion.p_m + motion.v_mps * (LATENCY_S + motion.late_s);
    let mut v_mps = motion.v_mps;
    let mut setpoint_mps = motion.setpoint_mps;
    let start_m = field.to_go_m(p_m);
    let mut nearest_m = start_m;
    let mut worst = 0.0_f64;
    for step in 0..STEPS {
        setpoint_mps += (candidate_mps - setpoint_mps).clamp_length_max(SLEW_MPS2 * STEP_S);
        v_mps += (setpoint_mps - v_mps) * (STEP_S / (LAG_S + STEP_S));
        p_m += v_mps * STEP_S;
        let clearance_m = field.clearance_m(p_m);
        if clearance_m < TOUCH_M {
            // A hit. Among hits the later, the slower and the more glancing is the better.
            let left = (STEPS - step) as f64 / STEPS as f64;
            return -HIT_MPS * (1.0 + left) - v_mps.length() + clearance_m.max(-1.0);
        }
        let wanted_m = WANTED_M + WANTED_PER_MPS * v_mps.length();
        worst = worst.max(1.0 - clearance_m / wanted_m);
        nearest_m = nearest_m.min(field.to_go_m(p_m));
    }
    let gain_mps = (start_m - nearest_m) / (STEPS as f64 * STEP_S);
    let change_mps = (candidate_mps - motion.setpoint_mps).length();
    gain_mps - REPULSION_MPS * worst * worst - INERTIA * change_mps
}

/// Returns `setpoint_mps` moved towards `wanted_mps` by what the vehicle can follow in `dt_s`.
/// [m/s, world]
pub fn slew(setpoint_mps: DVec2, wanted_mps: DVec2, dt_s: f64) -> DVec2 {
    setpoint_mps + (wanted_mps - setpoint_mps).clamp_length_max(SLEW_MPS2 * dt_s)
}

/// Candidates: every 5 degrees, the angle under which a trunk of 0.3 m is seen at 3.4 m.
const DIRECTIONS: usize = 72;
/// And at five speeds.
const SPEEDS: usize = 5;
/// Looking ahead 15 * 0.1 s = 1.5 s: stopping from 3.6 m/s takes 3.6 / 3.5 + 0.35 + 0.08 s.
const STEPS: usize = 15;
const STEP_S: f64 = 0.1;
/// From a pose to the motors: 20 to 40 ms to here, 20 ms and more over MAVLink. [s]
const LATENCY_S: f64 = 0.08;
/// First-order lag of the velocity behind its setpoint: that of a small quadrotor is 0.25 s;
/// expecting more costs little, expecting less hits trees. [s]
const LAG_S: f64 = 0.35;
/// The setpoint changes no faster, so that sluggish vehicles follow too. 3.5 m/s^2 tilts the
/// vehicle, and the camera with it, by atan(3.5 / 9.81) = 20 degrees: the horizon stays in the
/// image (37 degrees up and down). [m/s^2]
const SLEW_MPS2: f64 = 3.5;
/// Directions this near to the nose are in sight: half of 90 degrees, less 5 for the body's own
/// width. [rad]
const IN_SIGHT_RAD: f64 = 0.7;
/// Speed into what is out of sight: the vehicle turns there within a second. [m/s]
const UNSEEN_MPS: f64 = 1.2;
/// A hit is worse than anything else: far more than any speed. [m/s]
const HIT_MPS: f64 = 100.0;
/// Clearance asked for at rest, and more with speed: 0.52 m at 3.6 m/s. A gap of 1.4 m leaves
/// 0.58 m to each side.
const WANTED_M: f64 = 0.3;
const WANTED_PER_MPS: f64 = 0.06;
/// Speed worth giving up for not touching. Over 100 dense forests, 6 left a least clearance of
/// 0.11 m and 10 left 0.18 m but a slowest flight of 1.8 m/s; between them lies this. [m/s]
const REPULSION_MPS: f64 = 8.0;
/// Speed towards the goal worth giving up for a steadier setpoint, per m/s of change: less than
/// the gain of a turn by one candidate, more than the noise between two images.
const INERTIA: f64 = 0.05;

#[cfg(test)]
mod tests;
