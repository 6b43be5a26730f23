//! Validation of `arena.toml`. Each error names the key, the value and what to do.

use std::collections::HashSet;
use std::fmt::Display;
use std::ops::RangeInclusive;

use glam::{DVec2, DVec3};
use vizflyt_protocol::messages::{Limits, MAX_CAMERAS};
use vizflyt_toml::TomlErrors;

use super::{ArenaConfig, Spawn, StageConfig};

/// Error of an `arena.toml`.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ConfigError {
    /// Errors of syntax and type, absent or unknown keys: all of them, with line and column.
    #[error(transparent)]
    Toml(#[from] TomlErrors),
    /// The value cannot be written as TOML.
    #[error(transparent)]
    Unwritable(#[from] toml::ser::Error),
    /// An invalid value.
    #[error("{key} = {value}: {advice}{}", in_line(*line))]
    Invalid {
        /// Path of the key: `geofence.max_m`, `cameras[1].name`.
        key: String,
        value: String,
        /// Problem and solution.
        advice: String,
        /// Line of the key, from 1, if the value came from a text.
        line: Option<usize>,
    },
    /// Two or more errors.
    #[error("{}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Several(Vec<Self>),
}

fn in_line(line: Option<usize>) -> String {
    line.map_or_else(String::new, |line| format!(" (line {line})"))
}

impl ConfigError {
    /// Returns the error with the line of its key in `text`.
    #[must_use]
    pub fn in_text(self, text: &str) -> Self {
        match self {
            Self::Invalid { key, value, advice, .. } => {
                let line = super::line_of(text, &key);
                Self::Invalid { key, value, advice, line }
            }
            Self::Several(errors) => {
                Self::Several(errors.into_iter().map(|error| error.in_text(text)).collect())
            }
            other => other,
        }
    }
}

/// Returns the error for an invalid value, with key, value and advice.
pub fn invalid(
    key: impl Into<String>,
    value: impl Display,
    advice: impl Into<String>,
) -> ConfigError {
    let (key, value, advice) = (key.into(), value.to_string(), advice.into());
    ConfigError::Invalid { key, value, advice, line: None }
}

/// Positions further out are typing errors: f32 splats are accurate to 0.1 mm up to here. [m]
const MAX_COORDINATE_M: f64 = 1000.0;
/// Bytes of [`vizflyt_protocol::messages::Name`].
const MAX_NAME_BYTES: usize = 32;
/// Maximum number of corners of a stage: more than people draw.
const MAX_CORNERS: usize = 128;
/// `EventKind::Stage` stores the index in u8.
const MAX_STAGES: usize = 255;
/// One byte a voxel: 400 MB, a hall of 100 x 100 x 5 m at 5 cm.
const MAX_VOXELS: f64 = 4e8;

/// Checks that a value lies within a range; the error names `unit`.
///
/// # Errors
/// [`ConfigError::Invalid`], also for NaN.
pub fn check_number(
    key: &str,
    value: f64,
    unit: &str,
    range: RangeInclusive<f64>,
) -> Result<(), ConfigError> {
    if range.contains(&value) {
        return Ok(());
    }
    let (low, high) = range.into_inner();
    Err(invalid(key, value, format!("give a number from {low} to {high} {unit}")))
}

/// Checks that a position is finite and within the maximum coordinate.
///
/// # Errors
/// [`ConfigError::Invalid`].
pub fn check_position(key: &str, value: DVec3) -> Result<(), ConfigError> {
    if value.is_finite() && value.abs().max_element() <= MAX_COORDINATE_M {
        return Ok(());
    }
    let advice = format!("give three finite numbers within {MAX_COORDINATE_M} m of the origin");
    Err(invalid(key, value, advice))
}

pub(super) fn check_name<'a>(
    key: &str,
    value: &'a str,
    taken: &mut HashSet<&'a str>,
) -> Result<(), ConfigError> {
    let quoted = format!("{value:?}");
    if value.trim().is_empty() || value.len() > MAX_NAME_BYTES {
        return Err(invalid(key, quoted, format!("give a name of 1 to {MAX_NAME_BYTES} bytes")));
    }
    if !taken.insert(value) {
        return Err(invalid(key, quoted, "another has this name; give each its own"));
    }
    Ok(())
}

