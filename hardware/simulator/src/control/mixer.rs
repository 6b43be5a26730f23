//! Mixer: from thrust and torque to four motor commands. Priority: roll and pitch, then yaw, then thrust.

use glam::DVec3;

use super::attitude::Wrench;
use crate::motor::{ARM_M, MAX_THRUST_N, MOUNTS, TORQUE_PER_THRUST_M};

/// Rotor speed of an armed vehicle on the ground (MOT_SPIN_ARM), and minimum in flight.
pub const IDLE_SPEED: f64 = 0.08;

/// Returns rotor speeds as fractions of full speed, in ArduCopter's motor order.
pub fn mix(wrench: &Wrench) -> [f64; 4] {
    let least_n = MAX_THRUST_N * IDLE_SPEED * IDLE_SPEED;
    let span_n = MAX_THRUST_N - least_n;
    // Far beyond the motors' limits, but small enough for finite sums.
    let finite = |v: f64| if v.is_finite() { v.clamp(-1e3, 1e3) } else { 0.0 };
    let torque = DVec3::from(wrench.torque_nm.to_array().map(finite));

    let tilt: [f64; 4] = std::array::from_fn(|i| {
        // p x (F z) = (y F, -x F), inverted for four motors at equal arms.
        let side = MOUNTS[i].p_body_m / ARM_M;
        (side.y * torque.x - side.x * torque.y) / (4.0 * ARM_M)
    });
    let tilt = scaled_to(tilt, span_n);
    let yaw: [f64; 4] =
        std::array::from_fn(|i| -MOUNTS[i].spin * torque.z / (4.0 * TORQUE_PER_THRUST_M));
    // Yaw gets the range that roll and pitch leave, and at least a tenth.
    let room_n = (span_n - spread(&tilt)).max(0.1 * span_n);
    let yaw = scaled_to(yaw, room_n);

    let turning: [f64; 4] = std::array::from_fn(|i| tilt[i] + yaw[i]);
    let turning = scaled_to(turning, span_n);
    let lowest = turning.iter().copied().fold(f64::INFINITY, f64::min);
    let highest = turning.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    // Thrust is limited so that every motor can produce its torque part.
    let mean_n = finite(wrench.thrust_n / 4.0).min(MAX_THRUST_N - highest).max(least_n - lowest);
    turning.map(|part| ((mean_n + part) / MAX_THRUST_N).clamp(0.0, 1.0).sqrt())
}

fn spread(parts: &[f64; 4]) -> f64 {
    let lowest = parts.iter().copied().fold(f64::INFINITY, f64::min);
    parts.iter().copied().fold(f64::NEG_INFINITY, f64::max) - lowest
}

/// Scales the parts so that they differ by at most `span_n`.
fn scaled_to(parts: [f64; 4], span_n: f64) -> [f64; 4] {
    let spread = spread(&parts);
    if spread <= span_n { parts } else { parts.map(|p| p * span_n / spread) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motor::thrust_n;
    use proptest::prelude::*;

    /// Returns thrust and torque of four rotor speeds.
    fn wrench_of(speeds: [f64; 4]) -> (f64, DVec3) {
        let mut torque = DVec3::ZERO;
        for (mount, speed) in MOUNTS.iter().zip(speeds) {
            torque += mount.p_body_m.cross(DVec3::Z * thrust_n(speed));
            torque.z -= mount.spin * TORQUE_PER_THRUST_M * thrust_n(speed);
        }
        (speeds.map(thrust_n).iter().sum(), torque)
    }

    proptest! {
        #[test]
        fn reproduces_a_moderate_wrench_exactly(
            thrust in 3.0..15.0f64, torque in prop::array::uniform3(-0.01..0.01f64),
        ) {
            let torque_nm = DVec3::from(torque);
            let wrench = Wrench { thrust_n: thrust, torque_nm, saturated: false };
            let (flown, turned) = wrench_of(mix(&wrench));
            prop_assert!((flown - thrust).abs() < 1e-9);
            prop_assert!((turned - torque_nm).length() < 1e-9);
        }

        /// Any input gives four speeds in range.
        #[test]
        fn speeds_stay_in_range_for_any_input(
            thrust in prop::num::f64::ANY, torque in prop::array::uniform3(prop::num::f64::ANY),
        ) {
            let torque_nm = DVec3::from(torque);
            let speeds = mix(&Wrench { thrust_n: thrust, torque_nm, saturated: false });
            prop_assert!(speeds.iter().all(|s| (0.0..=1.0).contains(s)), "{speeds:?}");
        }

        #[test]
        fn roll_and_pitch_have_priority(
            roll in 0.05..0.3f64, yaw in -1.0..1.0f64, thrust in 0.0..30.0f64,
        ) {
            let torque_nm = DVec3::new(roll, 0.0, yaw);
            let speeds = mix(&Wrench { thrust_n: thrust, torque_nm, saturated: false });
            let (_, turned) = wrench_of(speeds);
            prop_assert!(turned.x > 0.8 * roll, "{} of {roll}", turned.x);
        }
    }
}
