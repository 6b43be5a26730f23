//! `[pose]` of `arena.toml`: what the filter accepts, when silence counts, and for which moment
//! images are rendered.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::PoseSigma;
use crate::config::ConfigError;
use crate::config::validate::{check_number, invalid};

/// `[pose]`: what is believed of poses, and for which moment images are rendered.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PoseConfig {
    /// Age of the newest accepted pose from which the vehicle holds. [s]
    pub hold_after_s: f64,
    /// Age from which it lands. [s]
    pub land_after_s: f64,
    /// For which moment images are rendered.
    pub predict: Predict,
    /// Whether the autopilot's IMU takes part, as far as it is sent.
    pub imu: bool,
    /// How far a measured position may be off where its source reports none, one standard deviation
    /// an axis. [m, world]
    pub position_sigma_m: f64,
    /// The same of the attitude. [deg, body]
    pub rotation_sigma_deg: f64,
    /// How far stamps may be off: at 5 m/s half a millisecond is 2.5 mm. [s]
    pub stamp_sigma_s: f64,
    /// A measurement further from the expected than this many standard deviations is an outlier.
    pub gate_sigmas: f64,
    /// An attitude that flipped is accepted when it has stayed so for this long. Swapped markers do
    /// stay, so this is longer than `land_after_s`. [s]
    pub flip_believed_after_s: f64,
}

/// For which moment an image is rendered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Predict {
    /// When the plugin is given it: the newest pose, moved on by what drawing, encoding, sending
    /// and decoding take by measurement.
    #[default]
    Seen,
    /// When drawing begins.
    Drawn,
    /// When the newest pose was measured: nothing is predicted.
    Measured,
}

impl Default for PoseConfig {
    fn default() -> Self {
        Self {
            hold_after_s: 0.15,
            land_after_s: 0.5,
            predict: Predict::Seen,
            imu: true,
            // Mocap of a well-calibrated room has 0.3 mm and 0.1 degrees, twice that at its edge.
            position_sigma_m: 0.000_6,
            rotation_sigma_deg: 0.15,
            stamp_sigma_s: 0.000_5,
            // One good measurement in 3,000 is further off, in place or attitude, if noise is Gaussian.
            gate_sigmas: 4.5,
            flip_believed_after_s: 1.0,
        }
    }
}

impl PoseConfig {
    /// Returns how far a measurement may be off whose source reports none.
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
        check_number("pose.flip_believed_after_s", self.flip_believed_after_s, "s", 0.0..=60.0)
    }

    /// Whether nothing is as it would not be anyway.
    pub(crate) fn is_default(&self) -> bool {
        *self == Self::default()
    }
}
