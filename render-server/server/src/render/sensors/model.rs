//! Conversion from `[[sensors]]` to a sensor model: a preset by name, and its changed values.

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};
use vizflyt_arena::config::{ConfigError, SensorConfig, invalid};
use vizflyt_protocol::messages::bounded;
use vizflyt_protocol::sensor::{SensorInfo, SensorKind};
use vizflyt_splat::sensor::presets::{Preset, names, preset};
use vizflyt_splat::sensor::{
    Beams, InvalidModel, Lidar, LidarModel, Radar, RadarModel, RangeFinder, RangeModel, Sonar,
    SonarModel,
};

/// Model of a sensor, ready to measure.
#[derive(Clone, Debug)]
pub enum SensorModel {
    /// Of [`SensorKind::Lidar`].
    Lidar(Lidar),
    /// Of [`SensorKind::RangeFinder`].
    RangeFinder(RangeFinder),
    /// Of [`SensorKind::Sonar`].
    Sonar(Sonar),
    /// Of [`SensorKind::Radar`].
    Radar(Radar),
}

impl SensorModel {
    /// Creates the model of a sensor; `key` returns the name of a field of its configuration.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`] for an unknown name, keys that the kind does not have, and invalid values.
    pub fn new(config: &SensorConfig, key: impl Fn(&str) -> String) -> Result<Self, ConfigError> {
        let Some(preset) = preset(&config.model) else {
            let advice = format!("there is no such model; there are: {}", names());
            return Err(invalid(key("model"), format!("{:?}", config.model), advice));
        };
        let refused = |error: InvalidModel| {
            let InvalidModel { field, value, expected, .. } = error;
            let field =
                if is_common(field) { field.to_owned() } else { format!("settings.{field}") };
            invalid(key(&field), value, format!("give {expected}"))
        };
        let model = match preset {
            Preset::Lidar(model) => {
                let model: LidarModel = changed(&model, config, &key)?;
                let lidar = Lidar::new(model).map_err(refused)?;
                let (beams, most) = (lidar.beams(), SensorKind::Lidar.max_records());
                if beams > most {
                    let advice = format!("a sweep has at most {most} of them");
                    return Err(invalid(key("settings.beams"), beams, advice));
                }
                Self::Lidar(lidar)
            }
            Preset::Range(model) => {
                let model: RangeModel = changed(&model, config, &key)?;
                Self::RangeFinder(RangeFinder::new(model).map_err(refused)?)
            }
            Preset::Sonar(model) => {
                let model: SonarModel = changed(&model, config, &key)?;
                Self::Sonar(Sonar::new(model).map_err(refused)?)
            }
            Preset::Radar(model) => {
                let model: RadarModel = changed(&model, config, &key)?;
                Self::Radar(Radar::new(model).map_err(refused)?)
            }
        };
        let hz = model.rate_hz();
        if !(0.1..=MAX_HZ).contains(&hz) {
            return Err(invalid(
                key("rate_hz"),
                hz,
                format!("give a number from 0.1 to {MAX_HZ} Hz"),
            ));
        }
        Ok(model)
    }

    pub fn kind(&self) -> SensorKind {
        match self {
            Self::Lidar(_) => SensorKind::Lidar,
            Self::RangeFinder(_) => SensorKind::RangeFinder,
            Self::Sonar(_) => SensorKind::Sonar,
            Self::Radar(_) => SensorKind::Radar,
        }
    }

    /// Returns the rate of readings. [Hz]
    pub fn rate_hz(&self) -> f64 {
        match self {
            Self::Lidar(lidar) => lidar.model().rate_hz,
            Self::RangeFinder(range) => range.model().rate_hz,
            Self::Sonar(sonar) => sonar.model().rate_hz,
            Self::Radar(radar) => radar.model().rate_hz,
        }
    }

    /// Returns the description of the sensor for runtime and plugins.
    pub fn info(&self, config: &SensorConfig) -> SensorInfo {
        let ([min_range_m, max_range_m], [horizontal_fov_rad, vertical_fov_rad], most) = match self
        {
            Self::Lidar(lidar) => {
                let model = lidar.model();
                let ranges = [model.min_range_m, model.max_range_m];
                (ranges, field_of_view(&model.beams), lidar.beams())
            }
            Self::RangeFinder(range) => {
                let model = range.model();
                ([model.min_range_m, model.max_range_m], [model.fov_rad; 2], 1)
            }
            Self::Sonar(sonar) => {
                let model = sonar.model();
                ([model.min_range_m, model.max_range_m], [model.beam_rad; 2], 1)
            }
            Self::Radar(radar) => {
                let model = radar.model();
                let fov_rad = [model.azimuth_fov_rad, model.elevation_fov_rad];
                let most = SensorKind::Radar.max_records();
                ([model.min_range_m, model.max_range_m], fov_rad, most)
            }
        };
        SensorInfo {
            name: bounded(&config.name),
            kind: self.kind(),
            enabled: config.enabled,
            to_autopilot: config.to_autopilot,
            rate_hz: self.rate_hz() as f32,
            min_range_m,
            max_range_m,
            horizontal_fov_rad,
            vertical_fov_rad,
            most_records: most as u32,
            body_from_sensor: config.body_from_sensor(),
        }
    }
}

