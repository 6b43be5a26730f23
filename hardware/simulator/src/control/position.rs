//! From a demand of motion to an acceleration: horizontal and vertical on their own.
//!
//! Position demands become velocities by the square root controller; velocities are shaped; the
//! shaped velocity is followed by feed-forward of its acceleration plus proportional and integral
//! feedback. The feedback compares with the shaped velocity *as a vehicle with an attitude lag can
//! follow it*, so that the lag itself is not fought, and steps do not overshoot.

use glam::DVec3;

use super::Limits;
use super::shape::ShapedVelocity;
use crate::estimator::Estimate;

/// Position feedback, horizontal and vertical. [1/s]
const POSITION_GAIN: f64 = 1.3;
/// Velocity feedback, horizontal: a third of what the attitude loop can follow. [1/s]
const VELOCITY_GAIN: f64 = 4.5;
/// Integral of the horizontal velocity error: takes drag and wind away in about 1.5 s. [1/s^2]
const VELOCITY_INTEGRAL: f64 = 5.0;
/// Velocity feedback, vertical: thrust lags only by the motors. [1/s]
const CLIMB_GAIN: f64 = 5.0;
/// Integral of the vertical velocity error. [1/s^2]
const CLIMB_INTEGRAL: f64 = 3.0;
/// Largest integral. [m/s^2]
const INTEGRAL_LIMIT: f64 = 4.0;
/// Lag of acceleration behind its demand: tilt horizontally, motors vertically. [s]
const TILT_LAG_S: f64 = 0.12;
const THRUST_LAG_S: f64 = 0.05;
/// A velocity target below this means "stay": the position of the moment is then held. [m/s]
const STAY_MPS: f64 = 0.02;
/// The vehicle counts as stopped below this speed. [m/s]
const STOPPED_MPS: f64 = 0.15;
/// Fastest way back to a place, and to a height, that is held. [m/s]
const RETURN_MPS: f64 = 1.0;
const RETURN_Z_MPS: f64 = 0.5;
/// How far the velocity demanded by an acceleration may run ahead of the vehicle. [m/s]
const LEASH_MPS: f64 = 1.5;

/// What to do along the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Horizontal {
    /// Fly to a point (z unused) at most at a speed [m/s], on top of a velocity of the point itself.
    Position {
        /// Target. [m, world]
        p: DVec3,
        /// Velocity of the target. [m/s, world]
        v: DVec3,
        /// Largest speed towards it. [m/s]
        speed_mps: f64,
    },
    /// Fly at a velocity; zero holds the place where the vehicle stops. [m/s, world]
    Velocity(DVec3),
    /// Accelerate. [m/s^2, world]
    Acceleration(DVec3),
    /// No position is known: stay level.
    Level,
}

/// What to do along the vertical.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Vertical {
    /// Fly to a height within speeds up and down [m/s], on top of a velocity of the target itself.
    Position {
        /// Target. [m, world]
        z: f64,
        /// Velocity of the target. [m/s, world]
        v: f64,
        /// Largest climb rate. [m/s]
        up_mps: f64,
        /// Largest sink rate, positive. [m/s]
        down_mps: f64,
    },
    /// Climb at a rate; zero holds the height where the vehicle stops. [m/s, up]
    Velocity(f64),
    /// Accelerate. [m/s^2, up]
    Acceleration(f64),
    /// Sink at a rate until the ground stops it: nothing is held. [m/s, positive]
    Descend(f64),
}

/// Horizontal and vertical controllers.
#[derive(Clone, Debug, Default)]
pub struct PositionController {
    horizontal: Axis,
    vertical: Axis,
    /// Place held since a velocity of zero was reached. [m, world]
    held: Option<DVec3>,
    /// Height held likewise. [m, world]
    held_z: Option<f64>,
    /// Reference height of a descent. [m, world]
    descent_z: Option<f64>,
}

