//! Parameters that tuning changes. AUTOTUNE, a flight or a person may have set them, and such values are better than
//! those of a file: a value that differs from ArduCopter's default is kept.

use crate::link::same;

/// Newest name, and ArduCopter's default in the newest unit. The defaults are the same in 4.5 to 4.8 (sources of
/// ArduCopter, and the defaults that ArduPilot's Methodic Configurator 5.0.1 stores for each version).
pub(super) const UNTUNED: &[(&str, f64)] = &[
    ("VISO_DELAY_MS", 10.0),
    ("INS_GYRO_FILTER", 20.0),
    ("INS_ACCEL_FILTER", 20.0),
    ("ATC_RAT_RLL_FLTD", 20.0),
    ("ATC_RAT_RLL_FLTT", 20.0),
    ("ATC_RAT_RLL_FLTE", 0.0),
    ("ATC_RAT_PIT_FLTD", 20.0),
    ("ATC_RAT_PIT_FLTT", 20.0),
    ("ATC_RAT_PIT_FLTE", 0.0),
    ("ATC_RAT_YAW_FLTT", 20.0),
    ("ATC_RAT_YAW_FLTE", 2.5),
    ("ATC_RAT_RLL_P", 0.135),
    ("ATC_RAT_RLL_I", 0.135),
    ("ATC_RAT_RLL_D", 0.0036),
    ("ATC_RAT_PIT_P", 0.135),
    ("ATC_RAT_PIT_I", 0.135),
    ("ATC_RAT_PIT_D", 0.0036),
    ("ATC_ACC_R_MAX", 1100.0),
    ("ATC_ACC_P_MAX", 1100.0),
    ("ATC_ACC_Y_MAX", 270.0),
    ("PSC_D_ACC_P", 0.05),
    ("PSC_D_ACC_I", 0.1),
    ("MOT_THST_EXPO", 0.65),
    ("MOT_THST_HOVER", 0.35),
    ("MOT_SPIN_ARM", 0.1),
    ("MOT_SPIN_MIN", 0.15),
];

/// Returns whether a value, by newest name and in the newest unit, was tuned for this vehicle.
pub(super) fn is_tuned(name: &str, newest: f64) -> bool {
    UNTUNED.iter().any(|(untuned, default)| *untuned == name && !same(newest, *default))
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI, TAU};

    use vizflyt_simulator::airframe::INERTIA_KGM2;
    use vizflyt_simulator::motor::{ARM_M, MAX_THRUST_N};

    use super::super::{Version, parse_params, shipped};

    /// Rate gains of roll, and their filters.
    #[derive(Clone, Copy)]
    struct Loop {
        p: f64,
        i: f64,
        d: f64,
        gyro_hz: f64,
        d_hz: f64,
    }

    /// Delay from a gyro sample to the motors: one cycle at 400 Hz, plus half of the cycle for which the output is
    /// held. [s]
    const DELAY_S: f64 = 0.00375;

    impl Loop {
        /// Returns the factor by which the gain may grow before roll oscillates, with motors of this lag: the inverse
        /// of the open loop's gain where its phase passes -180 degrees (Astrom and Murray, Feedback Systems, section
        /// 10.3).
        fn gain_margin(&self, motor_s: f64) -> f64 {
            // Two motors up and two down, each by half of the output, on arms of ARM_M. [rad/s^2]
            let authority = 4.0 * 0.5 * MAX_THRUST_N * ARM_M / INERTIA_KGM2.x;
            let (gyro, d) = (TAU * self.gyro_hz, TAU * self.d_hz);
            let mut omega: f64 = 20.0;
            loop {
                let rolled = 1.0 + (omega / d).powi(2);
                let re = self.p + self.d * omega * (omega / d) / rolled;
                let im = self.d * omega / rolled - self.i / omega;
                // Second order, like ArduPilot's gyro filter. [1]
                let (low_re, low_im) =
                    (1.0 - (omega / gyro).powi(2), 2.0_f64.sqrt() * omega / gyro);
                let phase = im.atan2(re)
                    - FRAC_PI_2
                    - (motor_s * omega).atan()
                    - low_im.atan2(low_re)
                    - omega * DELAY_S;
                if phase <= -PI {
                    return omega * (motor_s * omega).hypot(1.0) * low_re.hypot(low_im)
                        / (authority * re.hypot(im));
                }
                omega *= 1.001;
            }
        }
    }

    /// With the file's gains roll is stable by a factor of two, also with motors a third faster than the simulator's.
    /// With ArduCopter's default gains or filters it is not.
    #[test]
    fn first_gains_are_stable_by_a_factor_of_two() {
        let params = parse_params(shipped(Version::V48)).unwrap();
        let get = |name: &str| params[name];
        let first = Loop {
            p: get("ATC_RAT_RLL_P"),
            i: get("ATC_RAT_RLL_I"),
            d: get("ATC_RAT_RLL_D"),
            gyro_hz: get("INS_GYRO_FILTER"),
            d_hz: get("ATC_RAT_RLL_FLTD"),
        };
        for motor_s in [0.025, 0.035] {
            let margin = first.gain_margin(motor_s);
            assert!(margin >= 2.0, "{margin} with motors of {motor_s} s");
        }
        let own_gains = Loop { p: 0.135, i: 0.135, d: 0.0036, ..first };
        assert!(own_gains.gain_margin(0.025) < 1.0);
        assert!(Loop { d_hz: 20.0, ..own_gains }.gain_margin(0.035) < 1.0);
        assert!(Loop { d_hz: 20.0, ..first }.gain_margin(0.025) < 2.0);
    }
}
