//! Random light and weather within bounds, so that a plugin is graded in conditions for which it was not tuned.

use core::ops::RangeInclusive;

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};
use vizflyt_arena::config::{
    CloudConfig, ConfigError, EnvironmentConfig, FlickerConfig, LampsConfig, OwnLightConfig,
    RainConfig, SnowConfig, SunConfig, check_number, invalid,
};

use crate::random::Rng;

/// `[environments]` of a project file: bounds of random environments. Each pair is minimum and maximum; all keys are
/// optional.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DrawBounds {
    /// Kinds of weather, with equal probability.
    pub weathers: Vec<Weather>,
    /// Factor on the display values of the scene, for all colours.
    pub light: [f64; 2],
    /// Visibility of fog, smoke and dust. [m]
    pub visibility_m: [f64; 2],
    /// Rain. [mm/h]
    pub rain_mmph: [f64; 2],
    /// Snow, as water. [mm/h]
    pub snow_mmph: [f64; 2],
    /// Wind, from any side. [m/s]
    pub wind_mps: [f64; 2],
    /// Glare of a low sun, in a quarter of the environments that are not dark.
    pub glare: [f64; 2],
    /// Depth of the flicker, in a quarter of the environments.
    pub flicker: [f64; 2],
}

/// Kind of weather.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Weather {
    /// Clear air.
    Clear,
    /// Uniform fog.
    Fog,
    /// Fog in patches.
    PatchyFog,
    /// Smoke.
    Smoke,
    /// Dust above the floor.
    Dust,
    /// Rain.
    Rain,
    /// Snow.
    Snow,
}

/// Makes environments independent of places with the same seed.
const SALT: u64 = 0xe17_0000;
/// Below this light, lamps of the vehicle or the hall are on. [factor of display values]
const DARK: f64 = 0.4;

impl Default for DrawBounds {
    fn default() -> Self {
        use Weather::{Clear, Dust, Fog, PatchyFog, Rain, Smoke, Snow};
        Self {
            weathers: vec![Clear, Fog, PatchyFog, Smoke, Dust, Rain, Snow],
            light: [0.2, 1.1],
            visibility_m: [10.0, 40.0],
            rain_mmph: [2.0, 80.0],
            snow_mmph: [0.5, 4.0],
            wind_mps: [0.0, 4.0],
            glare: [0.1, 1.0],
            flicker: [0.1, 0.5],
        }
    }
}

impl DrawBounds {
    /// Checks that all environments within the bounds are valid.
    ///
    /// # Errors
    /// [`ConfigError::Invalid`], which names the key.
    pub fn check(&self) -> Result<(), ConfigError> {
        let pairs: [(&str, [f64; 2], RangeInclusive<f64>, &str); 7] = [
            ("environments.light", self.light, 0.02..=4.0, ""),
            ("environments.visibility_m", self.visibility_m, 0.5..=1000.0, "m"),
            ("environments.rain_mmph", self.rain_mmph, 0.1..=200.0, "mm/h"),
            ("environments.snow_mmph", self.snow_mmph, 0.1..=20.0, "mm/h"),
            ("environments.wind_mps", self.wind_mps, 0.0..=20.0, "m/s"),
            ("environments.glare", self.glare, 0.0..=10.0, ""),
            ("environments.flicker", self.flicker, 0.0..=1.0, ""),
        ];
        for (key, [least, greatest], range, unit) in pairs {
            check_number(key, least, unit, range.clone())?;
            check_number(key, greatest, unit, range)?;
            if least > greatest {
                let advice = "give the minimum first, then the maximum";
                return Err(invalid(key, format!("[{least}, {greatest}]"), advice));
            }
        }
        if self.weathers.is_empty() {
            return Err(invalid("environments.weathers", "[]", "give at least one weather"));
        }
        Ok(())
    }

