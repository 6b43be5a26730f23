//! Model of a phone camera: lens, rolling shutter while the phone moves, automatic exposure, and noise. Without I/O and
//! renderer: it returns cameras, takes rendered images, and returns pixels.
//!
//! Data flow per image; [`phone`] has the parameters:
//! ```text
//! Film::camera      camera of each band of rows, with the phone's pose when the band's middle row is exposed
//!   -> a renderer   colour and depth of each band, with a margin
//! Film::take        display colours -> linear light (the caller may draw tags onto it)
//! Meter::next       light -> gain, shutter, ISO: automatic exposure with the lag of a phone
//! Film::develop     each row at its exposure times: path of each pixel through the band during the exposure, from
//!                   depth and exact poses; then vignette, gain, noise, tone curve -> 8 bits
//! ```
//! A row is at most half a band's time plus half an exposure away from the time of its band's rendering, about 8 ms or
//! 4 px. Areas that become visible behind edges in this time are filled from their neighbourhood. `film/tests.rs`
//! compares the result with a rendering of each row at each of its exposure times.

mod develop;
mod meter;
pub mod phone;

use core::ops::Range;

use glam::DVec2;
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};
use vizflyt_splat::imaging::shutter::{Pixel, pixels};
use vizflyt_splat::imaging::tone::Tone;
use vizflyt_splat::{Camera, RgbdImage};

pub use meter::{Exposure, Meter};
pub use phone::Phone;

/// Pose of the phone at a time. [s]
pub type Track<'a> = dyn Fn(f64) -> Pose<World, Cam> + Sync + 'a;

/// Camera model of a phone.
#[derive(Debug)]
pub struct Film {
    phone: Phone,
    bands: Vec<Band>,
    pixels: Vec<Pixel>,
    tone: Tone,
    noise: develop::Noise,
}

/// Band of rows that are rendered together.
#[derive(Clone, Debug, PartialEq)]
pub struct Band {
    /// Rows in the image.
    pub rows: Range<u32>,
    /// Intrinsics for these rows plus a margin on each side.
    pub intrinsics: Intrinsics,
    /// Margin. [px]
    pub margin_px: u32,
}

/// Rendered band in linear light.
#[derive(Clone, Debug, PartialEq)]
pub struct BandImage {
    /// Pose of the rendering.
    pub world_from_cam: Pose<World, Cam>,
    /// Linear light, H x W x 3 of the band's size; 1: the brightest value of the scene file.
    pub light: Vec<f32>,
    /// Median depth along the optical axis, H x W; 0: none. [m, cam]
    pub depth_m: Vec<f32>,
}

impl Default for BandImage {
    fn default() -> Self {
        Self { world_from_cam: Pose::IDENTITY, light: Vec::new(), depth_m: Vec::new() }
    }
}

impl Film {
    /// Prepares the model of a phone.
    pub fn new(phone: Phone) -> Self {
        let bands = bands(&phone);
        let pixels = pixels(&phone.intrinsics);
        Self { phone, bands, pixels, tone: Tone::default(), noise: develop::Noise::new() }
    }

    pub fn phone(&self) -> &Phone {
        &self.phone
    }

    /// Returns the bands, from top to bottom.
    pub fn bands(&self) -> &[Band] {
        &self.bands
    }

    /// Returns the time of a band's rendering: the middle of the exposure of the band's middle row. `middle_s` is the
    /// middle of the exposure of the image's middle row. [s]
    pub fn instant_s(&self, band: &Band, middle_s: f64) -> f64 {
        let row = f64::midpoint(f64::from(band.rows.start), f64::from(band.rows.end));
        self.phone.row_instant_s(row, middle_s)
    }

    /// Returns the camera of a band.
    pub fn camera(&self, band: &Band, track: &Track<'_>, middle_s: f64) -> Camera {
        Camera::new(band.intrinsics, track(self.instant_s(band, middle_s)), NEAR_M)
    }

    /// Converts the rendered image of a band's camera to linear light.
    pub fn take(&self, camera: &Camera, image: &RgbdImage, into: &mut BandImage) {
        into.world_from_cam = camera.world_from_cam;
        into.light.clear();
        into.light.extend(image.rgb.iter().map(|&shown| self.tone.linear(shown)));
        into.depth_m.clone_from(&image.depth_median_m);
    }
}

/// Divides the image into bands, each of which is exposed within [`BAND_S`].
fn bands(phone: &Phone) -> Vec<Band> {
    let k = &phone.intrinsics;
    let count = (phone.readout_s / BAND_S).ceil().clamp(1.0, 16.0) as u32;
    let margin_px = (k.width_px / 32).max(8);
    (0..count.min(k.height_px))
        .map(|n| {
            let rows = n * k.height_px / count..(n + 1) * k.height_px / count;
            let top = f64::from(rows.start) - f64::from(margin_px);
            let intrinsics = Intrinsics {
                width_px: k.width_px + 2 * margin_px,
                height_px: rows.len() as u32 + 2 * margin_px,
                cx_px: k.cx_px + f64::from(margin_px),
                cy_px: k.cy_px - top,
                ..*k
            };
            Band { rows, intrinsics, margin_px }
        })
        .collect()
}

impl Band {
    /// Returns the position of the image's upper left corner in the band. [px]
    fn origin_px(&self) -> DVec2 {
        let margin = f64::from(self.margin_px);
        DVec2::new(margin, margin - f64::from(self.rows.start))
    }
}

/// Maximum readout time of a band: a rotation of 60 degrees per second moves the image by 2 px between the middle and
/// the border of the band. [s]
const BAND_S: f64 = 0.006;
/// Near limit: nothing is nearer to a walker's phone. [m]
const NEAR_M: f32 = 0.05;

#[cfg(test)]
mod tests;
