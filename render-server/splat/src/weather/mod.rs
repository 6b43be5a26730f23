//! Weather and light between a scene and a camera, applied to the image of any renderer.
//!
//! ```text
//! image (RGB, alpha, depth), camera, instant, seed, weather -> the image in that weather
//!   rays      slopes of a coarse grid of pixels        cloud     integrals of density along them
//!   light     lamps, own light, flicker, on surfaces   rain snow particles   streaks of near ones
//!   per row:  light -> cloud and veil by depth -> streaks in front of farther surfaces -> glare
//!   lens      drops on the lens, over the complete image
//! ```
//! The result depends only on the arguments. It has the same bits for any number of threads and any
//! kind of processor, because no library's exponential is called per pixel. The pass is applied
//! after rendering, so both renderers are independent of it. It uses depths instead of splats: for
//! half-transparent surfaces, the mean depth.
//!
//! Perfect depth, alpha and ids are unchanged. With [`Weather::depth_loss`], a depth camera loses
//! returns in absorbing air, on the way there and back: with probability `1 - exp(-2 k d)`.
//!
//! Budget on two cores, 320x240: 1 ms for a cloud, 1 ms for rain or snow, 0.3 ms for light. Cost is
//! bounded by the pixels, the cloud's 30 k samples of noise, and at most 8 k particles in view.
//! Nothing is allocated once every buffer was used.

mod cloud;
mod exp;
mod flicker;
mod glare;
mod lens;
mod light;
mod particles;
mod rain;
mod random;
mod rays;
mod rows;
mod snow;

use glam::{DVec3, Vec3};

pub use cloud::{Ball, Cloud};
pub use flicker::Flicker;
pub use glare::Sun;
pub use light::{LEAST_LIGHT, LampPlaces, Lamps, MAX_LAMPS, OwnLight};
pub use rain::Rain;
pub use snow::Snow;

use crate::{Camera, RgbdImage};
use cloud::CloudPass;
use glare::Glare;
use lens::LensPass;
use light::{Illumination, RowLight};
use particles::{ParticlePass, Scene};
use rays::Rays;
use rows::{RowPass, Rows};

/// Weather and light between a scene and its cameras, in addition to [`crate::Atmosphere`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weather {
    /// Exposure time, for streaks and flicker. [s]
    pub exposure_s: f32,
    /// Whether depth cameras lose returns in absorbing air.
    pub depth_loss: bool,
    /// Cloud of smoke, dust or patchy fog.
    pub cloud: Option<Cloud>,
    /// Rain in the air and on the lens.
    pub rain: Option<Rain>,
    /// Snow in the air.
    pub snow: Option<Snow>,
    /// Low sun that causes glare.
    pub sun: Option<Sun>,
    /// Lamps in the scene.
    pub lamps: Option<Lamps>,
    /// A lamp on the vehicle.
    pub own_light: Option<OwnLight>,
    /// Flicker of the scene's light and its lamps.
    pub flicker: Option<Flicker>,
}

impl Weather {
    /// Clear weather: images are unchanged.
    pub const CLEAR: Self = Self {
        exposure_s: 0.005,
        depth_loss: false,
        cloud: None,
        rain: None,
        snow: None,
        sun: None,
        lamps: None,
        own_light: None,
        flicker: None,
    };

    /// Returns whether images are unchanged.
    pub fn is_clear(&self) -> bool {
        let Self { depth_loss, exposure_s, .. } = *self;
        *self == Self { exposure_s, ..Self::CLEAR } && !depth_loss
    }

    /// Returns the total extinction by rain and snow. [1/m]
    fn veil_per_m(&self) -> f32 {
        let rain = self.rain.map_or(0.0, |rain| rain.extinction_per_m());
        let snow = self.snow.map_or(0.0, |snow| snow.extinction_per_m());
        (rain + snow) as f32
    }
}

impl Default for Weather {
    fn default() -> Self {
        Self::CLEAR
    }
}

/// Instant of an image, with the motion of the camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Moment {
    /// Instant of the image, on any clock. [ns]
    pub at_ns: i64,
    /// Velocity of the camera. [m/s, world]
    pub v_world_mps: DVec3,
    /// Seed of random positions: the same for all images of a flight.
    pub seed: u64,
}

/// Applies weather to images, and reuses its buffers.
#[derive(Debug, Default)]
pub struct WeatherPass {
    rays: Rays,
    cloud: CloudPass,
    particles: ParticlePass,
    rows: RowPass,
    lens: LensPass,
}

