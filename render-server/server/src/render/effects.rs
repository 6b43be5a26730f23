//! What happens to an image between the scene and whoever gets it: the one place for the render thread, graded flights
//! and pictures written as files.
//!
//! ```text
//! rasterised image, its camera, its moment, the environment -> the image as it is sent, graded, written
//! ```
//! In the order of the light's way: weather first. A function of its arguments: it reads no clock.

use vizflyt_arena::config::EnvironmentConfig;
use vizflyt_splat::weather::{Shot, WeatherPass};
use vizflyt_splat::{Camera, RgbdImage};

use super::environment::weather;

/// The buffers of all effects, used again from image to image.
#[derive(Debug, Default)]
pub struct Effects {
    weather: WeatherPass,
}

impl Effects {
    /// Applies them to one image; in an environment that has none it stays as it is, bit for bit.
    pub fn apply(
        &mut self,
        environment: &EnvironmentConfig,
        camera: &Camera,
        shot: &Shot,
        image: &mut RgbdImage,
    ) {
        self.weather.apply(&weather(environment), camera, shot, image);
    }
}
