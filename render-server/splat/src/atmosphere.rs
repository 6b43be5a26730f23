//! Light and fog: colours of the scene as a camera sees them.
//!
//! A splat of colour `c` at distance `d` is rendered as `light c t + fog (1 - t)` with `t = exp(-k d)` (Koschmieder's
//! law, 1924). It is applied splat by splat, so that a half-transparent crown before a far wall is also correct. The
//! background is infinitely far away. Depth and ids do not change.

use crate::InvalidCamera;

/// Light on a scene, and the air between scene and camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Atmosphere {
    /// Factor of every colour, linear RGB; 1 is the light of the capture.
    pub light: [f32; 3],
    /// Extinction coefficient k of the fog; 0 is clear air. After a distance d, `exp(-k d)` of the light is left.
    /// [1/m]
    pub fog_per_m: f32,
    /// Colour of fog so dense that it hides everything, linear RGB.
    pub fog: [f32; 3],
}

impl Atmosphere {
    /// Light of the capture and clear air: colours do not change.
    pub const CLEAR: Self = Self { light: [1.0; 3], fog_per_m: 0.0, fog: [0.0; 3] };

    /// Whether light and fog leave all colours unchanged.
    #[must_use]
    pub fn is_clear(&self) -> bool {
        self.light == Self::CLEAR.light && self.fog_per_m == 0.0
    }

    /// Returns the background's colour after light and fog.
    pub(crate) fn background(&self, background: [f32; 3]) -> [f32; 3] {
        if self.fog_per_m > 0.0 {
            return self.fog;
        }
        [0, 1, 2].map(|channel| background[channel] * self.light[channel])
    }

    /// Returns a colour after light and fog at a distance. [m]
    pub(crate) fn attenuate(&self, rgb: [f64; 3], distance_m: f64) -> [f64; 3] {
        let left = (-f64::from(self.fog_per_m) * distance_m).exp();
        [0, 1, 2].map(|channel| {
            let lit = rgb[channel] * f64::from(self.light[channel]);
            let fog = f64::from(self.fog[channel]);
            fog + (lit - fog) * left
        })
    }

    /// Checks that all values are within 0 to 100.
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
