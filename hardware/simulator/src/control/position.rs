//! Position and velocity control: from a motion demand to an acceleration, separately for horizontal and vertical.
//!
//! The square-root controller turns position demands into velocities, which are then shaped. The shaped velocity is
//! followed by feed-forward of its acceleration plus proportional and integral feedback. The feedback reference is the
//! shaped velocity *after the vehicle's attitude lag*, so that the feedback does not fight the lag, and steps do not
//! overshoot.

use glam::DVec3;

use super::Limits;
use super::shape::ShapedVelocity;
use crate::estimator::Estimate;

/// Position feedback, horizontal and vertical [1/s].
const POSITION_GAIN: f64 = 1.3;
/// Velocity feedback, horizontal [1/s]: a third of the attitude loop's bandwidth.
const VELOCITY_GAIN: f64 = 4.5;
/// Integral of the horizontal velocity error [1/s^2]: compensates drag and wind in about 1.5 s.
const VELOCITY_INTEGRAL: f64 = 5.0;
/// Velocity feedback, vertical [1/s]: thrust has only the lag of the motors.
const CLIMB_GAIN: f64 = 5.0;
/// Integral of the vertical velocity error [1/s^2].
const CLIMB_INTEGRAL: f64 = 3.0;
/// Maximum integral [m/s^2].
const INTEGRAL_LIMIT: f64 = 4.0;
/// Lag of acceleration behind its demand [s]: by tilt horizontally, by the motors vertically.
const TILT_LAG_S: f64 = 0.12;
const THRUST_LAG_S: f64 = 0.05;
/// Velocity target below which the present position is held [m/s].
const STAY_MPS: f64 = 0.02;
/// Speed below which the vehicle counts as stopped [m/s].
const STOPPED_MPS: f64 = 0.15;
/// Maximum speed of the return to a held position, and to a held height [m/s].
const RETURN_MPS: f64 = 1.0;
const RETURN_Z_MPS: f64 = 0.5;
/// Maximum lead of the velocity reference over the vehicle in acceleration control [m/s].
const LEASH_MPS: f64 = 1.5;

/// Horizontal demand.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Horizontal {
    /// Fly to a point (z unused) with a maximum speed, in addition to a velocity of the point itself.
    Position {
        /// Target [m, world].
        p: DVec3,
        /// Velocity of the target [m/s, world].
        v: DVec3,
        /// Maximum speed towards the target [m/s].
        speed_mps: f64,
    },
    /// Fly at a velocity [m/s, world]; zero stops and holds the position.
    Velocity(DVec3),
    /// Accelerate [m/s^2, world].
    Acceleration(DVec3),
    /// Stay level, because the position is unknown.
    Level,
}

/// Vertical demand.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Vertical {
    /// Fly to a height with maximum speeds up and down, in addition to a velocity of the target itself.
    Position {
        /// Target [m, world].
        z: f64,
        /// Velocity of the target [m/s, world].
        v: f64,
        /// Maximum climb rate [m/s].
        up_mps: f64,
        /// Maximum sink rate, positive [m/s].
        down_mps: f64,
    },
    /// Climb at a rate [m/s, up]; zero stops and holds the height.
    Velocity(f64),
    /// Accelerate [m/s^2, up].
    Acceleration(f64),
    /// Sink at a rate until the ground stops the vehicle; holds no height [m/s, positive].
    Descend(f64),
}

/// Horizontal and vertical controllers.
#[derive(Clone, Debug, Default)]
pub struct PositionController {
    horizontal: Axis,
    vertical: Axis,
    /// Position held since a velocity target of zero was reached [m, world].
    held: Option<DVec3>,
    /// Height held since then [m, world].
    held_z: Option<f64>,
    /// Reference height of a descent [m, world].
    descent_z: Option<f64>,
}

/// Shaping and feedback of horizontal or vertical axes.
#[derive(Clone, Copy, Debug, Default)]
struct Axis {
    shaped: ShapedVelocity,
    /// Shaped velocity after the vehicle's lag [m/s].
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
    /// Restarts from the vehicle's present motion.
    pub fn reset(&mut self, estimate: &Estimate) {
        let v = estimate.v_world_mps;
        *self = Self {
            horizontal: Axis::start(DVec3::new(v.x, v.y, 0.0)),
            vertical: Axis::start(DVec3::new(0.0, 0.0, v.z)),
            ..Self::default()
        };
    }

    /// Returns the present shaped velocity target [m/s, world].
    pub fn velocity_target_mps(&self) -> DVec3 {
        self.horizontal.shaped.v + self.vertical.shaped.v
    }

    /// Returns the acceleration target without gravity [m/s^2, world]. `saturated` means that the last one exceeded the
    /// limits.
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
                // The reference continues below the ground, so that thrust falls off after contact.
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
