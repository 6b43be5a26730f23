//! From a wanted acceleration and heading to thrust and torque.
//!
//! The thrust axis is turned first, by the shortest way; the heading follows with less authority
//! (Brescianini, D'Andrea, "Tilt-prioritized quadrocopter attitude control", 2018).

use glam::DVec3;
use vizflyt_protocol::geometry::{wrap_pi, yaw_of};

use super::Limits;
use crate::airframe::{GRAVITY_MPS2, INERTIA_KGM2, MASS_KG};
use crate::estimator::Estimate;
use crate::motor::{MAX_THRUST_N, TIME_CONSTANT_S};

/// Rate feedback and its damping. With motor lag tau the rate loop is
/// tau s^2 + (1 + D) s + P: D = 0.8 and a damping of 0.8 give P = ((1 + D) / 1.6)^2 / tau. [1/s]
const RATE_GAIN: f64 = (1.0 + RATE_DAMPING) * (1.0 + RATE_DAMPING) / 2.56 / TIME_CONSTANT_S;
const RATE_DAMPING: f64 = 0.8;
/// Integral of the rate error: takes away imbalance in half a second. [1/s^2]
const RATE_INTEGRAL: f64 = 40.0;
/// Largest angular acceleration of the integral. [rad/s^2]
const RATE_INTEGRAL_LIMIT: f64 = 30.0;
/// Yaw is weaker: its torque comes from drag of the propellers alone. [1/s]
const YAW_RATE_GAIN: f64 = 12.0;
const YAW_RATE_INTEGRAL: f64 = 6.0;
/// Attitude feedback: a third of the rate loop's bandwidth (32 rad/s). [1/s]
const TILT_GAIN: f64 = 11.0;
const YAW_GAIN: f64 = 4.0;
/// Rates asked for at most. [rad/s]
const TILT_RATE_LIMIT: f64 = 8.0;
const YAW_RATE_LIMIT: f64 = 4.0;
/// Cut-off of the differentiated gyro. [rad/s]
const DAMPING_CUTOFF: f64 = 250.0;
/// Share of gravity that the vertical thrust never falls below in flight: below it there is
/// nothing left to steer with.
const MIN_LIFT: f64 = 0.15;
/// Share of the full thrust left for steering.
const THRUST_SHARE: f64 = 0.85;

/// Where the nose shall point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Heading {
    /// Angle. [rad, world]
    pub yaw_rad: f64,
    /// Rate of that angle. [rad/s]
    pub rate_radps: f64,
}

/// Thrust and torque for the mixer.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Wrench {
    /// All motors together, along body z. [N]
    pub thrust_n: f64,
    /// Torque. [N m, body]
    pub torque_nm: DVec3,
    /// The acceleration asked for was more than the limits allow.
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
    /// Forgets integrals and filters.
    pub fn reset(&mut self) {
        *self = Self::default();
    }

    /// Returns the wrench that flies `a_world_mps2` (gravity not included) with the nose at `heading`.
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
        // Shortest turn from body z to the wanted axis.
        let axis = DVec3::Z.cross(up_body);
        let angle = axis.length().atan2(up_body.z);
        let tilt_error = axis.normalize_or(DVec3::X) * angle;
        let yaw_error = wrap_pi(heading.yaw_rad - yaw_of(estimate.world_from_body));
        let yaw_rate =
            (YAW_GAIN * yaw_error + heading.rate_radps).clamp(-YAW_RATE_LIMIT, YAW_RATE_LIMIT);
        let turn_body = estimate.world_from_body.conjugate() * DVec3::Z * yaw_rate;
        let tilt_rate = (tilt_error * TILT_GAIN).clamp_length_max(TILT_RATE_LIMIT);
        let omega_target = tilt_rate + turn_body;

        // Thrust counts along the axis the vehicle has, not the one it is still turning to.
        let along = (estimate.world_from_body * DVec3::Z).dot(force_world);
        let thrust_n = along.max(MIN_LIFT * MASS_KG * GRAVITY_MPS2);
        Wrench {
            thrust_n: thrust_n.min(4.0 * MAX_THRUST_N * THRUST_SHARE),
            torque_nm: self.torque(estimate.omega_body_radps, omega_target, dt_s),
            saturated,
        }
    }

    /// Returns thrust and torque for a turn. [rad/s, body; N]
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

/// Returns the force [N, world] within tilt and thrust limits, and whether something was cut. The
/// vertical part comes first: a vehicle that cannot do both keeps its height.
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
        fn the_force_stays_within_tilt_and_thrust(a in prop::array::uniform3(-60.0..60.0f64)) {
            let (force, cut) = limited_force(DVec3::from(a), &LIMITS);
            prop_assert!(force.length() <= 4.0 * MAX_THRUST_N * THRUST_SHARE + 1e-9);
            prop_assert!(force.angle_between(DVec3::Z) <= LIMITS.tilt_rad + 1e-9);
            let wanted = (DVec3::from(a) + DVec3::Z * GRAVITY_MPS2) * MASS_KG;
            prop_assert_eq!(cut, (force - wanted).length() > 1e-6);
        }
    }

    #[test]
    fn level_at_rest_needs_weight_and_no_torque() {
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
