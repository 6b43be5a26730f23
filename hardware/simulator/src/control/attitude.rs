//! Attitude control: from acceleration and heading targets to thrust and torque.
//!
//! The thrust axis turns first, by the shortest rotation; the heading follows with less authority (Brescianini,
//! D'Andrea, "Tilt-prioritized quadrocopter attitude control", 2018).

use glam::DVec3;
use vizflyt_protocol::geometry::{wrap_pi, yaw_of};

use super::Limits;
use crate::airframe::{GRAVITY_MPS2, INERTIA_KGM2, MASS_KG};
use crate::estimator::Estimate;
use crate::motor::{MAX_THRUST_N, TIME_CONSTANT_S};

/// Rate feedback [1/s] and its damping. With motor lag tau, the rate loop is tau s^2 + (1 + D) s + P: D = 0.8 and a
/// damping of 0.8 give P = ((1 + D) / 1.6)^2 / tau.
const RATE_GAIN: f64 = (1.0 + RATE_DAMPING) * (1.0 + RATE_DAMPING) / 2.56 / TIME_CONSTANT_S;
const RATE_DAMPING: f64 = 0.8;
/// Integral of the rate error [1/s^2]: compensates imbalance in half a second.
const RATE_INTEGRAL: f64 = 40.0;
/// Maximum angular acceleration of the integral [rad/s^2].
const RATE_INTEGRAL_LIMIT: f64 = 30.0;
/// Yaw gain [1/s]; small, because yaw torque comes only from drag of the propellers.
const YAW_RATE_GAIN: f64 = 12.0;
const YAW_RATE_INTEGRAL: f64 = 6.0;
/// Attitude feedback [1/s]: a third of the rate loop's bandwidth (32 rad/s).
const TILT_GAIN: f64 = 11.0;
const YAW_GAIN: f64 = 4.0;
/// Maximum rate targets [rad/s].
const TILT_RATE_LIMIT: f64 = 8.0;
const YAW_RATE_LIMIT: f64 = 4.0;
/// Cut-off of the differentiated gyro [rad/s].
const DAMPING_CUTOFF: f64 = 250.0;
/// Minimum vertical thrust in flight, as a share of gravity; with less, there is no authority left for steering.
const MIN_LIFT: f64 = 0.15;
/// Maximum thrust target, as a share of full thrust; the rest is for steering.
const THRUST_SHARE: f64 = 0.85;

/// Heading target.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Heading {
    /// Yaw [rad, world].
    pub yaw_rad: f64,
    /// Yaw rate [rad/s].
    pub rate_radps: f64,
}

/// Thrust and torque for the mixer.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Wrench {
    /// Thrust of all motors, along body z [N].
    pub thrust_n: f64,
    /// Torque [N m, body].
    pub torque_nm: DVec3,
    /// Whether the acceleration target exceeded the limits.
    pub saturated: bool,
}

/// Attitude and rate controller.
#[derive(Clone, Debug, Default)]
pub struct AttitudeController {
    integral: DVec3,
    last_omega: Option<DVec3>,
    omega_rate: DVec3,
}

impl AttitudeController {
    /// Resets integrals and filters.
    pub fn reset(&mut self) {
        *self = Self::default();
    }

    /// Returns the wrench for acceleration `a_world_mps2` (without gravity) and `heading`.
    pub fn update(
        &mut self,
        estimate: &Estimate,
        a_world_mps2: DVec3,
        heading: Heading,
        limits: &Limits,
        dt_s: f64,
    ) -> Wrench {
        let (force_world, saturated) = limited_force(a_world_mps2, limits);
        let up_body = estimate.world_from_body.conjugate() * force_world.normalize_or(DVec3::Z);
        // Shortest rotation from body z to the target axis.
        let axis = DVec3::Z.cross(up_body);
        let angle = axis.length().atan2(up_body.z);
        let tilt_error = axis.normalize_or(DVec3::X) * angle;
        let yaw_error = wrap_pi(heading.yaw_rad - yaw_of(estimate.world_from_body));
        let yaw_rate =
            (YAW_GAIN * yaw_error + heading.rate_radps).clamp(-YAW_RATE_LIMIT, YAW_RATE_LIMIT);
        let turn_body = estimate.world_from_body.conjugate() * DVec3::Z * yaw_rate;
        let tilt_rate = (tilt_error * TILT_GAIN).clamp_length_max(TILT_RATE_LIMIT);
        let omega_target = tilt_rate + turn_body;

        // Thrust along the present axis of the vehicle, not along the target axis.
        let along = (estimate.world_from_body * DVec3::Z).dot(force_world);
        let thrust_n = along.max(MIN_LIFT * MASS_KG * GRAVITY_MPS2);
        Wrench {
            thrust_n: thrust_n.min(4.0 * MAX_THRUST_N * THRUST_SHARE),
            torque_nm: self.torque(estimate.omega_body_radps, omega_target, dt_s),
            saturated,
        }
    }

