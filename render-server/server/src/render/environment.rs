//! The light and the fog of this moment: the arena's, until the page changes them.

use std::sync::Mutex;

use vizflyt_arena::config::{ConfigError, EnvironmentConfig};
use vizflyt_splat::Atmosphere;

use crate::lock::lock;

/// What cameras see the scene through; the render thread asks once a tick.
#[derive(Debug, Default)]
pub struct Environment(Mutex<EnvironmentConfig>);

impl Environment {
    /// Begins with the arena's.
    pub fn new(config: EnvironmentConfig) -> Self {
        Self(Mutex::new(config))
    }

    /// Returns the one of this moment.
    pub fn now(&self) -> EnvironmentConfig {
        *lock(&self.0)
    }

    /// Changes it from the next tick on; returns whether it was another.
    ///
    /// # Errors
    /// A number that cannot work, by its key; nothing is changed.
    pub fn change(&self, config: EnvironmentConfig) -> Result<bool, ConfigError> {
        config.check()?;
        Ok(std::mem::replace(&mut *lock(&self.0), config) != config)
    }
}

/// Returns what a renderer takes.
pub fn atmosphere(config: &EnvironmentConfig) -> Atmosphere {
    Atmosphere {
        light: config.light.map(|value| value as f32),
        fog_per_m: config.fog_per_m() as f32,
        fog: config.fog.map(|value| value as f32),
    }
}
