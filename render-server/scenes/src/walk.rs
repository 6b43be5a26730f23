//! Walk with a phone through a generated scene: pose of the camera at any time.
//!
//! Data flow: [`route`] finds a closed path over the free floor, based on the true solids. The walk follows it at
//! constant speed, turns its gaze smoothly to one side and then to the other, and adds the motion of a hand ([`sway`]).
//! Each motion has an integer number of periods in the walk, so that the end matches the start.
//!
//! Called once per capture. [`Walk::world_from_cam`] is called about ten times per image and takes less than 1 us.

mod route;
mod sway;

use core::f64::consts::TAU;

use glam::{DMat3, DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Cam, Pose, World};

use crate::random::Rng;
pub(crate) use route::Ground;
use sway::Sway;

/// Closed walk of a given duration.
#[derive(Clone, Debug, PartialEq)]
pub struct Walk {
    seconds: f64,
    length_m: f64,
    /// Steps at even distances along the closed path; the yaw of the gaze is unwrapped.
    steps: Vec<Standpoint>,
    sway: Sway,
}

/// Position and gaze of the walker.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Standpoint {
    at_m: DVec2,
    yaw_rad: f64,
}

/// Why a walk is not possible.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NoWalk {
    /// There is no free floor within the fence.
    #[error("no free floor of a walker's width within the fence, so a capture is not possible")]
    NoFloor,
    /// The duration is outside of its limits.
    #[error("a walk of {0} s: give 2 to 600 s")]
    Duration(f64),
}

impl Walk {
    /// Allowed durations. [s]
    pub const SECONDS: core::ops::RangeInclusive<f64> = 2.0..=600.0;

    /// Plans a walk over free ground. The same ground, seed and duration give the same walk.
    pub(crate) fn plan(ground: &Ground<'_>, seed: u64, seconds: f64) -> Result<Self, NoWalk> {
        if !Self::SECONDS.contains(&seconds) {
            return Err(NoWalk::Duration(seconds));
        }
        let mut rng = Rng::new(seed, 61);
        let pace_mps = rng.range(0.85, 1.0);
        let way = route::closed_way(ground, pace_mps * seconds).ok_or(NoWalk::NoFloor)?;
        let way = route::evenly(&way, STEP_M);
        let steps = look_about(&way);
        let length_m = route::length_m(&way);
        Ok(Self { seconds, length_m, steps, sway: Sway::draw(&mut rng, seconds) })
    }

    /// Returns the duration. [s]
    pub fn seconds(&self) -> f64 {
        self.seconds
    }

    /// Returns the length of the path. [m]
    pub fn length_m(&self) -> f64 {
        self.length_m
    }

    /// Returns the pose of the camera at a time; the walk repeats. [s since its start]
    pub fn world_from_cam(&self, at_s: f64) -> Pose<World, Cam> {
        let turn = at_s / self.seconds - libm::floor(at_s / self.seconds);
        let (at_m, yaw_rad) = self.on_way(turn);
        let sway = self.sway.at(turn);
        let (yaw_rad, pitch_rad) = (yaw_rad + sway.yaw_rad, sway.pitch_rad);
        // Before the rotation, the camera looks along the world's x axis: right is -y, down is -z.
        let level = DQuat::from_mat3(&DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X));
        let rotation = turned(DVec3::Z, yaw_rad)
            * turned(DVec3::NEG_Y, pitch_rad)
            * turned(DVec3::X, sway.roll_rad)
            * level;
        let aside = turned(DVec3::Z, yaw_rad) * DVec3::new(0.0, sway.aside_m, 0.0);
        Pose::new(at_m.extend(sway.height_m) + aside, rotation.normalize())
    }

    /// Returns position and gaze at a share of the walk, with cubic interpolation between steps (Catmull and Rom 1974),
    /// so that the speed is continuous.
    fn on_way(&self, turn: f64) -> (DVec2, f64) {
        let count = self.steps.len();
        let along = turn * count as f64;
        let first = (along as usize).min(count - 1);
        let t = along - first as f64;
        // Full turns of the gaze along the path must continue over the seam.
        let whole = {
            let (begin, end) = (self.steps[0].yaw_rad, self.steps[count - 1].yaw_rad);
            TAU * libm::round((end - begin) / TAU)
        };
        let step = |offset: isize| {
            let index = first as isize + offset;
            let lap = index.div_euclid(count as isize);
            let Standpoint { at_m, yaw_rad } =
                self.steps[index.rem_euclid(count as isize) as usize];
            DVec3::new(at_m.x, at_m.y, yaw_rad + whole * lap as f64)
        };
        let [a, b, c, d] = [step(-1), step(0), step(1), step(2)];
        let at = b
            + (c - a) * (0.5 * t)
            + (a * 2.0 - b * 5.0 + c * 4.0 - d) * (0.5 * t * t)
            + (b * 3.0 - c * 3.0 + d - a) * (0.5 * t * t * t);
        (at.truncate(), at.z)
    }
}

/// Returns the steps with the gaze to the left of the path for half of the time, and to the right for the other half,
/// so that each place is seen from two sides.
fn look_about(way: &[DVec2]) -> Vec<Standpoint> {
    let count = way.len();
    let mut yaws = Vec::with_capacity(count);
    let mut last = None;
    for n in 0..count {
        let ahead = way[(n + 1) % count] - way[(n + count - 1) % count];
        let mut yaw = libm::atan2(ahead.y, ahead.x);
        if let Some(last) = last {
            yaw += TAU * libm::round((last - yaw) / TAU);
        }
        last = Some(yaw);
        yaws.push(yaw);
    }
    // Full turns of the heading over one lap.
    let whole = TAU * libm::round((yaws[count - 1] - yaws[0]) / TAU);
    let aside = |n: usize| {
        let phase = TAU * (n as f64 / count as f64 - 0.25);
        SIDE_RAD * libm::tanh(3.0 * libm::cos(phase)) / libm::tanh(3.0)
    };
    let looked: Vec<f64> = yaws.iter().enumerate().map(|(n, yaw)| yaw + aside(n)).collect();
    let reach = ((3.0 * GAZE_M / STEP_M) as isize).min(count as isize - 1);
    let smooth = |n: usize| {
        let (mut sum, mut weights) = (0.0, 0.0);
        for offset in -reach..=reach {
            let index = n as isize + offset;
            let lap = index.div_euclid(count as isize) as f64;
            let yaw = looked[index.rem_euclid(count as isize) as usize] + whole * lap;
            let far = offset as f64 * STEP_M / GAZE_M;
            let weight = libm::exp(-0.5 * far * far);
            sum += weight * yaw;
            weights += weight;
        }
        sum / weights
    };
    (0..count).map(|n| Standpoint { at_m: way[n], yaw_rad: smooth(n) }).collect()
}

/// Returns a rotation about a unit axis, computed identically on every machine.
fn turned(axis: DVec3, angle_rad: f64) -> DQuat {
    let (sin, cos) = (libm::sin(0.5 * angle_rad), libm::cos(0.5 * angle_rad));
    DQuat::from_xyzw(axis.x * sin, axis.y * sin, axis.z * sin, cos)
}

/// Distance between the steps of the path. [m]
const STEP_M: f64 = 0.1;
/// Standard deviation of the smoothing of the gaze along the path: a quarter turn takes about three seconds, with less
/// than 60 degrees per second. [m]
const GAZE_M: f64 = 0.9;
/// Angle between gaze and path. [rad]
const SIDE_RAD: f64 = 0.85;

#[cfg(test)]
mod tests;
