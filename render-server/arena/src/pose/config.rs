//! `[pose]` of `arena.toml`: acceptance of measurements, timeouts, and the instant for which images are
//! rendered.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::PoseSigma;
use crate::config::ConfigError;
use crate::config::validate::{check_number, invalid};

/// `[pose]`: fusion of poses, timeouts, and the instant for which images are rendered.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PoseConfig {
    /// Age of the newest accepted pose at which the vehicle holds. [s]
    pub hold_after_s: f64,
    /// Age of the newest accepted pose at which the vehicle lands. [s]
    pub land_after_s: f64,
    /// Instant for which images are rendered.
    pub predict: Predict,
    /// Whether to use the autopilot's IMU, if its readings arrive.
    pub imu: bool,
    /// Standard deviation per axis of a measured position, if its source reports none. [m, world]
    pub position_sigma_m: f64,
    /// Standard deviation per axis of a measured attitude, if its source reports none. [deg, body]
    pub rotation_sigma_deg: f64,
    /// Standard deviation of time stamps: at 5 m/s, 0.5 ms is 2.5 mm. [s]
    pub stamp_sigma_s: f64,
    /// Outlier gate: reject a measurement that differs from the expected pose by more than this many standard
    /// deviations.
    pub gate_sigmas: f64,
    /// Delay until a flipped attitude is accepted, if it persists. Swapped markers persist, so use more than
    /// `land_after_s`. [s]
    pub flip_accept_delay_s: f64,
}

/// Instant for which an image is rendered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Predict {
    /// Arrival at the plugin: the newest pose, extrapolated by the measured time for rendering, encoding,
    /// sending and decoding.
    #[default]
    Seen,
    /// Start of rendering.
    Drawn,
    /// Measurement of the newest pose, without prediction.
    Measured,
}

impl Default for PoseConfig {
    fn default() -> Self {
        Self {
            hold_after_s: 0.15,
            land_after_s: 0.5,
            predict: Predict::Seen,
            imu: true,
            // Mocap of a well-calibrated room has 0.3 mm and 0.1 degrees, and twice that at its edge.
            position_sigma_m: 0.000_6,
            rotation_sigma_deg: 0.15,
            stamp_sigma_s: 0.000_5,
            // With Gaussian noise, one good measurement in 3,000 exceeds this, in position or attitude.
            gate_sigmas: 4.5,
            flip_accept_delay_s: 1.0,
        }
    }
}

impl PoseConfig {
    /// Returns the standard deviations of a measurement, if its source reports none.
    pub fn sigma(&self) -> PoseSigma {
        PoseSigma {
            position_m: DVec3::splat(self.position_sigma_m),
            rotation_rad: DVec3::splat(self.rotation_sigma_deg.to_radians()),
        }
    }

    pub(crate) fn check(&self) -> Result<(), ConfigError> {
        check_number("pose.hold_after_s", self.hold_after_s, "s", 0.02..=10.0)?;
        check_number("pose.land_after_s", self.land_after_s, "s", 0.05..=30.0)?;
        if !(self.land_after_s > self.hold_after_s) {
            let advice = format!("must exceed pose.hold_after_s = {}", self.hold_after_s);
            return Err(invalid("pose.land_after_s", self.land_after_s, advice));
        }
        check_number("pose.position_sigma_m", self.position_sigma_m, "m", 1e-5..=1.0)?;
        check_number("pose.rotation_sigma_deg", self.rotation_sigma_deg, "degrees", 1e-3..=45.0)?;
        check_number("pose.stamp_sigma_s", self.stamp_sigma_s, "s", 0.0..=0.1)?;
        check_number("pose.gate_sigmas", self.gate_sigmas, "", 3.0..=100.0)?;
        check_number("pose.flip_accept_delay_s", self.flip_accept_delay_s, "s", 0.0..=60.0)
    }

    /// Whether every value is the default.
    pub(crate) fn is_default(&self) -> bool {
        *self == Self::default()
    }
}
