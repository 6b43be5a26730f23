//! `--randomize FILE`: bounds of the random changes from image to image. All keys are optional; without them, nothing
//! changes.
//!
//! The values of an image only depend on the data set's seed, the scene and the image's number, so that images are
//! reproducible.

use std::path::Path;

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};
use vizflyt_arena::config::EnvironmentConfig;
use vizflyt_protocol::geometry::Intrinsics;
use vizflyt_scenes::DrawBounds;
use vizflyt_twin::random::Random;

/// Content of the file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Randomize {
    pub(super) light: Light,
    pub(super) fog: Fog,
    pub(super) weather: WeatherBounds,
    pub(super) gates: Gates,
    pub(super) distractors: Distractors,
    pub(super) vehicles: Vehicles,
    pub(super) camera: CameraBounds,
}

/// Factors on the scene's colours.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Light {
    /// Minimum and maximum brightness, log-uniform; 0.05 to 4.
    pub(super) brightness: [f64; 2],
    /// Maximum relative change of each colour channel; 0 to 0.9.
    pub(super) tint: f64,
}

/// Fog in some of the images.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Fog {
    pub(super) probability: f64,
    /// Range of the visibility, log-uniform; 0.5 to 1000. [m]
    pub(super) visibility_m: [f64; 2],
}

/// Colours and patterns of gates in some of the images.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Gates {
    /// Probability that a gate has a random texture.
    pub(super) probability: f64,
    /// Number of random textures for each gate and scene; 1 to 32.
    pub(super) textures: usize,
}

/// Plain solids in the free space.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Distractors {
    /// Minimum and maximum number; up to 64.
    pub(super) count: [usize; 2],
    /// Range of the largest side. [m]
    pub(super) size_m: [f64; 2],
}

/// Weather with its light, instead of `light` and `fog`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct WeatherBounds {
    /// Probability per image; 0 to 1.
    pub(super) probability: f64,
    /// Bounds of the weather, as in `[environments]` of a project.
    pub(super) within: DrawBounds,
}

/// Other vehicles in the free space.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Vehicles {
    /// Minimum and maximum number; up to 64.
    pub(super) count: [usize; 2],
}

/// Variation of the intrinsics.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct CameraBounds {
    /// Horizontal field of view instead of --fov; 10 to 150. [deg]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) fov_deg: Option<[f64; 2]>,
    /// Maximum offset of the principal point from the centre, relative to the image size; 0 to 0.3.
    pub(super) center: f64,
}

impl Default for Light {
    fn default() -> Self {
        Self { brightness: [1.0; 2], tint: 0.0 }
    }
}

impl Default for Fog {
    fn default() -> Self {
        Self { probability: 0.0, visibility_m: [8.0, 40.0] }
    }
}

impl Default for Gates {
    fn default() -> Self {
        Self { probability: 0.0, textures: 6 }
    }
}

impl Default for Distractors {
    fn default() -> Self {
        Self { count: [0; 2], size_m: [0.1, 0.4] }
    }
}

impl Randomize {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// The file is invalid; the message includes the line or the key.
    pub(super) fn read(path: &Path) -> Result<Self> {
        let context = || format!("cannot use {} as --randomize", path.display());
        let text = std::fs::read_to_string(path).with_context(context)?;
        Self::parse(&text).with_context(context)
    }

    fn parse(text: &str) -> Result<Self> {
        let file: Self = vizflyt_toml::parse(text)?;
        let Self { light, fog, weather, gates, distractors, vehicles, camera } = &file;
        within("light.brightness", light.brightness, [0.05, 4.0])?;
        within("light.tint", [light.tint; 2], [0.0, 0.9])?;
        within("fog.probability", [fog.probability; 2], [0.0, 1.0])?;
        within("fog.visibility_m", fog.visibility_m, [0.5, 1000.0])?;
        within("weather.probability", [weather.probability; 2], [0.0, 1.0])?;
        weather.within.check().context("in [weather.within]")?;
        within("gates.probability", [gates.probability; 2], [0.0, 1.0])?;
        within("gates.textures", [gates.textures as f64; 2], [1.0, 32.0])?;
        within("distractors.count", distractors.count.map(|n| n as f64), [0.0, 64.0])?;
        within("distractors.size_m", distractors.size_m, [0.02, 2.0])?;
        within("vehicles.count", vehicles.count.map(|n| n as f64), [0.0, 64.0])?;
        within("camera.fov_deg", camera.fov_deg.unwrap_or([90.0; 2]), [10.0, 150.0])?;
        within("camera.center", [camera.center; 2], [0.0, 0.3])?;
        Ok(file)
    }

    /// Returns the number of random textures of a gate.
    pub(super) fn textures(&self) -> usize {
        if self.gates.probability > 0.0 { self.gates.textures } else { 0 }
    }

    /// Draws light, fog or weather, applied to the environment of the arena.
    pub(super) fn environment(
        &self,
        arena: &EnvironmentConfig,
        random: &mut Random,
    ) -> EnvironmentConfig {
        let weather = &self.weather;
        // Without weather, no random number is drawn here, so that the rest of the image stays the same.
        if weather.probability > 0.0 && f64::from(random.unit()) < weather.probability {
            return weather.within.draw(random.bits(), 0);
        }
        let brightness = log_range(random, self.light.brightness);
        let tint = self.light.tint;
        let light = arena.light.map(|light| {
            (light * brightness * range(random, [1.0 - tint, 1.0 + tint])).clamp(0.0, 4.0)
        });
        let is_foggy = f64::from(random.unit()) < self.fog.probability;
        let visibility_m = log_range(random, self.fog.visibility_m);
        if !is_foggy {
            return EnvironmentConfig { light, ..*arena };
        }
        // The scene's light also applies to fog.
        let lit = |k: usize| (EnvironmentConfig::default().fog[k] * light[k]).clamp(0.0, 1.0);
        let fog = [lit(0), lit(1), lit(2)];
        EnvironmentConfig { light, fog_visibility_m: visibility_m, fog, ..*arena }
    }

