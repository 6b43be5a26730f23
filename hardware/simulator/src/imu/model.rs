//! Errors of inertial sensors: noise densities and random walks, by chip, or as dominated by a small frame's vibration.

use std::fmt;
use std::str::FromStr;

/// Standard gravity [m/s^2].
const G: f64 = 9.806_65;
/// Sample rate of the simulated board [Hz].
const RATE_HZ: f64 = 400.0;

/// Errors of an accelerometer and a gyro.
///
/// White noise is given by its density. For a sample rate and a bandwidth of half of it, as autopilots filter, the
/// deviation of a sample is `density sqrt(rate / 2)`. Its Allan deviation is `density / sqrt(2 tau)` (IEEE Std
/// 952-1997, annex C.1: a one-sided density N gives angle random walk N / sqrt(2)). The bias drifts by a random walk:
/// `walk sqrt(tau / 3)` (annex C.4).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuModel {
    /// Name for `--imu`.
    pub name: &'static str,
    /// One-sided density of the gyro's white noise [rad/s / sqrt(Hz)].
    pub gyro_density: f64,
    /// One-sided density of the accelerometer's white noise [m/s^2 / sqrt(Hz)].
    pub accel_density: f64,
    /// Gyro bias after the calibration at boot [rad/s].
    pub gyro_bias_radps: f64,
    /// Accelerometer bias after calibration [m/s^2].
    pub accel_bias_mps2: f64,
    /// Random walk of the gyro bias [rad/s / sqrt(s)].
    pub gyro_walk: f64,
    /// Random walk of the accelerometer bias [m/s^2 / sqrt(s)].
    pub accel_walk: f64,
    /// Range of the accelerometer [m/s^2].
    pub accel_range_mps2: f64,
    /// Range of the gyro [rad/s].
    pub gyro_range_radps: f64,
    /// White noise per sample at 400 Hz, if given directly: gyro [rad/s] and accelerometer [m/s^2].
    pub(crate) stated_sigma: Option<[f64; 2]>,
}

/// All named models; the first is the default.
///
/// Data sheets give densities and the bias before calibration, but not the drift of a bias during a flight. The bias
/// here is what an autopilot's calibration leaves. The walk is that of `frame`, unless measured.
pub const MODELS: [ImuModel; 4] = [
    // ICM-42688 class sensor on a small frame; vibration, not the chip, determines the noise.
    ImuModel {
        name: "frame",
        gyro_density: 0.01 / 14.142_135_623_730_951,
        accel_density: 0.2 / 14.142_135_623_730_951,
        gyro_bias_radps: 0.003,
        accel_bias_mps2: 0.03,
        gyro_walk: 1e-4,
        accel_walk: 1e-3,
        accel_range_mps2: 157.0,
        gyro_range_radps: 34.9,
        stated_sigma: Some([0.01, 0.2]),
    },
    // TDK InvenSense ICM-42688-P (DS-000347 rev 1.7, first page): 2.8 mdps/sqrt(Hz), 70 ug/sqrt(Hz); 2000 dps, 16 g.
    ImuModel::chip("icm-42688-p", 2.8e-3, 70e-6, 16.0),
    // Bosch BMI088 (BST-BMI088-DS001 rev 1.3: 2000 dps, 24 g): 0.014 dps/sqrt(Hz) and 175 ug/sqrt(Hz), as quoted from
    // the manufacturer by public code, because the noise tables of the data sheet could not be read.
    ImuModel::chip("bmi088", 0.014, 175e-6, 24.0),
    // InvenSense MPU-6000 (PS-MPU-6000A-00 rev 3.4, sections 6.1 and 6.2): 0.005 dps/sqrt(Hz), 400 ug/sqrt(Hz), both at
    // 10 Hz and in the smallest range; validity in the largest range, 2000 dps and 16 g, is an estimate.
    ImuModel::chip("mpu-6000", 0.005, 400e-6, 16.0),
];

impl ImuModel {
    const fn chip(name: &'static str, gyro_dps: f64, accel_g: f64, accel_range_g: f64) -> Self {
        Self {
            name,
            gyro_density: gyro_dps * std::f64::consts::PI / 180.0,
            accel_density: accel_g * G,
            gyro_bias_radps: 0.003,
            accel_bias_mps2: 0.03,
            gyro_walk: 1e-4,
            accel_walk: 1e-3,
            accel_range_mps2: accel_range_g * G,
            gyro_range_radps: 34.9,
            stated_sigma: None,
        }
    }

    /// Returns the white noise of one sample at 400 Hz: gyro [rad/s] and accelerometer [m/s^2].
    pub fn sigma(&self) -> [f64; 2] {
        let half = (RATE_HZ / 2.0).sqrt();
        self.stated_sigma.unwrap_or([self.gyro_density * half, self.accel_density * half])
    }

    /// Returns the names of all models, for help and messages.
    pub fn names() -> String {
        MODELS.map(|model| model.name).join(", ")
    }
}

impl Default for ImuModel {
    fn default() -> Self {
        MODELS[0]
    }
}

impl fmt::Display for ImuModel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name)
    }
}

/// Name that matches no [`ImuModel`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown inertial sensor '{0}'; use one of {all}", all = ImuModel::names())]
pub struct UnknownImu(pub String);

impl FromStr for ImuModel {
    type Err = UnknownImu;

    fn from_str(text: &str) -> Result<Self, UnknownImu> {
        MODELS.into_iter().find(|model| model.name == text).ok_or_else(|| UnknownImu(text.into()))
    }
}
