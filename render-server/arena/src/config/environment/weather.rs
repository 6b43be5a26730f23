//! `[environment.rain]` and the other tables: weather and lamps, with their ranges.

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

use super::super::validate::{ConfigError, check_number, invalid};
use super::{EnvironmentConfig, FOG, extinction_per_m};

/// `[environment.cloud]`: drifting air of uneven density: smoke, dust, patchy fog.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CloudConfig {
    /// Visibility if the cloud were even, 0.5 to 1000: distance at which 2 % of the contrast is left. [m]
    pub visibility_m: f64,
    /// Colour where the cloud is opaque: red, green, blue; 0 to 1.
    pub color: [f64; 3],
    /// Unevenness of the density: 0 is even, 1 leaves gaps.
    pub patchiness: f64,
    /// Size of the patches, 0.2 to 100. [m]
    pub patch_m: f64,
    /// Drift velocity, up to 30. [m/s, world]
    pub drift_mps: DVec3,
    /// Lowest and highest height of the cloud; without it, all heights. [m, world]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub layer_m: Option<[f64; 2]>,
    /// Centre of the ball that the cloud fills, with `radius_m`. [m, world]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub center_m: Option<DVec3>,
    /// Radius of this ball, 0.1 to 1000. [m]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub radius_m: Option<f64>,
}

impl CloudConfig {
    /// Fog in patches, in a light wind.
    pub const USUAL: Self = Self {
        visibility_m: 10.0,
        color: FOG,
        patchiness: 1.0,
        patch_m: 2.0,
        drift_mps: DVec3::new(0.5, 0.2, 0.0),
        layer_m: None,
        center_m: None,
        radius_m: None,
    };

    /// Returns the mean extinction coefficient. [1/m]
    pub fn per_m(&self) -> f64 {
        extinction_per_m(self.visibility_m)
    }

    fn check(&self) -> Result<(), ConfigError> {
        check_number("environment.cloud.visibility_m", self.visibility_m, "m", 0.5..=1000.0)?;
        check_colors("environment.cloud.color", self.color, 1.0)?;
        check_number("environment.cloud.patchiness", self.patchiness, "", 0.0..=1.0)?;
        check_number("environment.cloud.patch_m", self.patch_m, "m", 0.2..=100.0)?;
        for speed in self.drift_mps.to_array() {
            check_number("environment.cloud.drift_mps", speed, "m/s", -30.0..=30.0)?;
        }
        if let Some([bottom_m, top_m]) = self.layer_m {
            for height_m in [bottom_m, top_m] {
                check_number("environment.cloud.layer_m", height_m, "m", -1000.0..=1000.0)?;
            }
            if !(top_m - bottom_m >= 0.1) {
                return Err(invalid(
                    "environment.cloud.layer_m",
                    format!("[{bottom_m}, {top_m}]"),
                    "give its bottom, then its top, 0.1 m higher at least",
                ));
            }
        }
        if self.center_m.is_some() != self.radius_m.is_some() {
            return Err(invalid(
                "environment.cloud",
                "incomplete ball",
                "give center_m and radius_m, or neither",
            ));
        }
        for at_m in self.center_m.into_iter().flat_map(|center_m| center_m.to_array()) {
            check_number("environment.cloud.center_m", at_m, "m", -1e5..=1e5)?;
        }
        match self.radius_m {
            Some(m) => check_number("environment.cloud.radius_m", m, "m", 0.1..=1000.0),
            None => Ok(()),
        }
    }
}

impl Default for CloudConfig {
    fn default() -> Self {
        Self::USUAL
    }
}

/// `[environment.rain]`: streaks of falling drops, and drops on the lens.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RainConfig {
    /// Rainfall: 2 is light, 10 moderate, 50 a downpour; 0.1 to 200. [mm/h]
    pub rate_mmph: f64,
    /// Wind: east, north; up to 30. [m/s, world]
    pub wind_mps: DVec2,
    /// Number of drops on each lens at a time, up to 100.
    pub lens_drops: u32,
}

impl RainConfig {
    /// A heavy shower.
    pub const USUAL: Self =
        Self { rate_mmph: 25.0, wind_mps: DVec2::new(1.0, 0.5), lens_drops: 10 };

    fn check(&self) -> Result<(), ConfigError> {
        check_number("environment.rain.rate_mmph", self.rate_mmph, "mm/h", 0.1..=200.0)?;
        check_wind("environment.rain.wind_mps", self.wind_mps)?;
        check_number("environment.rain.lens_drops", self.lens_drops.into(), "", 0.0..=100.0)
    }
}

impl Default for RainConfig {
    fn default() -> Self {
        Self::USUAL
    }
}