    /// Draws intrinsics around the given ones.
    pub(super) fn intrinsics(&self, plain: Intrinsics, random: &mut Random) -> Intrinsics {
        let (width, height) = (plain.width_px, plain.height_px);
        let mut drawn = plain;
        if let Some(fov_deg) = self.camera.fov_deg {
            let fov_rad = range(random, fov_deg).to_radians();
            drawn = Intrinsics::from_horizontal_fov(width, height, fov_rad);
        }
        let share = self.camera.center;
        drawn.cx_px += f64::from(width) * range(random, [-share, share]);
        drawn.cy_px += f64::from(height) * range(random, [-share, share]);
        drawn
    }
}

/// Draws a number from a range, uniformly.
pub(super) fn range(random: &mut Random, [low, high]: [f64; 2]) -> f64 {
    low + (high - low) * f64::from(random.unit())
}

/// Draws a number from a range, log-uniformly.
pub(super) fn log_range(random: &mut Random, bounds: [f64; 2]) -> f64 {
    range(random, bounds.map(f64::ln)).exp()
}

/// Draws an integer from a range, both ends included.
pub(super) fn count(random: &mut Random, [least, most]: [usize; 2]) -> usize {
    least + random.below(most - least + 1)
}

fn within(key: &str, [low, high]: [f64; 2], [least, most]: [f64; 2]) -> Result<()> {
    let is_good = least <= low && low <= high && high <= most;
    let value = if low == high { format!("{low}") } else { format!("[{low}, {high}]") };
    ensure!(is_good, "{key} = {value}: give numbers from {least} to {most}, the smaller one first");
    Ok(())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const EXAMPLE: &str = include_str!("../../../../docs/guides/randomize.toml");

    #[test]
    fn the_example_of_the_guide_uses_all_tables() {
        let file = Randomize::parse(EXAMPLE).unwrap();
        let still = Randomize::default();
        assert!(file.light != still.light && file.fog != still.fog && file.gates != still.gates);
        assert!(file.distractors != still.distractors && file.vehicles != still.vehicles);
        assert!(file.camera != still.camera && file.textures() > 0);
        assert!(file.weather != still.weather);
    }

    #[test]
    fn nothing_changes_without_a_file() {
        let (still, mut random) = (Randomize::parse("").unwrap(), Random::new(3));
        let arena = EnvironmentConfig::named("night-fog").unwrap();
        let drawn = still.environment(&arena, &mut random);
        assert!(drawn.light.iter().zip(arena.light).all(|(a, b)| (a - b).abs() < 1e-12));
        assert_eq!((drawn.fog, drawn.fog_visibility_m), (arena.fog, arena.fog_visibility_m));
        let plain = Intrinsics::from_horizontal_fov(320, 240, 1.2);
        assert_eq!(still.intrinsics(plain, &mut random), plain);
    }

    #[test]
    fn draws_valid_values_within_the_bounds() {
        let file = Randomize::parse(EXAMPLE).unwrap();
        let plain = Intrinsics::from_horizontal_fov(320, 240, 1.2);
        let (mut foggy, mut wet) = (0, 0);
        for n in 0..2000 {
            let mut random = Random::stream(1, n);
            let drawn = file.environment(&EnvironmentConfig::default(), &mut random);
            drawn.check().unwrap();
            foggy += u32::from(drawn.fog_visibility_m > 0.0);
            wet += u32::from(drawn.rain.is_some() || drawn.snow.is_some());
            let k = file.intrinsics(plain, &mut random);
            k.validate().unwrap();
            assert!((k.cx_px - 160.0).abs() <= 320.0 * file.camera.center);
            assert!(
                (file.distractors.count[0]..=file.distractors.count[1])
                    .contains(&count(&mut random, file.distractors.count))
            );
        }
        // One of seven kinds of weather is fog, and two are wet.
        let [foggy, wet] = [foggy, wet].map(|count| f64::from(count) / 2000.0);
        let weather = file.weather.probability;
        let expected = file.fog.probability * (1.0 - weather) + weather / 7.0;
        assert!((foggy - expected).abs() < 0.04, "{foggy}");
        assert!((wet - weather * 2.0 / 7.0).abs() < 0.04, "{wet}");
    }

    #[test]
    fn errors_name_the_invalid_bounds() {
        for (text, told) in [
            ("[light]\nbrightness = [2, 1]", "light.brightness = [2, 1]"),
            ("[fog]\nprobability = 1.5", "fog.probability = 1.5"),
            ("[fog]\nvisibility_m = [nan, 3]", "fog.visibility_m"),
            ("[weather]\nprobability = 2", "weather.probability = 2"),
            ("[weather.within]\nrain_mmph = [9, 1]", "environments.rain_mmph"),
            ("[gates]\ntextures = 0", "gates.textures = 0"),
            ("[camera]\nfov_deg = [5, 90]", "camera.fov_deg"),
            ("[cam]\nfov_deg = [5, 90]", "cam"),
        ] {
            let error = format!("{:#}", Randomize::parse(text).unwrap_err());
            assert!(error.contains(told), "{text}: {error}");
        }
    }

    proptest! {
        #[test]
        fn never_panics_on_any_text(text in "(\\[(light|fog|gates|camera)\\]\n)?[a-z_=\\[\\]0-9., \n-]{0,120}") {
            let _ = Randomize::parse(&text);
        }
    }
}