fn check_polygon(stage: &StageConfig, key: &str) -> Result<(), ConfigError> {
    let corners = &stage.polygon_m;
    if corners.is_empty() {
        return Ok(());
    }
    if !(3..=MAX_CORNERS).contains(&corners.len()) {
        let advice = format!("give 3 to {MAX_CORNERS} corners, or none for a rectangle");
        return Err(invalid(key, format!("{} of them", corners.len()), advice));
    }
    let half_m = DVec2::new(stage.width_m, stage.height_m) / 2.0 + 1e-9;
    for (n, corner) in corners.iter().enumerate() {
        // Stated positively, so that NaN is rejected.
        if !corner.abs().cmple(half_m).all() {
            let advice = format!(
                "must lie within width_m = {} and height_m = {} about the centre",
                stage.width_m, stage.height_m
            );
            return Err(invalid(format!("{key}[{n}]"), corner, advice));
        }
    }
    Ok(())
}

impl ArenaConfig {
    /// Checks every value, and the values against each other.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`], or [`ConfigError::Several`] with one error for each invalid value.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let Limits { max_speed_mps, max_acceleration_mps2, max_tilt_deg, max_altitude_m } =
            self.limits;
        let check_limit = |key, value: Option<f64>, unit, range| {
            value.map_or(Ok(()), |value| check_number(key, value, unit, range))
        };
        let checks = [
            check_name("name", &self.name, &mut HashSet::new()),
            self.check_scene(),
            check_number("body_radius_m", self.body_radius_m, "m", 0.01..=2.0),
            check_number("takeoff_height_m", self.takeoff_height_m, "m", 0.1..=100.0),
            check_number("time_limit_s", self.time_limit_s, "s (0 is none)", 0.0..=86400.0),
            check_number("limits.max_speed_mps", max_speed_mps, "m/s", 0.01..=30.0),
            check_number(
                "limits.max_acceleration_mps2",
                max_acceleration_mps2,
                "m/s^2",
                0.1..=50.0,
            ),
            check_limit("limits.max_tilt_deg", max_tilt_deg, "degrees", 1.0..=90.0),
            check_limit("limits.max_altitude_m", max_altitude_m, "m", 0.1..=100.0),
            self.pose.check(),
            self.check_fence_and_points(),
            self.check_body(),
            self.check_occupancy(),
            self.check_cameras(),
            self.check_sensors(),
            self.check_vehicles(),
            self.check_stages(),
            self.check_no_fly(),
            self.check_objects(),
            self.check_environment(),
            self.check_rules(),
        ];
        vizflyt_toml::join_errors(checks, ConfigError::Several)
    }

    fn check_fence_and_points(&self) -> Result<(), ConfigError> {
        let fence = &self.geofence;
        check_position("geofence.min_m", fence.min_m)?;
        check_position("geofence.max_m", fence.max_m)?;
        let least_m = 2.0 * self.body_radius_m;
        if (fence.max_m - fence.min_m).min_element() <= least_m {
            let advice = format!(
                "must exceed geofence.min_m = {} by more than the body's {least_m} m on each axis",
                fence.min_m
            );
            return Err(invalid("geofence.max_m", fence.max_m, advice));
        }
        self.check_spawn("spawn", self.spawn)?;
        if let Some(goal) = &self.goal {
            check_position("goal.position_m", goal.position_m)?;
            check_number("goal.radius_m", goal.radius_m, "m", 0.01..=100.0)?;
            self.check_inside("goal.position_m", goal.position_m)?;
        }
        Ok(())
    }

    pub(super) fn check_spawn(&self, key: &str, spawn: Spawn) -> Result<(), ConfigError> {
        let position = format!("{key}.position_m");
        check_position(&position, spawn.position_m)?;
        check_number(&format!("{key}.yaw_deg"), spawn.yaw_deg, "degrees", -360.0..=360.0)?;
        self.check_inside(&position, spawn.position_m)?;
        let top_m = spawn.position_m + DVec3::Z * self.takeoff_height_m;
        if !self.fits_inside(top_m) {
            let advice = format!(
                "the climb ends at {top_m}, where a body of {} m leaves the geofence; climb less \
                 or raise geofence.max_m",
                self.body_radius_m
            );
            return Err(invalid("takeoff_height_m", self.takeoff_height_m, advice));
        }
        Ok(())
    }

    fn fits_inside(&self, p_m: DVec3) -> bool {
        self.geofence().signed_distance_m(p_m) <= -self.body_radius_m
    }

    fn check_inside(&self, key: &str, p_m: DVec3) -> Result<(), ConfigError> {
        if self.fits_inside(p_m) {
            return Ok(());
        }
        let advice = format!(
            "must be inside the geofence {} to {} by the body's radius, {} m",
            self.geofence.min_m, self.geofence.max_m, self.body_radius_m
        );
        Err(invalid(key, p_m, advice))
    }

    fn check_occupancy(&self) -> Result<(), ConfigError> {
        let occupancy = &self.occupancy;
        check_number("occupancy.voxel_m", occupancy.voxel_m, "m", 0.01..=0.5)?;
        check_number("occupancy.min_opacity", occupancy.min_opacity, "", 0.0..=1.0)?;
        let least = occupancy.min_splats_per_m3;
        check_number("occupancy.min_splats_per_m3", least, "per m^3 (0 keeps all)", 0.0..=1e6)?;
        let limit = -MAX_COORDINATE_M..=MAX_COORDINATE_M;
        check_number("occupancy.floor_z_m", occupancy.floor_z_m, "m", limit)?;
        if !(occupancy.floor_z_m < self.geofence.max_m.z) {
            let advice = "the floor must lie below geofence.max_m";
            return Err(invalid("occupancy.floor_z_m", occupancy.floor_z_m, advice));
        }
        let side_m = self.geofence.max_m - self.geofence.min_m;
        let voxels = (side_m / occupancy.voxel_m).element_product();
        if !(voxels <= MAX_VOXELS) {
            let advice = format!(
                "the geofence would hold {voxels:.2e} voxels, more than {MAX_VOXELS:.0e}; use \
                 larger voxels or a smaller geofence"
            );
            return Err(invalid("occupancy.voxel_m", occupancy.voxel_m, advice));
        }
        Ok(())
    }

    fn check_cameras(&self) -> Result<(), ConfigError> {
        if !(1..=MAX_CAMERAS).contains(&self.cameras.len()) {
            let advice = format!("give 1 to {MAX_CAMERAS} [[cameras]]");
            return Err(invalid("cameras", format!("{} of them", self.cameras.len()), advice));
        }
        let mut taken = HashSet::new();
        for (index, camera) in self.cameras.iter().enumerate() {
            let key = |field: &str| format!("cameras[{index}].{field}");
            check_name(&key("name"), &camera.name, &mut taken)?;
            camera.check(key)?;
        }
        Ok(())
    }

    fn check_stages(&self) -> Result<(), ConfigError> {
        if self.stages.len() > MAX_STAGES {
            let advice = format!("give at most {MAX_STAGES} [[stages]]");
            return Err(invalid("stages", format!("{} of them", self.stages.len()), advice));
        }
        let mut taken = HashSet::new();
        for (index, stage) in self.stages.iter().enumerate() {
            let key = |field: &str| format!("stages[{index}].{field}");
            check_name(&key("name"), &stage.name, &mut taken)?;
            check_position(&key("center_m"), stage.center_m)?;
            check_position(&key("normal"), stage.normal)?;
            if !(stage.normal.length() > 1e-6) {
                let advice = "give the direction of passage, for example [1.0, 0.0, 0.0]";
                return Err(invalid(key("normal"), stage.normal, advice));
            }
            // A body does not fit through a narrower opening.
            let size_m = 2.0 * self.body_radius_m..=100.0;
            check_number(&key("width_m"), stage.width_m, "m", size_m.clone())?;
            check_number(&key("height_m"), stage.height_m, "m", size_m)?;
            check_number(&key("thickness_m"), stage.thickness_m, "m", 0.0..=100.0)?;
            let most_m = stage.width_m.min(stage.height_m) / 2.0;
            check_number(&key("clearance_m"), stage.clearance_m, "m", 0.0..=most_m)?;
            check_polygon(stage, &key("polygon_m"))?;
            if !(self.geofence().signed_distance_m(stage.center_m) < 0.0) {
                let advice = format!(
                    "must be inside the geofence {} to {}",
                    self.geofence.min_m, self.geofence.max_m
                );
                return Err(invalid(key("center_m"), stage.center_m, advice));
            }
        }
        Ok(())
    }
}
