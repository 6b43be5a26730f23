//! Sensors of the autopilot board: what is true in, what is measured out. 400 Hz.
//!
//! Accelerometer and gyro with white noise and a slowly walking bias, and a barometer that is only
//! good enough to come down by. Figures are those of an ICM-42688 class sensor on a small frame,
//! where vibration and not the chip sets the noise.

use glam::DVec3;

use crate::motor::MAX_SPEED_RADPS;
use crate::noise::Noise;

/// White noise of the gyro per sample at 400 Hz, vibration included. [rad/s]
const GYRO_SIGMA_RADPS: f64 = 0.01;
/// White noise of the accelerometer per sample at 400 Hz, vibration included. [m/s^2]
const ACCEL_SIGMA_MPS2: f64 = 0.2;
/// Gyro bias left after the calibration at boot. [rad/s]
const GYRO_BIAS_RADPS: f64 = 0.003;
/// Accelerometer bias left after calibration: 3 mg. [m/s^2]
const ACCEL_BIAS_MPS2: f64 = 0.03;
/// Random walk of the gyro bias. [rad/s / sqrt(s)]
const GYRO_WALK: f64 = 1e-4;
/// Random walk of the accelerometer bias. [m/s^2 / sqrt(s)]
const ACCEL_WALK: f64 = 1e-3;
/// Range of the accelerometer: 16 g. [m/s^2]
pub const ACCEL_RANGE_MPS2: f64 = 157.0;
/// Range of the gyro: 2000 degrees a second. [rad/s]
const GYRO_RANGE_RADPS: f64 = 34.9;
/// White noise of the barometer per sample at 400 Hz, propeller wash included. [m]
const BARO_SIGMA_M: f64 = 0.4;
/// Random walk of the barometer with weather and doors. [m / sqrt(s)]
const BARO_WALK: f64 = 0.02;

/// Vibration of the gyro per vibration of the accelerometer: what shakes the board by 1 m/s^2 at
/// 200 Hz with a lever of 20 mm turns it so fast. [rad/s / (m/s^2)]
const GYRO_SHARE: f64 = 0.01;

/// One sample of all sensors.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SensorSample {
    /// Specific force. [m/s^2, body]
    pub accel_body_mps2: DVec3,
    /// Angular velocity. [rad/s, body]
    pub gyro_body_radps: DVec3,
    /// Barometric height over an arbitrary datum. [m]
    pub baro_m: f64,
    /// Battery voltage by the power module. [V]
    pub battery_v: f64,
    /// Battery current by the power module. [A]
    pub battery_a: f64,
}

/// The sensors with their errors.
#[derive(Clone, Debug)]
pub struct Imu {
    noise: Noise,
    gyro_bias: DVec3,
    accel_bias: DVec3,
    baro_bias_m: f64,
    /// Amplitude at full throttle. [m/s^2]
    vibration_mps2: f64,
    /// Angle of each rotor. [rad]
    rotor_angle: [f64; 4],
}

impl Imu {
    /// Makes sensors whose errors follow from `seed`.
    pub fn new(seed: u64) -> Self {
        let mut noise = Noise::new(seed, 1);
        Self {
            gyro_bias: noise.gaussian3() * GYRO_BIAS_RADPS,
            accel_bias: noise.gaussian3() * ACCEL_BIAS_MPS2,
            // A datum far from the floor's, so that nobody takes it for one.
            baro_bias_m: 100.0 + noise.gaussian(),
            noise,
            vibration_mps2: 0.0,
            rotor_angle: [0.0; 4],
        }
    }

    /// Sets the amplitude with which unbalanced rotors shake the board at full throttle. [m/s^2]
    pub fn set_vibration(&mut self, vibration_mps2: f64) {
        self.vibration_mps2 = vibration_mps2;
    }

    /// Measures the truth `dt_s` after the last sample; the battery is measured elsewhere.
    pub fn sample(
        &mut self,
        specific_force_body_mps2: DVec3,
        omega_body_radps: DVec3,
        height_m: f64,
        rotor_speed: [f64; 4],
        dt_s: f64,
    ) -> SensorSample {
        let walk = dt_s.max(0.0).sqrt();
        self.gyro_bias += self.noise.gaussian3() * GYRO_WALK * walk;
        self.accel_bias += self.noise.gaussian3() * ACCEL_WALK * walk;
        self.baro_bias_m += self.noise.gaussian() * BARO_WALK * walk;
        let limit = |v: DVec3, range: f64| v.clamp(DVec3::splat(-range), DVec3::splat(range));
        let shake = self.shake_mps2(rotor_speed, dt_s);
        let accel = specific_force_body_mps2
            + shake
            + self.accel_bias
            + self.noise.gaussian3() * ACCEL_SIGMA_MPS2;
        let gyro = omega_body_radps
            + self.gyro_bias
            + self.noise.gaussian3() * GYRO_SIGMA_RADPS
            + shake * GYRO_SHARE;
        SensorSample {
            accel_body_mps2: limit(accel, ACCEL_RANGE_MPS2),
            gyro_body_radps: limit(gyro, GYRO_RANGE_RADPS),
            baro_m: height_m + self.baro_bias_m + self.noise.gaussian() * BARO_SIGMA_M,
            ..SensorSample::default()
        }
    }
}

impl Imu {
    /// Each rotor shakes once a turn, by the square of its speed, sideways more than along its
    /// axis. At 400 samples a second faster turns fold back, as they do in a real sensor.
    fn shake_mps2(&mut self, rotor_speed: [f64; 4], dt_s: f64) -> DVec3 {
        let mut shake = DVec3::ZERO;
        if self.vibration_mps2 > 0.0 {
            for (angle, speed) in self.rotor_angle.iter_mut().zip(rotor_speed) {
                *angle = (*angle + speed * MAX_SPEED_RADPS * dt_s) % std::f64::consts::TAU;
                let (sin, cos) = angle.sin_cos();
                shake += DVec3::new(cos, sin, 0.5 * sin) * (self.vibration_mps2 * speed * speed);
            }
        }
        shake
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_and_bias_are_as_stated() {
        let mut imu = Imu::new(5);
        let samples: Vec<_> = (0..4000)
            .map(|_| imu.sample(DVec3::ZERO, DVec3::ZERO, 0.0, [0.0; 4], 0.0025))
            .collect();
        let mean = samples.iter().map(|s| s.accel_body_mps2.x).sum::<f64>() / 4000.0;
        let deviation = samples.iter().map(|s| (s.accel_body_mps2.x - mean).powi(2)).sum::<f64>();
        let sigma = (deviation / 4000.0).sqrt();
        assert!(mean.abs() < 4.0 * ACCEL_BIAS_MPS2, "bias {mean}");
        assert!((sigma / ACCEL_SIGMA_MPS2 - 1.0).abs() < 0.06, "sigma {sigma}");
    }

    #[test]
    fn a_seed_repeats_and_the_range_holds() {
        let run = |seed| {
            Imu::new(seed).sample(DVec3::splat(1e6), DVec3::splat(-1e6), 0.0, [0.0; 4], 0.0025)
        };
        assert_eq!(run(1), run(1));
        assert_ne!(run(1).baro_m, run(2).baro_m);
        assert_eq!(run(1).accel_body_mps2, DVec3::splat(ACCEL_RANGE_MPS2));
        assert_eq!(run(1).gyro_body_radps, DVec3::splat(-GYRO_RANGE_RADPS));
    }
}
