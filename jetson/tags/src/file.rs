//! Errors of layout and camera files, and poses in these files.

use std::fmt::Display;
use std::ops::RangeInclusive;
use std::path::Path;

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};
use vizflyt_protocol::geometry::{Frame, Pose};

/// Why a layout or camera file is rejected.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The file cannot be read or written.
    #[error("{path}: {error}")]
    Io {
        path: String,
        /// The system's error.
        error: std::io::Error,
    },
    /// Syntax errors, wrong types, missing and unknown keys: all of them, with line and column.
    #[error(transparent)]
    Toml(#[from] vizflyt_toml::TomlErrors),
    /// The value cannot be written as TOML.
    #[error(transparent)]
    Unwritable(#[from] toml::ser::Error),
    /// A value is out of range.
    #[error("{key} = {value}: {advice}")]
    Invalid {
        /// Key in the file: `tags[1].size_m`.
        key: String,
        value: String,
        /// Problem and correction.
        advice: String,
    },
    /// An error in a named file.
    #[error("{path}: {error}")]
    In { path: String, error: Box<FileError> },
}

/// A pose in a file.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PoseConfig {
    /// Origin [m].
    pub position_m: DVec3,
    /// Unit quaternion, Hamilton, xyzw.
    pub rotation_xyzw: DQuat,
}

impl PoseConfig {
    pub fn new<A: Frame, B: Frame>(a_from_b: Pose<A, B>) -> Self {
        Self { position_m: a_from_b.translation_m, rotation_xyzw: a_from_b.rotation }
    }

    /// Returns the pose. [`check`](Self::check) must have accepted it.
    pub fn pose<A: Frame, B: Frame>(&self) -> Pose<A, B> {
        Pose::new(self.position_m, self.rotation_xyzw.normalize())
    }

    /// Checks position and rotation. `key` returns the full key of a field.
    ///
    /// # Errors
    /// [`FileError::Invalid`].
    pub fn check(&self, key: impl Fn(&str) -> String) -> Result<(), FileError> {
        let p_m = self.position_m;
        if !(p_m.is_finite() && p_m.abs().max_element() <= MAX_COORDINATE_M) {
            let advice = format!("give three finite numbers within {MAX_COORDINATE_M} m");
            return Err(invalid(key("position_m"), p_m, advice));
        }
        let q = self.rotation_xyzw;
        if !((q.length() - 1.0).abs() <= QUATERNION_TOLERANCE) {
            let advice = "give a quaternion x, y, z, w of length 1; no turn is [0, 0, 0, 1]";
            return Err(invalid(key("rotation_xyzw"), q, advice));
        }
        Ok(())
    }
}

pub(crate) fn invalid(
    key: impl Into<String>,
    value: impl Display,
    advice: impl Into<String>,
) -> FileError {
    FileError::Invalid { key: key.into(), value: value.to_string(), advice: advice.into() }
}

pub(crate) fn check_number(
    key: &str,
    value: f64,
    unit: &str,
    range: RangeInclusive<f64>,
) -> Result<(), FileError> {
    if range.contains(&value) {
        return Ok(());
    }
    let (low, high) = range.into_inner();
    Err(invalid(key, value, format!("give a number from {low} to {high} {unit}")))
}

/// Reads a file; errors contain its path.
pub(crate) fn read<T>(
    path: &Path,
    parse: impl Fn(&str) -> Result<T, FileError>,
) -> Result<T, FileError> {
    let named = || path.display().to_string();
    let text =
        std::fs::read_to_string(path).map_err(|error| FileError::Io { path: named(), error })?;
    parse(&text).map_err(|error| FileError::In { path: named(), error: Box::new(error) })
}

pub(crate) fn write(path: &Path, text: &str) -> Result<(), FileError> {
    std::fs::write(path, text)
        .map_err(|error| FileError::Io { path: path.display().to_string(), error })
}

/// Positions beyond this are typing errors. [m]
const MAX_COORDINATE_M: f64 = 1000.0;
/// Files written by hand round quaternions to three digits.
const QUATERNION_TOLERANCE: f64 = 2e-3;