/// Returns width and height of the beams' field of view. [rad]
fn field_of_view(beams: &Beams) -> [f32; 2] {
    match beams {
        Beams::Spinning { elevations_rad, .. } => {
            let all = || elevations_rad.iter().copied();
            let height = all().fold(f32::MIN, f32::max) - all().fold(f32::MAX, f32::min);
            [std::f32::consts::TAU, height.max(0.0)]
        }
        Beams::Raster { horizontal_rad, vertical_rad, .. }
        | Beams::Flash { horizontal_rad, vertical_rad, .. } => [*horizontal_rad, *vertical_rad],
        Beams::Rosette { lowest_rad, highest_rad, .. } => {
            [std::f32::consts::TAU, highest_rad - lowest_rad]
        }
    }
}

/// Returns whether a key of a model is set next to `settings` instead of in it.
fn is_common(field: &str) -> bool {
    matches!(field, "rate_hz" | "min_range_m" | "max_range_m")
}

/// Returns the model with the changes of the configuration.
fn changed<M: Serialize + DeserializeOwned>(
    model: &M,
    config: &SensorConfig,
    key: impl Fn(&str) -> String,
) -> Result<M, ConfigError> {
    let json = |value: &toml::Table| serde_json::to_value(value).ok();
    let Ok(Value::Object(mut keys)) = serde_json::to_value(model) else {
        return Err(invalid(key("model"), &config.model, "cannot be changed"));
    };
    let settings = match json(&config.settings) {
        Some(Value::Object(settings)) => settings,
        _ => Map::new(),
    };
    if let Some((name, value)) = settings.iter().find(|(name, _)| is_common(name)) {
        let advice =
            format!("belongs next to `settings`: set {name} = {value} of the sensor itself");
        return Err(invalid(key(&format!("settings.{name}")), value, advice));
    }
    keys.extend(settings);
    let common = [
        ("rate_hz", config.rate_hz),
        ("min_range_m", config.min_range_m),
        ("max_range_m", config.max_range_m),
    ];
    for (name, value) in common {
        if let Some(value) = value {
            keys.insert(name.to_owned(), value.into());
        }
    }
    serde_json::from_value(Value::Object(keys))
        .map_err(|error| invalid(key("settings"), &config.settings, error.to_string()))
}

/// Maximum rate: higher than of any real sensor, and of the images for a plugin. [Hz]
const MAX_HZ: f64 = 200.0;

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    fn model(name: &str, change: impl FnOnce(&mut SensorConfig)) -> Result<SensorModel, String> {
        let mut config = SensorConfig::ahead("x", name, DVec3::ZERO);
        change(&mut config);
        SensorModel::new(&config, |field| format!("sensors[0].{field}"))
            .map_err(|error| error.to_string())
    }

    fn set(key: &str, value: impl Into<toml::Value>) -> impl FnOnce(&mut SensorConfig) {
        let (key, value) = (key.to_owned(), value.into());
        move |config| {
            config.settings.insert(key, value);
        }
    }

    #[test]
    fn every_preset_is_a_valid_sensor() {
        for (name, ..) in vizflyt_splat::sensor::presets::PRESETS {
            let found = model(name, |_| {}).unwrap();
            let info = found.info(&SensorConfig::ahead("x", name, DVec3::ZERO));
            assert!(info.min_range_m < info.max_range_m && info.horizontal_fov_rad > 0.0, "{name}");
            assert!(info.most_records as usize <= info.kind.max_records(), "{name}");
        }
    }

    #[test]
    fn settings_override_the_data_sheet() {
        let found = model("tfmini", |config| {
            (config.rate_hz, config.max_range_m) = (Some(20.0), Some(6.0));
            set("sigma_m", 0.0)(config);
        });
        let SensorModel::RangeFinder(range) = found.unwrap() else { panic!() };
        let model = range.model();
        assert_eq!((model.rate_hz, model.max_range_m, model.sigma_m), (20.0, 6.0, 0.0));
        assert_eq!(model.fov_rad, 2.3_f32.to_radians(), "the rest is the sensor's");
    }

    #[test]
    fn errors_name_the_key_with_advice() {
        let check = |found: Result<SensorModel, String>, expected: &str| {
            let error = found.unwrap_err();
            assert!(error.contains(expected), "'{error}' lacks '{expected}'");
        };
        check(model("tfmini2", |_| {}), "sensors[0].model = \"tfmini2\": there is no such model");
        check(model("tfmini2", |_| {}), "os1-16");
        check(model("tfmini", set("gamma", 1.0)), "unknown field `gamma`, expected one of");
        check(model("tfmini", set("sigma_m", "much")), "sensors[0].settings");
        check(model("tfmini", set("rate_hz", 5.0)), "belongs next to `settings`");
        check(model("tfmini", set("sigma_m", -1.0)), "sensors[0].settings.sigma_m = -1");
        check(model("tfmini", |config| config.max_range_m = Some(0.1)), "sensors[0].max_range_m");
    }
}
