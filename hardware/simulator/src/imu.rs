//! Sensors of the autopilot board: true values in, measured values out, 400 Hz.
//!
//! Accelerometer and gyro have white noise and a slowly drifting bias. The barometer is only good enough for a descent.
//! An [`ImuModel`], named after a chip, sets the errors.

mod model;

use glam::DVec3;

pub use model::{ImuModel, MODELS, UnknownImu};

use crate::motor::MAX_SPEED_RADPS;
use crate::noise::Noise;

/// Maximum range of an accelerometer that an autopilot reads, from which it counts clipping [m/s^2].
pub const ACCEL_RANGE_MPS2: f64 = 157.0;
/// White noise of the barometer per sample at 400 Hz, including propeller wash [m].
const BARO_SIGMA_M: f64 = 0.4;
/// Random walk of the barometer by weather and doors [m / sqrt(s)].
const BARO_WALK: f64 = 0.02;

/// Vibration of the gyro per vibration of the accelerometer [rad/s / (m/s^2)]: 1 m/s^2 at 200 Hz with a lever of 20 mm.
const GYRO_SHARE: f64 = 0.01;

/// One sample of all sensors.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SensorSample {
    /// Specific force [m/s^2, body].
    pub accel_body_mps2: DVec3,
    /// Angular velocity [rad/s, body].
    pub gyro_body_radps: DVec3,
    /// Barometric height over an arbitrary datum [m].
    pub baro_m: f64,
    /// Battery voltage measured by the power module [V].
    pub battery_v: f64,
    /// Battery current measured by the power module [A].
    pub battery_a: f64,
}

/// Simulated sensors with their errors.
#[derive(Clone, Debug)]
pub struct Imu {
    model: ImuModel,
    noise: Noise,
    gyro_bias: DVec3,
    accel_bias: DVec3,
    baro_bias_m: f64,
    /// Amplitude of vibration at full throttle [m/s^2].
    vibration_mps2: f64,
    /// Angle of each rotor [rad].
    rotor_angle: [f64; 4],
}

impl Imu {
    /// Returns sensors whose errors follow from `seed`.
    pub fn new(model: ImuModel, seed: u64) -> Self {
        let mut noise = Noise::new(seed, 1);
        Self {
            model,
            gyro_bias: noise.gaussian3() * model.gyro_bias_radps,
            accel_bias: noise.gaussian3() * model.accel_bias_mps2,
            // A datum far from the floor's height, so that using it as height fails visibly.
            baro_bias_m: 100.0 + noise.gaussian(),
            noise,
            vibration_mps2: 0.0,
            rotor_angle: [0.0; 4],
        }
    }

    /// Sets the amplitude of the board's vibration by unbalanced rotors at full throttle [m/s^2].
    pub fn set_vibration(&mut self, vibration_mps2: f64) {
        self.vibration_mps2 = vibration_mps2;
    }

    /// Measures the true values `dt_s` after the last sample. The battery is not included.
    pub fn sample(
        &mut self,
        specific_force_body_mps2: DVec3,
        omega_body_radps: DVec3,
        height_m: f64,
        rotor_speed: [f64; 4],
        dt_s: f64,
    ) -> SensorSample {
        let walk = dt_s.max(0.0).sqrt();
        let [gyro_sigma, accel_sigma] = self.model.sigma();
        self.gyro_bias += self.noise.gaussian3() * self.model.gyro_walk * walk;
        self.accel_bias += self.noise.gaussian3() * self.model.accel_walk * walk;
        self.baro_bias_m += self.noise.gaussian() * BARO_WALK * walk;
        let limit = |v: DVec3, range: f64| v.clamp(DVec3::splat(-range), DVec3::splat(range));
        let shake = self.shake_mps2(rotor_speed, dt_s);
        let accel = specific_force_body_mps2
            + shake
            + self.accel_bias
            + self.noise.gaussian3() * accel_sigma;
        let gyro = omega_body_radps
            + self.gyro_bias
            + self.noise.gaussian3() * gyro_sigma
            + shake * GYRO_SHARE;
        SensorSample {
            accel_body_mps2: limit(accel, self.model.accel_range_mps2),
            gyro_body_radps: limit(gyro, self.model.gyro_range_radps),
            baro_m: height_m + self.baro_bias_m + self.noise.gaussian() * BARO_SIGMA_M,
            ..SensorSample::default()
        }
    }
}

impl Imu {
    /// Returns the vibration of the board. Each rotor excites once per turn, by the square of its speed, more sideways
    /// than along its axis. At 400 samples a second, faster turns alias, as in a real sensor.
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
mod tests;
