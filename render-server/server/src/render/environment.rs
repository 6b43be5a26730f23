//! Current light and weather: the arena's, until the page changes them.

use std::sync::Mutex;

use glam::DVec3;
use vizflyt_arena::config::{
    CloudConfig, ConfigError, EnvironmentConfig, FlickerConfig, LampsConfig, OwnLightConfig,
    RainConfig, SnowConfig, SunConfig,
};
use vizflyt_splat::Atmosphere;
use vizflyt_splat::weather::{
    Ball, Cloud, Flicker, LampPlaces, Lamps, MAX_LAMPS, OwnLight, Rain, Snow, Sun, Weather,
};

use vizflyt_process::lock;

/// Current environment of the scene; the render thread reads it once per tick.
#[derive(Debug, Default)]
pub struct Environment(Mutex<EnvironmentConfig>);

impl Environment {
    /// Starts with the arena's settings.
    pub fn new(config: EnvironmentConfig) -> Self {
        Self(Mutex::new(config))
    }

    /// Returns the current settings.
    pub fn now(&self) -> EnvironmentConfig {
        *lock(&self.0)
    }

    /// Changes the settings from the next tick on; returns whether they differ.
    ///
    /// # Errors
    /// Names the key of an invalid number; the settings stay unchanged.
    pub fn change(&self, config: EnvironmentConfig) -> Result<bool, ConfigError> {
        config.check()?;
        Ok(std::mem::replace(&mut *lock(&self.0), config) != config)
    }
}

/// Returns the atmosphere for a renderer.
pub fn atmosphere(config: &EnvironmentConfig) -> Atmosphere {
    Atmosphere {
        light: single(config.light),
        fog_per_m: config.fog_per_m() as f32,
        fog: single(config.fog),
    }
}

/// Returns the weather effects on rendered images.
pub fn weather(config: &EnvironmentConfig) -> Weather {
    Weather {
        exposure_s: (config.exposure_ms * 1e-3) as f32,
        depth_loss: config.depth_loss,
        cloud: config.cloud.as_ref().map(cloud),
        rain: config.rain.map(|RainConfig { rate_mmph, wind_mps, lens_drops }| Rain {
            rate_mmph: rate_mmph as f32,
            wind_mps: wind_mps.as_vec2(),
            lens_drops,
        }),
        snow: config.snow.map(|SnowConfig { rate_mmph, wind_mps }| Snow {
            rate_mmph: rate_mmph as f32,
            wind_mps: wind_mps.as_vec2(),
        }),
        sun: config.sun.map(|sun @ SunConfig { glare, behind_m, .. }| Sun {
            direction: sun.direction(),
            glare: glare as f32,
            color: single(sun.color),
            behind_m: behind_m as f32,
        }),
        lamps: config.lamps.as_ref().map(lamps),
        own_light: config.own_light.map(|OwnLightConfig { reach_m, color, cone_deg }| OwnLight {
            reach_m: reach_m as f32,
            color: single(color),
            cos_cone: cone_deg.to_radians().cos() as f32,
        }),
        flicker: config.flicker.map(|FlickerConfig { mains_hz, depth, readout_ms }| Flicker {
            mains_hz: mains_hz as f32,
            depth: depth as f32,
            readout_s: (readout_ms * 1e-3) as f32,
        }),
    }
}

fn cloud(config: &CloudConfig) -> Cloud {
    let ball = config.center_m.zip(config.radius_m);
    Cloud {
        per_m: config.per_m() as f32,
        color: single(config.color),
        patchiness: config.patchiness as f32,
        patch_m: config.patch_m as f32,
        drift_mps: config.drift_mps.as_vec3(),
        layer_m: config.layer_m.map(|layer_m| layer_m.map(|height_m| height_m as f32)),
        ball: ball.map(|(center_m, radius_m)| Ball { center_m, radius_m: radius_m as f32 }),
    }
}

fn lamps(config: &LampsConfig) -> Lamps {
    let LampsConfig { reach_m, color, height_m, spacing_m, positions_m } = config;
    let places = match positions_m {
        Some(positions) => {
            let mut places_m = [DVec3::NAN; MAX_LAMPS];
            let own = positions.places_m();
            places_m[..own.len()].copy_from_slice(own);
            LampPlaces::At(places_m)
        }
        None => LampPlaces::Grid { height_m: *height_m as f32, spacing_m: *spacing_m as f32 },
    };
    Lamps { reach_m: *reach_m as f32, color: single(*color), places }
}

fn single(color: [f64; 3]) -> [f32; 3] {
    color.map(|value| value as f32)
}
