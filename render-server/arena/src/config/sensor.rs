//! `[[sensors]]`: LiDAR, range finders, sonar, radar: a named model, its mounting, and values that override the
//! data sheet.

use std::collections::HashSet;

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};
use vizflyt_protocol::geometry::{Body, Pose, Sensor};
use vizflyt_protocol::sensor::MAX_SENSORS;

use super::ArenaConfig;
use super::validate::{ConfigError, check_name, check_number, check_position, invalid};

/// One of `[[sensors]]`.
///
/// The server defines the models and the keys that each accepts in `settings`.
///
/// ```
/// let text = r#"
/// name = "down"
/// model = "tfmini"
/// position_m = [0.0, 0.0, -0.05]
/// tilt_deg = -90.0
/// rate_hz = 50.0
/// to_autopilot = true
/// settings = { sigma_m = 0.0, sigma_per_m = 0.0 }
/// "#;
/// let sensor: vizflyt_arena::config::SensorConfig = toml::from_str(text).unwrap();
/// // It looks down: its x axis is the body's -z.
/// let ahead = sensor.body_from_sensor().rotate(glam::DVec3::X);
/// assert!((ahead + glam::DVec3::Z).length() < 1e-12);
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SensorConfig {
    /// Name for plugins; unique among the sensors, at most 32 bytes.
    pub name: String,
    /// Name of the model, for example `os1-16` or `tfmini`; it determines the kind of sensor.
    pub model: String,
    /// Mounting position on the vehicle. [m, body]
    pub position_m: DVec3,
    /// Nose-up tilt of the sensor's x axis, after the yaw. [deg]
    #[serde(default, skip_serializing_if = "is_zero")]
    pub tilt_deg: f64,
    /// Turn of the sensor's x axis to the left, about the body's z, before the tilt. [deg]
    #[serde(default, skip_serializing_if = "is_zero")]
    pub yaw_deg: f64,
    /// Turn about the sensor's x axis, right side down, after yaw and tilt. [deg]
    #[serde(default, skip_serializing_if = "is_zero")]
    pub roll_deg: f64,
    /// Readings per second; default: the model's. [Hz]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rate_hz: Option<f64>,
    /// Minimum range; default: the model's. [m]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub min_range_m: Option<f64>,
    /// Maximum range; default: the model's. [m]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_range_m: Option<f64>,
    /// Whether the sensor measures.
    #[serde(default = "yes", skip_serializing_if = "is_yes")]
    pub enabled: bool,
    /// Whether the runtime forwards the readings to the autopilot.
    #[serde(default, skip_serializing_if = "is_no")]
    pub to_autopilot: bool,
    /// Other values that override the model, with the model's own keys (sensor-models.md).
    #[serde(default, skip_serializing_if = "toml::Table::is_empty")]
    pub settings: toml::Table,
}

impl SensorConfig {
    /// Returns a sensor of a model at `position_m` [m, body] that looks along the nose.
    pub fn ahead(name: &str, model: &str, position_m: DVec3) -> Self {
        Self {
            name: name.to_owned(),
            model: model.to_owned(),
            position_m,
            tilt_deg: 0.0,
            yaw_deg: 0.0,
            roll_deg: 0.0,
            rate_hz: None,
            min_range_m: None,
            max_range_m: None,
            enabled: true,
            to_autopilot: false,
            settings: toml::Table::new(),
        }
    }

    /// Returns the mounting pose: a sensor that looks along the nose, rolled about its axis, tilted up, then
    /// turned left.
    pub fn body_from_sensor(&self) -> Pose<Body, Sensor> {
        let yaw = DQuat::from_rotation_z(self.yaw_deg.to_radians());
        // From z towards x is a rotation about -y.
        let tilt = DQuat::from_rotation_y(-self.tilt_deg.to_radians());
        // The right side, -y, goes down by turning y towards z.
        let roll = DQuat::from_rotation_x(self.roll_deg.to_radians());
        Pose::new(self.position_m, yaw * tilt * roll)
    }

