//! A lens as TOML and JSON files write it.

use serde::{Deserialize, Serialize};

use super::Distortion;

/// `distortion`: a lens, with the coefficients as OpenCV prints them; those not given are 0.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "model", rename_all = "kebab-case", deny_unknown_fields)]
pub enum LensConfig {
    /// Radial and tangential, as most lenses up to some 110 degrees are calibrated (OpenCV
    /// `calibrateCamera`).
    BrownConrady {
        /// Radial, of r^2.
        #[serde(default)]
        k1: f64,
        /// Radial, of r^4.
        #[serde(default)]
        k2: f64,
        /// Tangential, along y.
        #[serde(default)]
        p1: f64,
        /// Tangential, along x.
        #[serde(default)]
        p2: f64,
        /// Radial, of r^6.
        #[serde(default)]
        k3: f64,
    },
    /// A fisheye (OpenCV `fisheye::calibrate`); of an angle t off the axis.
    KannalaBrandt {
        /// Of t^3.
        #[serde(default)]
        k1: f64,
        /// Of t^5.
        #[serde(default)]
        k2: f64,
        /// Of t^7.
        #[serde(default)]
        k3: f64,
        /// Of t^9.
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
    /// Returns how a file writes a lens; `None` for a pinhole, which is left out.
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