/// Shaping and feedback of one group of axes.
#[derive(Clone, Copy, Debug, Default)]
struct Axis {
    shaped: ShapedVelocity,
    /// The shaped velocity behind the vehicle's lag. [m/s]
    model: DVec3,
    integral: DVec3,
}

impl Axis {
    fn start(v: DVec3) -> Self {
        Self { shaped: ShapedVelocity { v, a: DVec3::ZERO }, model: v, integral: DVec3::ZERO }
    }

    /// Returns the acceleration that follows the shaped velocity.
    fn follow(
        &mut self,
        v: DVec3,
        (gain, integral_gain, lag_s): (f64, f64, f64),
        saturated: bool,
        dt_s: f64,
    ) -> DVec3 {
        self.model += (self.shaped.v - self.model) * (dt_s / lag_s).min(1.0);
        let error = self.model - v;
        let grows = error.dot(self.integral) > 0.0;
        if !(saturated && grows) {
            self.integral =
                (self.integral + error * (integral_gain * dt_s)).clamp_length_max(INTEGRAL_LIMIT);
        }
        self.shaped.a + error * gain + self.integral
    }
}

impl PositionController {
    /// Starts again from what the vehicle does at the moment.
    pub fn reset(&mut self, estimate: &Estimate) {
        let v = estimate.v_world_mps;
        *self = Self {
            horizontal: Axis::start(DVec3::new(v.x, v.y, 0.0)),
            vertical: Axis::start(DVec3::new(0.0, 0.0, v.z)),
            ..Self::default()
        };
    }

    /// Returns the velocity wanted at the moment, shaped. [m/s, world]
    pub fn velocity_target_mps(&self) -> DVec3 {
        self.horizontal.shaped.v + self.vertical.shaped.v
    }

    /// Returns the acceleration to fly, gravity not included [m/s^2, world]. `saturated` means that
    /// the last one could not be flown in full.
    pub fn update(
        &mut self,
        estimate: &Estimate,
        horizontal: Horizontal,
        vertical: Vertical,
        limits: &Limits,
        saturated: bool,
        dt_s: f64,
    ) -> DVec3 {
        self.along_ground(estimate, horizontal, limits, saturated, dt_s)
            + self.upwards(estimate, vertical, limits, saturated, dt_s)
    }

    fn along_ground(
        &mut self,
        estimate: &Estimate,
        demand: Horizontal,
        limits: &Limits,
        saturated: bool,
        dt_s: f64,
    ) -> DVec3 {
        let flat = |v: DVec3| DVec3::new(v.x, v.y, 0.0);
        let (p, v) = (flat(estimate.p_world_m), flat(estimate.v_world_mps));
        let (a_limit, j_limit) = (limits.horizontal_mps2, limits.horizontal_mps3);
        let limits = (a_limit, j_limit);
        let axis = &mut self.horizontal;
        if !matches!(demand, Horizontal::Velocity(_)) {
            self.held = None;
        }
        match demand {
            Horizontal::Level => {
                *axis = Axis::start(v);
                return DVec3::ZERO;
            }
            Horizontal::Position { p: target, v: feed_forward, speed_mps } => {
                let within = |v: DVec3| v.clamp_length_max(speed_mps);
                let (error, v_point) = (flat(target) - p, flat(feed_forward));
                axis.shaped.approach_point(error, v_point, POSITION_GAIN, within, limits, dt_s);
            }
            Horizontal::Velocity(target) => {
                let target = flat(target);
                if target.length() > STAY_MPS {
                    self.held = None;
                } else if self.held.is_none()
                    && axis.shaped.v.length() < STAY_MPS
                    && v.length() < STOPPED_MPS
                {
                    self.held = Some(p);
                }
                if let Some(held) = self.held {
                    let within = |v: DVec3| v.clamp_length_max(RETURN_MPS);
                    let (error, rest) = (held - p, DVec3::ZERO);
                    axis.shaped.approach_point(error, rest, POSITION_GAIN, within, limits, dt_s);
                } else {
                    axis.shaped.approach(target, a_limit, j_limit, dt_s);
                }
            }
            Horizontal::Acceleration(target) => {
                axis.shaped.a += (flat(target).clamp_length_max(a_limit) - axis.shaped.a)
                    .clamp_length_max(j_limit * dt_s);
                axis.shaped.v += axis.shaped.a * dt_s;
                axis.shaped.v = v + (axis.shaped.v - v).clamp_length_max(LEASH_MPS);
            }
        }
        let gains = (VELOCITY_GAIN, VELOCITY_INTEGRAL, TILT_LAG_S);
        axis.follow(v, gains, saturated, dt_s)
    }