    /// Checks every value except the name and those that depend on the model: for later changes of one sensor.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`] for the first invalid value.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.check(str::to_owned)
    }

    fn check(&self, key: impl Fn(&str) -> String) -> Result<(), ConfigError> {
        check_position(&key("position_m"), self.position_m)?;
        if self.position_m.length() > MAX_LEVER_M {
            let advice = format!("the sensor must be within {MAX_LEVER_M} m of the body");
            return Err(invalid(key("position_m"), self.position_m, advice));
        }
        check_number(&key("tilt_deg"), self.tilt_deg, "degrees", -90.0..=90.0)?;
        check_number(&key("yaw_deg"), self.yaw_deg, "degrees", -360.0..=360.0)?;
        check_number(&key("roll_deg"), self.roll_deg, "degrees", -360.0..=360.0)?;
        let optional = |name: &str, value: Option<f64>, unit, range| {
            value.map_or(Ok(()), |value| check_number(&key(name), value, unit, range))
        };
        optional("rate_hz", self.rate_hz, "Hz", 0.1..=200.0)?;
        optional("min_range_m", self.min_range_m, "m", 0.0..=1000.0)?;
        optional("max_range_m", self.max_range_m, "m", 0.01..=1000.0)?;
        if let (Some(min_m), Some(max_m)) = (self.min_range_m, self.max_range_m)
            && min_m >= max_m
        {
            let advice = format!("must exceed min_range_m = {min_m}");
            return Err(invalid(key("max_range_m"), max_m, advice));
        }
        Ok(())
    }
}

impl ArenaConfig {
    pub(super) fn check_sensors(&self) -> Result<(), ConfigError> {
        if self.sensors.len() > MAX_SENSORS {
            let advice = format!("give at most {MAX_SENSORS} [[sensors]]");
            return Err(invalid("sensors", format!("{} of them", self.sensors.len()), advice));
        }
        let mut taken = HashSet::new();
        for (index, sensor) in self.sensors.iter().enumerate() {
            let key = |field: &str| format!("sensors[{index}].{field}");
            check_name(&key("name"), &sensor.name, &mut taken)?;
            sensor.check(key)?;
        }
        Ok(())
    }
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "as serde calls it")]
fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

fn yes() -> bool {
    true
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "as serde calls it")]
fn is_yes(value: &bool) -> bool {
    *value
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "as serde calls it")]
fn is_no(value: &bool) -> bool {
    !*value
}

/// A larger distance from the body is a typing error. [m]
const MAX_LEVER_M: f64 = 2.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mounting_angles_match_those_of_a_camera() {
        let camera = super::super::CameraConfig {
            tilt_deg: 25.0,
            yaw_deg: 70.0,
            roll_deg: 10.0,
            ..super::super::CameraConfig::ahead("x", [4, 3], 90.0, DVec3::X)
        };
        let sensor = SensorConfig {
            tilt_deg: 25.0,
            yaw_deg: 70.0,
            roll_deg: 10.0,
            ..SensorConfig::ahead("x", "tfmini", DVec3::X)
        };
        let (camera, sensor) = (camera.body_from_cam(), sensor.body_from_sensor());
        // A camera's z points ahead and its x to the right.
        for (of_camera, of_sensor) in [(DVec3::Z, DVec3::X), (DVec3::X, DVec3::NEG_Y)] {
            let apart = camera.rotate(of_camera) - sensor.rotate(of_sensor);
            assert!(apart.length() < 1e-12, "{apart}");
        }
    }

    #[test]
    fn errors_name_the_key_and_advice() {
        let check = |change: fn(&mut SensorConfig), expected: &str| {
            let mut sensor = SensorConfig::ahead("down", "tfmini", DVec3::ZERO);
            change(&mut sensor);
            let error = sensor.validate().unwrap_err().to_string();
            assert!(error.contains(expected), "'{error}' lacks '{expected}'");
        };
        check(|s| s.rate_hz = Some(0.0), "rate_hz = 0: give a number from 0.1 to 200 Hz");
        check(|s| s.position_m.z = 3.0, "within 2 m of the body");
        check(
            |s| (s.min_range_m, s.max_range_m) = (Some(3.0), Some(2.0)),
            "exceed min_range_m = 3",
        );
        check(|s| s.tilt_deg = f64::NAN, "tilt_deg = NaN");
    }
}
