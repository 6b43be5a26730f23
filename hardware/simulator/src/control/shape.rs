//! Shapes steps of the velocity target into a velocity that a vehicle can follow: acceleration and jerk are limited,
//! without overshoot. The algorithm is ArduPilot's (`libraries/AP_Math/control.cpp`, `shape_vel_accel_xy` and
//! `shape_pos_vel_accel_xy`). The last part of every change closes at the rate of jerk over acceleration, so the jerk
//! limit, not the motors, determines the response time.

use glam::DVec3;

/// Returns the rate at which to close an error: proportional for small errors, and along the square-root curve of
/// constant deceleration `limit` for large ones (ArduPilot's `sqrt_controller`).
pub fn sqrt_rate(error: f64, gain: f64, limit: f64) -> f64 {
    let linear = limit / (gain * gain);
    if error.abs() <= linear {
        gain * error
    } else {
        (2.0 * limit * (error.abs() - linear / 2.0)).sqrt().copysign(error)
    }
}

/// Applies [`sqrt_rate`] to the length of a vector.
pub fn sqrt_rate_vector(error: DVec3, gain: f64, limit: f64) -> DVec3 {
    error.normalize_or_zero() * sqrt_rate(error.length(), gain, limit)
}

/// Shaped velocity and its acceleration.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ShapedVelocity {
    /// Velocity [m/s].
    pub v: DVec3,
    /// Acceleration [m/s^2].
    pub a: DVec3,
}

impl ShapedVelocity {
    /// Moves towards `target` for `dt_s`, within an acceleration and a jerk limit.
    pub fn approach(&mut self, target: DVec3, a_limit: f64, j_limit: f64, dt_s: f64) {
        let wanted = sqrt_rate_vector(target - self.v, j_limit / a_limit, j_limit);
        self.accelerate(wanted.clamp_length_max(a_limit), j_limit, dt_s);
    }

    /// Moves for `dt_s` towards a point at distance `error` that itself moves at `v_point`. `gain` [1/s] closes small
    /// errors, and `within` bounds the velocity towards the point. The velocity target accounts for the lag of the
    /// velocity itself, so that braking ends in time.
    pub fn approach_point(
        &mut self,
        error: DVec3,
        v_point: DVec3,
        gain: f64,
        within: impl Fn(DVec3) -> DVec3,
        (a_limit, j_limit): (f64, f64),
        dt_s: f64,
    ) {
        let rate = j_limit / a_limit;
        // Braking is planned with half the limit, so that the actual deceleration stays within it.
        let braking = a_limit / 2.0;
        let towards = sqrt_rate_vector(error, gain, braking);
        let linear = braking / (gain * gain);
        let slope = if error.length() <= linear { gain } else { braking / towards.length() };
        let foreseen = towards - (self.v - v_point) * (slope / rate);
        let wanted = (v_point + within(foreseen) - self.v) * rate;
        self.accelerate(wanted.clamp_length_max(a_limit), j_limit, dt_s);
    }

    fn accelerate(&mut self, wanted: DVec3, j_limit: f64, dt_s: f64) {
        self.a += (wanted - self.a).clamp_length_max(j_limit * dt_s);
        self.v += self.a * dt_s;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn respects_limits_and_reaches_the_target_without_overshoot(
            target in prop::array::uniform3(-6.0..6.0f64),
            start in prop::array::uniform3(-6.0..6.0f64),
            a_limit in 1.0..10.0f64, j_limit in 3.0..100.0f64,
        ) {
            let (target, start, dt_s) = (DVec3::from(target), DVec3::from(start), 0.0025);
            let mut shaped = ShapedVelocity { v: start, a: DVec3::ZERO };
            let step = (target - start).length();
            for _ in 0..12_000 {
                let before = shaped;
                shaped.approach(target, a_limit, j_limit, dt_s);
                prop_assert!(shaped.a.length() <= a_limit + 1e-9);
                prop_assert!((shaped.a - before.a).length() <= j_limit * dt_s + 1e-9);
                let done = (shaped.v - start).dot((target - start).normalize_or_zero());
                prop_assert!(done <= step * 1.02 + 0.05, "overshoot {done} of {step}");
            }
            prop_assert!((shaped.v - target).length() < 0.02);
        }
    }
}
