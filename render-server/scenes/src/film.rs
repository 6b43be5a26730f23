//! What a phone makes of a rendered place: a lens, an exposure that rolls over the rows while the phone moves, an automatic
//! exposure, and noise. Sans-IO and without a renderer: cameras out, rendered images in, pixels out.
//!
//! Data flow per image, of which [`phone`] has the figures:
//! ```text
//! Film::cameras     one camera per band of rows, where the phone is when the band's middle row is exposed
//!   -> a renderer   colour and depth of each band, with a margin
//! Film::take        display colours -> linear light (the caller may lay ink onto it)
//! Meter::next       the light -> gain, shutter, ISO: the automatic exposure, which lags as a phone's does
//! Film::develop     every row from its own instants: each pixel's path through the band while the row is exposed, by
//!                   depth and by the exact poses; then vignette, gain, noise, tone curve -> 8 bits
//! ```
//! A row is at most half a band's time and half an exposure from where its band was rendered, some 8 ms or 4 px: what opens behind
//! edges in that time is filled from beside it. `film/tests.rs` holds this against every row rendered at each of its instants.

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

/// Where the phone is at an instant. [s]
pub type Track<'a> = dyn Fn(f64) -> Pose<World, Cam> + Sync + 'a;

/// Films with one phone.
#[derive(Debug)]
pub struct Film {
    phone: Phone,
    bands: Vec<Band>,
    pixels: Vec<Pixel>,
    tone: Tone,
    noise: develop::Noise,
}

/// Rows that are rendered together.
#[derive(Clone, Debug, PartialEq)]
pub struct Band {
    /// Rows of the image.
    pub rows: Range<u32>,
    /// The same lens, onto these rows and a margin on every side.
    pub intrinsics: Intrinsics,
    /// Width of the margin. [px]
    pub margin_px: u32,
}

/// What a band saw, in linear light.
#[derive(Clone, Debug, PartialEq)]
pub struct BandImage {
    /// Where it was seen from.
    pub world_from_cam: Pose<World, Cam>,
    /// Linear light, H x W x 3 of the band's own size; 1 is the brightest that the scene's file shows.
    pub light: Vec<f32>,
    /// Median camera-z depth, H x W; 0 where nothing is. [m, cam]
    pub depth_m: Vec<f32>,
}

impl Default for BandImage {
    fn default() -> Self {
        Self { world_from_cam: Pose::IDENTITY, light: Vec::new(), depth_m: Vec::new() }
    }
}

impl Film {
    /// Prepares for a phone.
    pub fn new(phone: Phone) -> Self {
        let bands = bands(&phone);
        let pixels = pixels(&phone.intrinsics);
        Self { phone, bands, pixels, tone: Tone::default(), noise: develop::Noise::new() }
    }

    /// Returns the phone.
    pub fn phone(&self) -> &Phone {
        &self.phone
    }

    /// Returns the bands, from the top.
    pub fn bands(&self) -> &[Band] {
        &self.bands
    }

    /// Returns when a band is to be rendered: at the middle of its middle rows' exposure, for an image whose middle row's is
    /// at `middle_s`. [s]
    pub fn instant_s(&self, band: &Band, middle_s: f64) -> f64 {
        let row = f64::midpoint(f64::from(band.rows.start), f64::from(band.rows.end));
        self.phone.row_instant_s(row, middle_s)
    }

    /// Returns the camera of a band.
    pub fn camera(&self, band: &Band, track: &Track<'_>, middle_s: f64) -> Camera {
        Camera::new(band.intrinsics, track(self.instant_s(band, middle_s)), NEAR_M)
    }

    /// Takes what was rendered for a band's camera.
    pub fn take(&self, camera: &Camera, image: &RgbdImage, into: &mut BandImage) {
        into.world_from_cam = camera.world_from_cam;
        into.light.clear();
        into.light.extend(image.rgb.iter().map(|&shown| self.tone.linear(shown)));
        into.depth_m.clone_from(&image.depth_median_m);
    }
}

/// Cuts the image into bands that are exposed within [`BAND_S`] each.
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
    /// Returns where the image's upper left corner is in the band's. [px]
    fn origin_px(&self) -> DVec2 {
        let margin = f64::from(self.margin_px);
        DVec2::new(margin, margin - f64::from(self.rows.start))
    }
}

/// Longest time over which a band's rows are exposed: a hand's turn of 60 degrees a second moves what it sees by 2 px from the
/// band's middle to its border. [s]
const BAND_S: f64 = 0.006;
/// Nothing is nearer to a walker's phone. [m]
const NEAR_M: f32 = 0.05;

#[cfg(test)]
mod tests;