/// `[environment.snow]`: falling flakes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SnowConfig {
    /// Snowfall as water: 1 is moderate, 4 heavy; 0.1 to 20. [mm/h]
    pub rate_mmph: f64,
    /// Wind: east, north; up to 30. [m/s, world]
    pub wind_mps: DVec2,
}

impl SnowConfig {
    /// Moderate snow.
    pub const USUAL: Self = Self { rate_mmph: 2.0, wind_mps: DVec2::new(0.6, 0.3) };

    fn check(&self) -> Result<(), ConfigError> {
        check_number("environment.snow.rate_mmph", self.rate_mmph, "mm/h", 0.1..=20.0)?;
        check_wind("environment.snow.wind_mps", self.wind_mps)
    }
}

impl Default for SnowConfig {
    fn default() -> Self {
        Self::USUAL
    }
}

/// `[environment.sun]`: a low sun, whose light scatters in the lens of a camera that looks towards it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SunConfig {
    /// Direction of the sun: from x, counter-clockwise. [deg, world]
    pub azimuth_deg: f64,
    /// Elevation, -5 to 90. [deg]
    pub elevation_deg: f64,
    /// Light that the lens scatters, relative to a human eye: 0 to 10; 1 is a bare lens, 0.1 a clean one with a
    /// hood.
    pub glare: f64,
    /// Colour: red, green, blue; 0 to 4, 1 is white.
    pub color: [f64; 3],
    /// Minimum distance of surfaces that do not hide the sun, for example a captured sky or a window; 1 to
    /// 100000. [m]
    pub behind_m: f64,
}

impl SunConfig {
    /// Ahead of a flight along x, a little above the horizon.
    pub const USUAL: Self = Self {
        azimuth_deg: 8.0,
        elevation_deg: 14.0,
        glare: 1.0,
        color: [1.0, 0.85, 0.60],
        behind_m: 30.0,
    };

    /// Returns the unit vector towards the sun. [world]
    pub fn direction(&self) -> DVec3 {
        let (up, level) = self.elevation_deg.to_radians().sin_cos();
        DVec2::from_angle(self.azimuth_deg.to_radians()).extend(0.0) * level + DVec3::Z * up
    }

    fn check(&self) -> Result<(), ConfigError> {
        check_number("environment.sun.azimuth_deg", self.azimuth_deg, "degrees", -360.0..=360.0)?;
        check_number("environment.sun.elevation_deg", self.elevation_deg, "degrees", -5.0..=90.0)?;
        check_number("environment.sun.glare", self.glare, "", 0.0..=10.0)?;
        check_colors("environment.sun.color", self.color, 4.0)?;
        check_number("environment.sun.behind_m", self.behind_m, "m", 1.0..=1e5)
    }
}

impl Default for SunConfig {
    fn default() -> Self {
        Self::USUAL
    }
}

/// Maximum number of lamps in `positions_m`.
pub const MAX_LAMPS: usize = 8;

/// `[environment.lamps]`: lamps on a grid, or at listed positions.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LampsConfig {
    /// Distance from a lamp at which its light equals that of the capture, 0.05 to 100. [m]
    pub reach_m: f64,
    /// Colour: red, green, blue; 0 to 4, 1 is the capture's.
    pub color: [f64; 3],
    /// Height of the lamps, on a square grid through the origin. [m, world]
    pub height_m: f64,
    /// Distance between neighbours on the grid, 0.5 to 1000. [m]
    pub spacing_m: f64,
    /// Positions of up to 8 lamps, in place of the grid. [m, world]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub positions_m: Option<LampPositions>,
}

/// Up to [`MAX_LAMPS`] positions; written as a list of `[x, y, z]`. [m, world]
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Vec<DVec3>", into = "Vec<DVec3>")]
pub struct LampPositions {
    places_m: [DVec3; MAX_LAMPS],
    count: usize,
}

impl LampPositions {
    /// Returns the positions. [m, world]
    pub fn places_m(&self) -> &[DVec3] {
        &self.places_m[..self.count]
    }
}

impl TryFrom<Vec<DVec3>> for LampPositions {
    type Error = String;

    fn try_from(list: Vec<DVec3>) -> Result<Self, String> {
        if !(1..=MAX_LAMPS).contains(&list.len()) {
            return Err(format!(
                "positions_m has {} places; give 1 to {MAX_LAMPS}, or height_m and spacing_m of a grid",
                list.len()
            ));
        }
        let mut places_m = [DVec3::ZERO; MAX_LAMPS];
        places_m[..list.len()].copy_from_slice(&list);
        Ok(Self { places_m, count: list.len() })
    }
}

