//! Chooses a velocity: simulates every candidate and takes the one with the best score.
//!
//! A plain potential field pushes at the vehicle's current position. At 4 m/s that is too late, and the vehicle
//! oscillates between two trunks. Therefore the field is evaluated at future positions: each candidate velocity is
//! simulated for 1.5 s with the lag and acceleration of a real vehicle. The score is its progress towards the goal
//! minus a penalty for its distance to obstacles (compare D. Fox et al., "The dynamic window approach to collision
//! avoidance", IEEE RAM 4(1), 1997).

use std::f64::consts::{PI, TAU};

use vizflyt_sdk::glam::DVec2;

use crate::field::{Field, TOUCH_M};

/// State of the vehicle as a point in the plane.
#[derive(Clone, Copy, Debug, Default)]
pub struct PlanarState {
    /// Position. [m, world]
    pub p_m: DVec2,
    /// Velocity. [m/s, world]
    pub v_mps: DVec2,
    /// Last returned velocity. [m/s, world]
    pub setpoint_mps: DVec2,
    /// Direction of the camera: angle from world x. [rad, world]
    pub heading_rad: f64,
    /// Additional delay until a new setpoint takes effect. [s]
    pub late_s: f64,
}

/// Returns the best velocity of at most `max_speed_mps` that makes progress towards the goal without a collision in
/// `field`. [m/s, world]
pub fn choose_velocity(field: &Field, motion: &PlanarState, max_speed_mps: f64) -> DVec2 {
    // The first candidate is zero. The ring starts at the last velocity, so that keeping it is another candidate.
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

/// Returns the maximum speed in a direction, given its angle from the camera's direction, because obstacles outside the
/// image may be new. [m/s]
fn sight_limit_mps(from_nose_rad: f64) -> f64 {
    let off_rad = ((from_nose_rad + PI).rem_euclid(TAU) - PI).abs();
    if off_rad < IN_SIGHT_RAD { f64::INFINITY } else { UNSEEN_MPS }
}

/// Returns the score of a candidate, as a speed towards the goal. [m/s]
fn score(field: &Field, motion: &PlanarState, candidate_mps: DVec2) -> f64 {
    // A new setpoint takes effect after the latency.
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
            // Collision. A later, slower and more glancing one gets a better score.
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

/// Returns `setpoint_mps` moved towards `wanted_mps` by at most what the vehicle can follow in `dt_s`. [m/s, world]
pub fn slew(setpoint_mps: DVec2, wanted_mps: DVec2, dt_s: f64) -> DVec2 {
    setpoint_mps + (wanted_mps - setpoint_mps).clamp_length_max(SLEW_MPS2 * dt_s)
}

/// Directions of candidates: every 5 degrees, the angular size of a trunk of 0.3 m at 3.4 m.
const DIRECTIONS: usize = 72;
/// Speeds per direction.
const SPEEDS: usize = 5;
/// Horizon of 15 * 0.1 s = 1.5 s: stopping from 3.6 m/s takes 3.6 / 3.5 + 0.35 + 0.08 s.
const STEPS: usize = 15;
const STEP_S: f64 = 0.1;
/// From a pose to the motors: 20 to 40 ms to this plugin, at least 20 ms over MAVLink. [s]
const LATENCY_S: f64 = 0.08;
/// First-order lag of the velocity. It is 0.25 s for a small quadrotor. Assuming a longer lag costs little, assuming a
/// shorter one causes collisions. [s]
const LAG_S: f64 = 0.35;
/// Maximum rate of change of the setpoint, so that sluggish vehicles can follow. 3.5 m/s^2 tilts vehicle and camera by
/// atan(3.5 / 9.81) = 20 degrees: the horizon stays in the image (37 degrees up and down). [m/s^2]
const SLEW_MPS2: f64 = 3.5;
/// Directions within this angle of the nose are in the image: half of 90 degrees, minus 5 degrees for the body's width.
/// [rad]
const IN_SIGHT_RAD: f64 = 0.7;
/// Maximum speed in directions outside the image; the vehicle turns there within a second. [m/s]
const UNSEEN_MPS: f64 = 1.2;
/// Penalty of a collision, far larger than any speed. [m/s]
const HIT_MPS: f64 = 100.0;
/// Desired clearance at rest, and its increase with speed: 0.52 m at 3.6 m/s. A gap of 1.4 m leaves 0.58 m on each
/// side.
const WANTED_M: f64 = 0.3;
const WANTED_PER_MPS: f64 = 0.06;
/// Penalty for low clearance, as a speed. In 100 dense forests, 6 gave a minimum clearance of 0.11 m. 10 gave 0.18 m,
/// but the slowest flight had 1.8 m/s. This is a compromise. [m/s]
const REPULSION_MPS: f64 = 8.0;
/// Penalty for changing the setpoint, per m/s of change: less than the gain of a turn by one candidate, more than the
/// noise between two images.
const INERTIA: f64 = 0.05;

#[cfg(test)]
mod tests;
