//! `[environment]`: light, air and weather, which affect only the cameras.

use serde::{Deserialize, Serialize};

use super::ArenaConfig;
use super::validate::{ConfigError, check_number};

mod named;
mod weather;

pub use weather::{
    CloudConfig, FlickerConfig, LampPositions, LampsConfig, MAX_LAMPS, OwnLightConfig, RainConfig,
    SnowConfig, SunConfig,
};

/// `[environment]`: effects between the captured scene and its images. Every key is optional and off by
/// default. Obstacles, course, depth and ids do not depend on it.
///
/// ```
/// use vizflyt_arena::config::EnvironmentConfig;
/// let fog = EnvironmentConfig::named("fog").unwrap();
/// // At the visibility range, the contrast has lost 98 %.
/// let left = (-fog.fog_per_m() * fog.fog_visibility_m).exp();
/// assert!((left - 0.02).abs() < 1e-9);
/// assert_eq!(fog.name(), Some("fog"));
/// assert_eq!(EnvironmentConfig::named("hail"), None);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EnvironmentConfig {
    /// Factor on every colour of the scene: red, green, blue; 0 to 4.
    pub light: [f64; 3],
    /// Visibility: distance at which 2 % of the contrast is left (meteorological optical range by Koschmieder's
    /// law); 0 is clear air, otherwise 0.5 to 1000. [m]
    pub fog_visibility_m: f64,
    /// Colour of opaque fog: red, green, blue; 0 to 1.
    pub fog: [f64; 3],
    /// Exposure time of the cameras, 0.05 to 100; it affects streaks and flicker. [ms]
    #[serde(skip_serializing_if = "is_usual_exposure")]
    pub exposure_ms: f64,
    /// Whether depth cameras lose returns by attenuation on the way there and back; otherwise depth is perfect.
    #[serde(skip_serializing_if = "core::ops::Not::not")]
    pub depth_loss: bool,
    /// Smoke, dust or patchy fog.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cloud: Option<CloudConfig>,
    /// Rain.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rain: Option<RainConfig>,
    /// Snow.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub snow: Option<SnowConfig>,
    /// A low sun.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sun: Option<SunConfig>,
    /// Lamps in the scene.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lamps: Option<LampsConfig>,
    /// A lamp on the vehicle, next to each camera.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub own_light: Option<OwnLightConfig>,
    /// Flicker of the scene's light and lamps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub flicker: Option<FlickerConfig>,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
fn is_usual_exposure(exposure_ms: &f64) -> bool {
    *exposure_ms == EXPOSURE_MS
}

impl Default for EnvironmentConfig {
    fn default() -> Self {
        Self::CLEAR
    }
}

/// Grey, a little blue.
const FOG: [f64; 3] = [0.70, 0.73, 0.76];
/// A camera's exposure by day. [ms]
const EXPOSURE_MS: f64 = 5.0;

impl EnvironmentConfig {
    /// The light of the capture and clear air.
    pub const CLEAR: Self = Self {
        light: [1.0; 3],
        fog_visibility_m: 0.0,
        fog: FOG,
        exposure_ms: EXPOSURE_MS,
        depth_loss: false,
        cloud: None,
        rain: None,
        snow: None,
        sun: None,
        lamps: None,
        own_light: None,
        flicker: None,
    };

    /// Returns the environment with a name.
    pub fn named(name: &str) -> Option<Self> {
        Self::NAMED.iter().find(|(known, _)| *known == name).map(|&(_, named)| named)
    }

    /// Returns the name of this environment, if it has one.
    pub fn name(&self) -> Option<&'static str> {
        Self::NAMED.iter().find(|(_, named)| named == self).map(|&(name, _)| name)
    }

    /// Returns the extinction coefficient of the air: `exp(-it * d)` of the light is left at distance `d`.
    /// [1/m]
    pub fn fog_per_m(&self) -> f64 {
        if self.fog_visibility_m > 0.0 { extinction_per_m(self.fog_visibility_m) } else { 0.0 }
    }

    /// Checks every number.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`] with the key.
    pub fn check(&self) -> Result<(), ConfigError> {
        for light in self.light {
            check_number("environment.light", light, "", 0.0..=4.0)?;
        }
        for fog in self.fog {
            check_number("environment.fog", fog, "", 0.0..=1.0)?;
        }
        if self.fog_visibility_m != 0.0 {
            let key = "environment.fog_visibility_m";
            check_number(key, self.fog_visibility_m, "m, or 0 for clear air", 0.5..=1000.0)?;
        }
        self.check_weather()
    }

    pub(super) fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

/// Returns the extinction coefficient of air in which 2 % of the contrast is left at a distance [m]:
/// Koschmieder's law. [1/m]
fn extinction_per_m(visibility_m: f64) -> f64 {
    let contrast = 0.02_f64;
    -contrast.ln() / visibility_m
}

impl ArenaConfig {
    pub(super) fn check_environment(&self) -> Result<(), ConfigError> {
        self.environment.check()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn named_environments_are_valid_and_found_by_value() {
        for &(name, named) in EnvironmentConfig::NAMED {
            named.check().unwrap();
            assert_eq!(named.name(), Some(name));
        }
        assert!(EnvironmentConfig::named("day").unwrap().is_default());
    }

    #[test]
    fn errors_name_the_invalid_key() {
        let check = |text: &str| {
            let environment: EnvironmentConfig = toml::from_str(text).unwrap();
            environment.check().unwrap_err().to_string()
        };
        assert!(check("light = [1, -1, 1]").contains("environment.light"));
        assert!(check("fog = [0.5, 0.5, 1.5]").contains("environment.fog"));
        assert!(check("fog_visibility_m = 0.1").contains("environment.fog_visibility_m"));
        assert!(check("fog_visibility_m = nan").contains("environment.fog_visibility_m"));
    }
}