impl From<LampPositions> for Vec<DVec3> {
    fn from(positions: LampPositions) -> Self {
        positions.places_m().to_vec()
    }
}

impl LampsConfig {
    /// Warm ceiling lamps in a hall.
    pub const USUAL: Self = Self {
        reach_m: 1.1,
        color: [1.0, 0.80, 0.52],
        height_m: 3.0,
        spacing_m: 4.0,
        positions_m: None,
    };

    fn check(&self) -> Result<(), ConfigError> {
        check_number("environment.lamps.reach_m", self.reach_m, "m", 0.05..=100.0)?;
        check_colors("environment.lamps.color", self.color, 4.0)?;
        check_number("environment.lamps.height_m", self.height_m, "m", -1000.0..=1000.0)?;
        check_number("environment.lamps.spacing_m", self.spacing_m, "m", 0.5..=1000.0)?;
        let places = self.positions_m.iter().flat_map(LampPositions::places_m);
        for at_m in places.flat_map(DVec3::to_array) {
            check_number("environment.lamps.positions_m", at_m, "m", -1e5..=1e5)?;
        }
        Ok(())
    }
}

impl Default for LampsConfig {
    fn default() -> Self {
        Self::USUAL
    }
}

/// `[environment.own_light]`: a lamp on the vehicle, next to each camera and along its axis.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OwnLightConfig {
    /// Distance ahead at which its light equals that of the capture, 0.05 to 100. [m]
    pub reach_m: f64,
    /// Colour: red, green, blue; 0 to 4, 1 is the capture's.
    pub color: [f64; 3],
    /// Half angle of the light cone, 5 to 90. [deg]
    pub cone_deg: f64,
}

impl OwnLightConfig {
    /// A bright LED.
    pub const USUAL: Self = Self { reach_m: 3.0, color: [0.95, 1.0, 1.0], cone_deg: 32.0 };

    fn check(&self) -> Result<(), ConfigError> {
        check_number("environment.own_light.reach_m", self.reach_m, "m", 0.05..=100.0)?;
        check_colors("environment.own_light.color", self.color, 4.0)?;
        check_number("environment.own_light.cone_deg", self.cone_deg, "degrees", 5.0..=90.0)
    }
}

impl Default for OwnLightConfig {
    fn default() -> Self {
        Self::USUAL
    }
}

/// `[environment.flicker]`: flicker of the scene's light and lamps at twice the mains frequency.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FlickerConfig {
    /// Mains frequency, half of the light's frequency: 16 to 400. [Hz]
    pub mains_hz: f64,
    /// Amplitude of the flicker as a share of the mean light: 0 to 1.
    pub depth: f64,
    /// Rolling shutter: time from the first row's exposure to the last row's, up to 100; 0 for a global
    /// shutter. [ms]
    pub readout_ms: f64,
}

impl FlickerConfig {
    /// Fluorescent tubes on a magnetic ballast, seen by a rolling shutter.
    pub const USUAL: Self = Self { mains_hz: 50.0, depth: 0.35, readout_ms: 16.0 };

    fn check(&self) -> Result<(), ConfigError> {
        check_number("environment.flicker.mains_hz", self.mains_hz, "Hz", 16.0..=400.0)?;
        check_number("environment.flicker.depth", self.depth, "", 0.0..=1.0)?;
        check_number("environment.flicker.readout_ms", self.readout_ms, "ms", 0.0..=100.0)
    }
}

impl Default for FlickerConfig {
    fn default() -> Self {
        Self::USUAL
    }
}

/// In less light, a scene's colours are lost, and lamps cannot restore them.
const LEAST_LIGHT: f64 = 0.02;

impl EnvironmentConfig {
    pub(super) fn check_weather(&self) -> Result<(), ConfigError> {
        check_number("environment.exposure_ms", self.exposure_ms, "ms", 0.05..=100.0)?;
        self.cloud.as_ref().map_or(Ok(()), CloudConfig::check)?;
        self.rain.as_ref().map_or(Ok(()), RainConfig::check)?;
        self.snow.as_ref().map_or(Ok(()), SnowConfig::check)?;
        self.sun.as_ref().map_or(Ok(()), SunConfig::check)?;
        self.lamps.as_ref().map_or(Ok(()), LampsConfig::check)?;
        self.own_light.as_ref().map_or(Ok(()), OwnLightConfig::check)?;
        self.flicker.as_ref().map_or(Ok(()), FlickerConfig::check)?;
        if self.lamps.is_some() || self.own_light.is_some() {
            for light in self.light {
                check_number("environment.light", light, "where lamps shine", LEAST_LIGHT..=4.0)?;
            }
        }
        Ok(())
    }
}

