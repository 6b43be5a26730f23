//! Light and fog: how a scene's colours reach a camera.
//!
//! A splat of colour `c` at distance `d` is seen as `light c t + fog (1 - t)` with `t = exp(-k d)`:
//! Koschmieder's law of 1924, splat by splat, so that a half transparent crown before a far wall is
//! right too. What is behind everything is infinitely far away. Depth and ids are not touched.

use crate::InvalidCamera;

/// The light on a scene, and the air before the camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Atmosphere {
    /// Every colour is multiplied by it, linear RGB; 1 is the light the scene was captured in.
    pub light: [f32; 3],
    /// How much of the light is lost on the way, 0 for clear air: `exp(-k d)` is left. [1/m]
    pub fog_per_m: f32,
    /// What fog looks like where it hides everything, linear RGB.
    pub fog: [f32; 3],
}

impl Atmosphere {
    /// The light of the capture and clear air: nothing is changed.
    pub const CLEAR: Self = Self { light: [1.0; 3], fog_per_m: 0.0, fog: [0.0; 3] };

    /// Whether colours are as in the scene.
    #[must_use]
    pub fn is_clear(&self) -> bool {
        self.light == Self::CLEAR.light && self.fog_per_m == 0.0
    }

    /// Returns what is seen of the background.
    pub(crate) fn background(&self, background: [f32; 3]) -> [f32; 3] {
        if self.fog_per_m > 0.0 {
            return self.fog;
        }
        [0, 1, 2].map(|channel| background[channel] * self.light[channel])
    }

    /// Returns a colour seen from a distance. [m]
    pub(crate) fn attenuate(&self, rgb: [f64; 3], distance_m: f64) -> [f64; 3] {
        let left = (-f64::from(self.fog_per_m) * distance_m).exp();
        [0, 1, 2].map(|channel| {
            let lit = rgb[channel] * f64::from(self.light[channel]);
            let fog = f64::from(self.fog[channel]);
            fog + (lit - fog) * left
        })
    }

    /// Checks that every number is one a renderer can work with.
    pub(crate) fn validate(&self) -> Result<(), InvalidCamera> {
        let numbers = self.light.iter().chain(&self.fog).chain([&self.fog_per_m]);
        if numbers.into_iter().all(|value| (0.0..=100.0).contains(value)) {
            Ok(())
        } else {
            Err(InvalidCamera::Atmosphere(*self))
        }
    }
}

impl Default for Atmosphere {
    fn default() -> Self {
        Self::CLEAR
    }
}
