//! Lens distortion, as written in TOML and JSON files.

use serde::{Deserialize, Serialize};

use super::Distortion;

/// `distortion` table of a camera: coefficients as printed by OpenCV. Missing ones are 0.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "model", rename_all = "kebab-case", deny_unknown_fields)]
pub enum LensConfig {
    /// Radial and tangential distortion, for most lenses up to about 110 degrees (OpenCV `calibrateCamera`).
    BrownConrady {
        /// Radial coefficient of r^2.
        #[serde(default)]
        k1: f64,
        /// Radial coefficient of r^4.
        #[serde(default)]
        k2: f64,
        /// Tangential coefficient along y.
        #[serde(default)]
        p1: f64,
        /// Tangential coefficient along x.
        #[serde(default)]
        p2: f64,
        /// Radial coefficient of r^6.
        #[serde(default)]
        k3: f64,
    },
    /// Fisheye (OpenCV `fisheye::calibrate`), with the angle t from the axis.
    KannalaBrandt {
        /// Coefficient of t^3.
        #[serde(default)]
        k1: f64,
        /// Coefficient of t^5.
        #[serde(default)]
        k2: f64,
        /// Coefficient of t^7.
        #[serde(default)]
        k3: f64,
        /// Coefficient of t^9.
        #[serde(default)]
        k4: f64,
    },
}

impl From<LensConfig> for Distortion {
    fn from(lens: LensConfig) -> Self {
        match lens {
            LensConfig::BrownConrady { k1, k2, p1, p2, k3 } => {
                Self::BrownConrady { k1, k2, p1, p2, k3 }
            }
            LensConfig::KannalaBrandt { k1, k2, k3, k4 } => Self::KannalaBrandt { k1, k2, k3, k4 },
        }
    }
}

impl LensConfig {
    /// Converts a lens to its form in files; `None` for a pinhole, which is omitted.
    pub fn new(lens: Distortion) -> Option<Self> {
        match lens {
            Distortion::None => None,
            Distortion::BrownConrady { k1, k2, p1, p2, k3 } => {
                Some(Self::BrownConrady { k1, k2, p1, p2, k3 })
            }
            Distortion::KannalaBrandt { k1, k2, k3, k4 } => {
                Some(Self::KannalaBrandt { k1, k2, k3, k4 })
            }
        }
    }
}
