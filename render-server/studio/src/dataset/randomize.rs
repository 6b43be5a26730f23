//! `--randomize FILE`: what changes from image to image, within bounds. All of it may be left out: then nothing does.
//!
//! Drawn for each image from the data set's seed, the scene and the image's number, so that an image is the same whoever
//! renders it and whenever.

use std::path::Path;

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};
use vizflyt_arena::config::EnvironmentConfig;
use vizflyt_protocol::geometry::Intrinsics;
use vizflyt_scenes::DrawBounds;
use vizflyt_twin::random::Random;

/// The whole file.
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

/// Factors of the scene's own colours.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Light {
    /// Least and greatest, evenly by their logarithm; 0.05 to 4.
    pub(super) brightness: [f64; 2],
    /// Each colour by up to this share more or less; 0 to 0.9.
    pub(super) tint: f64,
}

/// Fog in some of the images.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Fog {
    pub(super) probability: f64,
    /// How far one sees, evenly by its logarithm; 0.5 to 1000. [m]
    pub(super) visibility_m: [f64; 2],
}

/// Colours and patterns of gates in some of the images.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Gates {
    /// That a gate has another texture than its own.
    pub(super) probability: f64,
    /// How many there are of each gate and scene; 1 to 32.
    pub(super) textures: usize,
}

/// Plain solids that float in the free space.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Distractors {
    /// How many at least and at most; up to 64.
    pub(super) count: [usize; 2],
    /// Their greatest side. [m]
    pub(super) size_m: [f64; 2],
}

/// Weather and its light, in the place of `light` and `fog`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct WeatherBounds {
    /// Of an image; 0 to 1.
    pub(super) probability: f64,
    /// What it is drawn from, as `[environments]` of a project has it.
    pub(super) within: DrawBounds,
}

/// Other vehicles that hover in the free space.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Vehicles {
    /// How many at least and at most; up to 64.
    pub(super) count: [usize; 2],
}

/// What differs between cameras of a kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct CameraBounds {
    /// Horizontal field of view in place of --fov; 10 to 150. [deg]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) fov_deg: Option<[f64; 2]>,
    /// The optical axis is up to this share of the image's size beside its middle; 0 to 0.3.
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
    /// Reads a file.
    ///
    /// # Errors
    /// What is wrong with it, by its line or its key.
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
        weather.within.check().context("of [weather.within]")?;
        within("gates.probability", [gates.probability; 2], [0.0, 1.0])?;
        within("gates.textures", [gates.textures as f64; 2], [1.0, 32.0])?;
        within("distractors.count", distractors.count.map(|n| n as f64), [0.0, 64.0])?;
        within("distractors.size_m", distractors.size_m, [0.02, 2.0])?;
        within("vehicles.count", vehicles.count.map(|n| n as f64), [0.0, 64.0])?;
        within("camera.fov_deg", camera.fov_deg.unwrap_or([90.0; 2]), [10.0, 150.0])?;
        within("camera.center", [camera.center; 2], [0.0, 0.3])?;
        Ok(file)
    }

    /// Returns how many textures a gate has beside its own.
    pub(super) fn textures(&self) -> usize {
        if self.gates.probability > 0.0 { self.gates.textures } else { 0 }
    }

    /// Draws light and fog, beside those of the arena.
    pub(super) fn environment(
        &self,
        arena: &EnvironmentConfig,
        random: &mut Random,
    ) -> EnvironmentConfig {
        let weather = &self.weather;
        // Nothing is drawn for what is left out: the rest of the image stays what it was without it.
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
        // Fog is lit as the scene is.
        let lit = |k: usize| (EnvironmentConfig::default().fog[k] * light[k]).clamp(0.0, 1.0);
        let fog = [lit(0), lit(1), lit(2)];
        EnvironmentConfig { light, fog_visibility_m: visibility_m, fog, ..*arena }
    }

    /// Draws the intrinsics of a camera that has these without it.
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

/// Draws a number evenly from a range.
pub(super) fn range(random: &mut Random, [low, high]: [f64; 2]) -> f64 {
    low + (high - low) * f64::from(random.unit())
}

/// Draws a number from a range, evenly by its logarithm.
pub(super) fn log_range(random: &mut Random, bounds: [f64; 2]) -> f64 {
    range(random, bounds.map(f64::ln)).exp()
}

/// Draws a whole number from a range, both ends included.
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
    fn the_guides_example_is_read_and_changes_everything() {
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
    fn draws_are_valid_and_within_their_bounds() {
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
        // One kind of weather of seven is fog, two are wet.
        let [foggy, wet] = [foggy, wet].map(|count| f64::from(count) / 2000.0);
        let weather = file.weather.probability;
        let expected = file.fog.probability * (1.0 - weather) + weather / 7.0;
        assert!((foggy - expected).abs() < 0.04, "{foggy}");
        assert!((wet - weather * 2.0 / 7.0).abs() < 0.04, "{wet}");
    }

    #[test]
    fn bounds_that_cannot_work_are_named() {
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
        fn any_text_is_read_or_refused(text in "(\\[(light|fog|gates|camera)\\]\n)?[a-z_=\\[\\]0-9., \n-]{0,120}") {
            let _ = Randomize::parse(&text);
        }
    }
}