fn check_colors(key: &'static str, color: [f64; 3], most: f64) -> Result<(), ConfigError> {
    color.into_iter().try_for_each(|value| check_number(key, value, "", 0.0..=most))
}

fn check_wind(key: &'static str, wind_mps: DVec2) -> Result<(), ConfigError> {
    wind_mps
        .to_array()
        .into_iter()
        .try_for_each(|value| check_number(key, value, "m/s", -30.0..=30.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> EnvironmentConfig {
        toml::from_str(text).unwrap()
    }

    #[test]
    fn absent_keys_take_usual_values() {
        let rain = parsed("[rain]\nrate_mmph = 3.0");
        assert_eq!(rain.rain, Some(RainConfig { rate_mmph: 3.0, ..RainConfig::USUAL }));
        assert_eq!(EnvironmentConfig { rain: None, ..rain }, EnvironmentConfig::CLEAR);
        assert_eq!(parsed("[cloud]").cloud, Some(CloudConfig::USUAL));
        assert_eq!(
            parsed("[lamps]\npositions_m = [[1, 2, 3]]")
                .lamps
                .unwrap()
                .positions_m
                .unwrap()
                .places_m(),
            [DVec3::new(1.0, 2.0, 3.0)]
        );
    }

    #[test]
    fn every_named_environment_round_trips() {
        for (name, named) in EnvironmentConfig::NAMED {
            let text = toml::to_string(named).unwrap();
            assert_eq!(parsed(&text), *named, "{name}: {text}");
        }
        let text = toml::to_string(&EnvironmentConfig::CLEAR).unwrap();
        assert!(
            !text.contains("exposure") && !text.contains("depth_loss") && !text.contains("rain"),
            "{text}"
        );
    }

    #[test]
    fn errors_name_the_invalid_key() {
        let wrong = [
            ("exposure_ms = 0", "environment.exposure_ms"),
            ("exposure_ms = nan", "environment.exposure_ms"),
            ("[rain]\nrate_mmph = -1", "environment.rain.rate_mmph"),
            ("[rain]\nrate_mmph = inf", "environment.rain.rate_mmph"),
            ("[rain]\nlens_drops = 101", "environment.rain.lens_drops"),
            ("[snow]\nwind_mps = [0, 31]", "environment.snow.wind_mps"),
            ("[cloud]\nvisibility_m = 0", "environment.cloud.visibility_m"),
            ("[cloud]\npatch_m = 0.1", "environment.cloud.patch_m"),
            ("[cloud]\npatchiness = 2", "environment.cloud.patchiness"),
            ("[cloud]\nlayer_m = [2, 1]", "environment.cloud.layer_m"),
            ("[cloud]\nlayer_m = [nan, 1]", "environment.cloud.layer_m"),
            ("[cloud]\nradius_m = 2", "environment.cloud"),
            ("[cloud]\ncenter_m = [0, nan, 0]\nradius_m = 2", "environment.cloud.center_m"),
            ("[sun]\nelevation_deg = 91", "environment.sun.elevation_deg"),
            ("[sun]\nglare = -1", "environment.sun.glare"),
            ("[lamps]\nspacing_m = 0", "environment.lamps.spacing_m"),
            ("[lamps]\npositions_m = [[0, nan, 0]]", "environment.lamps.positions_m"),
            ("light = [0, 0, 0]\n[lamps]", "environment.light"),
            ("light = [1, 0.01, 1]\n[own_light]", "environment.light"),
            ("[own_light]\ncone_deg = 0", "environment.own_light.cone_deg"),
            ("[flicker]\nmains_hz = 0", "environment.flicker.mains_hz"),
            ("[flicker]\ndepth = 1.1", "environment.flicker.depth"),
        ];
        for (text, key) in wrong {
            let error = parsed(text).check().unwrap_err().to_string();
            assert!(error.contains(key), "{text}: {error}");
        }
        let refused =
            |text: &str| toml::from_str::<EnvironmentConfig>(text).unwrap_err().to_string();
        assert!(refused("[rain]\nrate = 1").contains("unknown field `rate`"));
        assert!(refused("[lamps]\npositions_m = []").contains("give 1 to 8"));
        let many = "[lamps]\npositions_m = [".to_owned() + &"[0, 0, 0],".repeat(9) + "]";
        assert!(refused(&many).contains("has 9 places"));
    }

    #[test]
    fn sun_direction_follows_azimuth_and_elevation() {
        let sun = SunConfig { azimuth_deg: 90.0, elevation_deg: 30.0, ..SunConfig::USUAL };
        let expected = DVec3::new(0.0, 0.75_f64.sqrt(), 0.5);
        assert!((sun.direction() - expected).length() < 1e-12);
    }
}