    /// Returns environment `number` of a seed. Its values have three decimals, so that a conversion to text keeps them.
    pub fn draw(&self, seed: u64, number: u64) -> EnvironmentConfig {
        let mut rng = Rng::new(seed ^ SALT, number);
        let mut within = |[least, greatest]: [f64; 2]| thousandth(rng.range(least, greatest));
        let level = within(self.light);
        // Warmer or colder by up to 10 %.
        let warmth = within([-0.1, 0.1]);
        let light = [level * (1.0 + warmth), level, level * (1.0 - warmth)]
            .map(|x| thousandth(x.clamp(0.02, 4.0)));
        let (from_rad, speed_mps) = (within([0.0, core::f64::consts::TAU]), within(self.wind_mps));
        let along = |share: f64| thousandth(share * speed_mps);
        let wind_mps = DVec2::new(along(libm::cos(from_rad)), along(libm::sin(from_rad)));
        let visibility_m = within(self.visibility_m);
        let (rain_mmph, snow_mmph) = (within(self.rain_mmph), within(self.snow_mmph));
        let lens_drops = within([0.0, 16.0]) as u32;
        let (glare, azimuth_deg, elevation_deg) =
            (within(self.glare), within([-30.0, 30.0]), within([2.0, 20.0]));
        let flicker = within(self.flicker);
        let patch_m = within([1.0, 6.0]);
        let [has_sun, flickers, own_light] = [(); 3].map(|()| within([0.0, 1.0]));
        let which = within([0.0, 1.0]) * self.weathers.len() as f64;
        let weather = self.weathers[(which as usize).min(self.weathers.len() - 1)];
        // The light also applies to fog, smoke and dust.
        let lit =
            |color: [f64; 3]| [0, 1, 2].map(|c| thousandth((color[c] * light[c]).clamp(0.0, 1.0)));
        let fog = lit(EnvironmentConfig::CLEAR.fog);
        let cloud = CloudConfig {
            visibility_m,
            color: fog,
            patch_m,
            drift_mps: wind_mps.extend(0.0),
            ..CloudConfig::USUAL
        };
        let mut drawn = EnvironmentConfig { light, fog, ..EnvironmentConfig::CLEAR };
        match weather {
            Weather::Clear => {}
            Weather::Fog => drawn.fog_visibility_m = visibility_m,
            Weather::PatchyFog => drawn.cloud = Some(cloud),
            Weather::Smoke => {
                let drift_mps = cloud.drift_mps + DVec3::new(0.0, 0.0, 0.15);
                drawn.cloud =
                    Some(CloudConfig { color: lit([0.34, 0.34, 0.35]), drift_mps, ..cloud });
            }
            Weather::Dust => {
                let layer_m = Some([-1.0, 1.4]);
                drawn.cloud =
                    Some(CloudConfig { color: lit([0.66, 0.55, 0.41]), layer_m, ..cloud });
            }
            Weather::Rain => {
                drawn.rain = Some(RainConfig { rate_mmph: rain_mmph, wind_mps, lens_drops });
            }
            Weather::Snow => drawn.snow = Some(SnowConfig { rate_mmph: snow_mmph, wind_mps }),
        }
        if level < DARK {
            if own_light < 0.5 {
                drawn.own_light = Some(OwnLightConfig::USUAL);
            } else {
                drawn.lamps = Some(LampsConfig::USUAL);
            }
        } else if has_sun < 0.25 {
            let usual = SunConfig { behind_m: 6.0, ..SunConfig::USUAL };
            drawn.sun = Some(SunConfig { azimuth_deg, elevation_deg, glare, ..usual });
        }
        if flickers < 0.25 {
            drawn.flicker = Some(FlickerConfig { depth: flicker, ..FlickerConfig::USUAL });
        }
        drawn
    }
}

fn thousandth(number: f64) -> f64 {
    (number * 1e3).round() / 1e3
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn draws_valid_reproducible_environments_within_bounds() {
        let bounds = DrawBounds::default();
        bounds.check().unwrap();
        let mut seen = HashSet::new();
        for number in 1..=400 {
            let drawn = bounds.draw(7, number);
            drawn.check().unwrap_or_else(|error| panic!("{number}: {error}"));
            assert_eq!(drawn, bounds.draw(7, number));
            assert_ne!(drawn, bounds.draw(8, number));
            let kinds = [
                drawn.fog_visibility_m > 0.0,
                drawn.cloud.is_some(),
                drawn.rain.is_some(),
                drawn.snow.is_some(),
                drawn.sun.is_some(),
                drawn.lamps.is_some(),
                drawn.own_light.is_some(),
                drawn.flicker.is_some(),
            ];
            seen.insert(kinds);
            assert!((0.18..=1.21).contains(&drawn.light[0]));
            if let Some(rain) = drawn.rain {
                assert!((2.0..=80.0).contains(&rain.rate_mmph) && rain.wind_mps.length() < 4.01);
            }
            // Values survive a conversion to text.
            let text = toml::to_string(&drawn).unwrap();
            assert_eq!(toml::from_str::<EnvironmentConfig>(&text).unwrap(), drawn);
        }
        assert!(seen.len() > 15, "there are many kinds: {}", seen.len());
    }

    #[test]
    fn respects_bounds_and_names_invalid_ones() {
        let narrow: DrawBounds =
            toml::from_str("weathers = [\"rain\"]\nlight = [1, 1]\nrain_mmph = [5, 6]").unwrap();
        narrow.check().unwrap();
        for number in 0..50 {
            let drawn = narrow.draw(1, number);
            assert!((5.0..=6.0).contains(&drawn.rain.unwrap().rate_mmph));
            assert!(drawn.lamps.is_none() && drawn.own_light.is_none());
        }
        let wrong = |text: &str| {
            toml::from_str::<DrawBounds>(text).unwrap().check().unwrap_err().to_string()
        };
        assert!(wrong("light = [1, 0.5]").contains("environments.light"));
        assert!(wrong("visibility_m = [0, 1]").contains("environments.visibility_m"));
        assert!(wrong("rain_mmph = [1, nan]").contains("environments.rain_mmph"));
        assert!(wrong("weathers = []").contains("environments.weathers"));
        assert!(toml::from_str::<DrawBounds>("weathers = [\"hail\"]").is_err());
    }
}