    fn upwards(
        &mut self,
        estimate: &Estimate,
        demand: Vertical,
        limits: &Limits,
        saturated: bool,
        dt_s: f64,
    ) -> DVec3 {
        let (z, v) = (estimate.p_world_m.z, estimate.v_world_mps.z);
        let (a_limit, j_limit) = (limits.vertical_mps2, limits.vertical_mps3);
        let limits = (a_limit, j_limit);
        let axis = &mut self.vertical;
        if !matches!(demand, Vertical::Velocity(_)) {
            self.held_z = None;
        }
        if !matches!(demand, Vertical::Descend(_)) {
            self.descent_z = None;
        }
        match demand {
            Vertical::Position { z: target, v: feed_forward, up_mps, down_mps } => {
                let within = |v: DVec3| DVec3::Z * v.z.clamp(-down_mps, up_mps);
                let (error, v_point) = (DVec3::Z * (target - z), DVec3::Z * feed_forward);
                axis.shaped.approach_point(error, v_point, POSITION_GAIN, within, limits, dt_s);
            }
            Vertical::Velocity(target) => {
                if target.abs() > STAY_MPS {
                    self.held_z = None;
                } else if self.held_z.is_none()
                    && axis.shaped.v.z.abs() < STAY_MPS
                    && v.abs() < STOPPED_MPS
                {
                    self.held_z = Some(z);
                }
                if let Some(held) = self.held_z {
                    let within = |v: DVec3| v.clamp_length_max(RETURN_Z_MPS);
                    let (error, rest) = (DVec3::Z * (held - z), DVec3::ZERO);
                    axis.shaped.approach_point(error, rest, POSITION_GAIN, within, limits, dt_s);
                } else {
                    axis.shaped.approach(DVec3::Z * target, a_limit, j_limit, dt_s);
                }
            }
            Vertical::Acceleration(target) => {
                let wanted = target.clamp(-a_limit, a_limit);
                let most = j_limit * dt_s;
                axis.shaped.a.z += (wanted - axis.shaped.a.z).clamp(-most, most);
                axis.shaped.v.z += axis.shaped.a.z * dt_s;
                axis.shaped.v.z = v + (axis.shaped.v.z - v).clamp(-LEASH_MPS, LEASH_MPS);
            }
            Vertical::Descend(rate) => {
                axis.shaped.approach(DVec3::Z * -rate, a_limit, j_limit, dt_s);
                // The reference sinks on below the ground: thrust falls away once it is met.
                let reference = self.descent_z.unwrap_or(z) + axis.shaped.v.z * dt_s;
                let reference = reference.clamp(z - 2.0, z + 2.0);
                self.descent_z = Some(reference);
                let gains = (CLIMB_GAIN, CLIMB_INTEGRAL, THRUST_LAG_S);
                let pull = DVec3::Z * (POSITION_GAIN * CLIMB_GAIN * (reference - z));
                return axis.follow(DVec3::Z * v, gains, saturated, dt_s) + pull;
            }
        }
        let gains = (CLIMB_GAIN, CLIMB_INTEGRAL, THRUST_LAG_S);
        axis.follow(DVec3::Z * v, gains, saturated, dt_s)
    }
}