impl WeatherPass {
    /// Applies `weather` to the image that `camera` has of a scene.
    ///
    /// # Panics
    /// If the size of the image differs from that of the camera.
    pub fn apply(
        &mut self,
        weather: &Weather,
        camera: &Camera,
        moment: &Moment,
        image: &mut RgbdImage,
    ) {
        if weather.is_clear() {
            return;
        }
        let size = [image.width_px as usize, image.height_px as usize];
        let k = &camera.intrinsics;
        assert_eq!(
            [k.width_px, k.height_px],
            [image.width_px, image.height_px],
            "the camera's image"
        );
        let at_s = moment.at_ns as f64 * 1e-9;
        self.rays.follow(k);
        if let Some(cloud) = &weather.cloud {
            self.cloud.follow(cloud, moment.seed, at_s, camera, &self.rays);
        }
        let illumination = Illumination::new(weather.lamps, weather.own_light, camera);
        let light = RowLight {
            flicker: weather.flicker,
            at_ns: moment.at_ns,
            exposure_s: weather.exposure_s,
            height: size[1],
        };
        self.fall(weather, camera, moment, (&illumination, light.of(size[1] / 2)), image);
        let is_lit =
            weather.lamps.is_some() || weather.own_light.is_some() || weather.flicker.is_some();
        let rows = Rows {
            width: size[0],
            seed: moment.seed ^ moment.at_ns as u64,
            atmosphere: camera.atmosphere,
            rays: &self.rays,
            cloud: weather.cloud.as_ref().map(|cloud| (&self.cloud, *cloud)),
            veil_per_m: weather.veil_per_m(),
            illumination: is_lit.then_some((illumination, light)),
            particles: &self.particles,
            glare: weather.sun.and_then(|sun| Glare::of(&sun, camera, image)),
            depth_loss: weather.depth_loss,
        };
        self.rows.run(&rows, image);
        if let Some(Rain { lens_drops, .. }) = weather.rain
            && lens_drops > 0
        {
            self.lens.draw(lens_drops, moment.seed, at_s, size, &mut image.rgb);
        }
    }

    /// Computes the streaks of drops and flakes, lit by the scene and its lamps.
    fn fall(
        &mut self,
        weather: &Weather,
        camera: &Camera,
        moment: &Moment,
        (illumination, flicker): (&Illumination, f32),
        image: &RgbdImage,
    ) {
        self.particles.clear();
        if let Some(rain) = &weather.rain {
            self.particles.add(RAIN, rain.kinds());
        }
        if let Some(snow) = &weather.snow {
            self.particles.add(SNOW, snow.kinds());
        }
        if weather.rain.is_none() && weather.snow.is_none() {
            return;
        }
        let scene = Scene {
            camera,
            rays: &self.rays,
            v_world_mps: moment.v_world_mps,
            exposure_s: f64::from(weather.exposure_s),
            at_s: moment.at_ns as f64 * 1e-9,
            seed: moment.seed,
        };
        let around = mean_of(image).map(|value| value * DROP_BRIGHTNESS);
        let white = camera.atmosphere.light.map(|light| light * FLAKE_WHITE);
        self.particles.fall(&scene, |group, p_cam_m| {
            let gain = illumination.gain(p_cam_m, flicker);
            let color = if group == RAIN { around } else { white };
            [0, 1, 2].map(|c| (color[c] * gain[c]).min(BRIGHTEST))
        });
    }
}

/// Groups of particles, which select their random numbers and colours.
const RAIN: u32 = 0;
const SNOW: u32 = 1;
/// Brightness of a drop relative to the image's mean, as a display value: five times the light. A
/// drop shows its complete surroundings, of which the brightest part (sky or lamps) is above the
/// view of the camera.
const DROP_BRIGHTNESS: f32 = 2.24;
/// Display value of fresh snow in the light of the capture.
const FLAKE_WHITE: f32 = 0.92;
/// Maximum display value of a streak. A sensor is saturated at 1; a brighter streak is visible in
/// front of a dark wall.
const BRIGHTEST: f32 = 1.5;

/// Returns the mean colour of a sample of pixels. Non-finite pixels are ignored.
fn mean_of(image: &RgbdImage) -> [f32; 3] {
    let (mut sum, mut count) = (Vec3::ZERO, 0.0);
    for pixel in image.rgb.chunks_exact(3).step_by(97) {
        let pixel = Vec3::from_slice(pixel);
        if pixel.is_finite() {
            sum += pixel.clamp(Vec3::ZERO, Vec3::ONE);
            count += 1.0;
        }
    }
    (sum / f32::max(count, 1.0)).to_array()
}

#[cfg(test)]
mod tests;