    /// Returns the wrench for a rate target [rad/s, body] and thrust [N].
    pub fn follow_rates(
        &mut self,
        omega_body_radps: DVec3,
        target_radps: DVec3,
        thrust_n: f64,
        dt_s: f64,
    ) -> Wrench {
        Wrench {
            thrust_n: thrust_n.clamp(0.0, 4.0 * MAX_THRUST_N * THRUST_SHARE),
            torque_nm: self.torque(omega_body_radps, target_radps, dt_s),
            saturated: false,
        }
    }

    fn torque(&mut self, omega: DVec3, target: DVec3, dt_s: f64) -> DVec3 {
        let difference = self.last_omega.map_or(DVec3::ZERO, |last| (omega - last) / dt_s);
        self.last_omega = Some(omega);
        self.omega_rate += (difference - self.omega_rate) * (1.0 - (-DAMPING_CUTOFF * dt_s).exp());
        let error = target - omega;
        let integral_gain = DVec3::new(RATE_INTEGRAL, RATE_INTEGRAL, YAW_RATE_INTEGRAL);
        let most = DVec3::splat(RATE_INTEGRAL_LIMIT);
        self.integral = (self.integral + integral_gain * error * dt_s).clamp(-most, most);
        let gain = DVec3::new(RATE_GAIN, RATE_GAIN, YAW_RATE_GAIN);
        let damping = DVec3::new(RATE_DAMPING, RATE_DAMPING, 0.0);
        let acceleration = gain * error + self.integral - damping * self.omega_rate;
        INERTIA_KGM2 * acceleration + omega.cross(INERTIA_KGM2 * omega)
    }
}

/// Returns the force [N, world] within tilt and thrust limits, and whether it was limited. The vertical part has
/// priority, so that a saturated vehicle keeps its height.
fn limited_force(a_world_mps2: DVec3, limits: &Limits) -> (DVec3, bool) {
    let wanted = (a_world_mps2 + DVec3::Z * GRAVITY_MPS2) * MASS_KG;
    let most = 4.0 * MAX_THRUST_N * THRUST_SHARE;
    let lift = wanted.z.clamp(MIN_LIFT * MASS_KG * GRAVITY_MPS2, most);
    let sideways = DVec3::new(wanted.x, wanted.y, 0.0);
    let by_tilt = lift * limits.tilt_rad.tan();
    let by_thrust = (most * most - lift * lift).max(0.0).sqrt();
    let allowed = sideways.clamp_length_max(by_tilt.min(by_thrust));
    let cut = lift != wanted.z || (allowed - sideways).length_squared() > 1e-12;
    (allowed + DVec3::Z * lift, cut)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;
    use proptest::prelude::*;

    const LIMITS: Limits = Limits {
        horizontal_mps2: 8.0,
        vertical_mps2: 4.0,
        horizontal_mps3: 80.0,
        vertical_mps3: 60.0,
        tilt_rad: 0.785,
    };

    proptest! {
        #[test]
        fn force_stays_within_tilt_and_thrust_limits(a in prop::array::uniform3(-60.0..60.0f64)) {
            let (force, cut) = limited_force(DVec3::from(a), &LIMITS);
            prop_assert!(force.length() <= 4.0 * MAX_THRUST_N * THRUST_SHARE + 1e-9);
            prop_assert!(force.angle_between(DVec3::Z) <= LIMITS.tilt_rad + 1e-9);
            let wanted = (DVec3::from(a) + DVec3::Z * GRAVITY_MPS2) * MASS_KG;
            prop_assert_eq!(cut, (force - wanted).length() > 1e-6);
        }
    }

    #[test]
    fn level_hover_needs_weight_and_no_torque() {
        let estimate = Estimate {
            p_world_m: DVec3::ZERO,
            v_world_mps: DVec3::ZERO,
            world_from_body: DQuat::from_rotation_z(0.4),
            omega_body_radps: DVec3::ZERO,
            a_world_mps2: DVec3::ZERO,
        };
        let heading = Heading { yaw_rad: 0.4, rate_radps: 0.0 };
        let wrench =
            AttitudeController::default().update(&estimate, DVec3::ZERO, heading, &LIMITS, 0.0025);
        assert!((wrench.thrust_n - MASS_KG * GRAVITY_MPS2).abs() < 1e-9);
        assert!(wrench.torque_nm.length() < 1e-9 && !wrench.saturated);
    }
}
