//! The automatic exposure: how bright the image is to be, by which shutter and ISO, and with which lag.

use vizflyt_splat::imaging::exposure::Follow;

use super::phone::LEAST_ISO;
use super::{Band, BandImage, Phone};

/// How one image is exposed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// What linear light is multiplied by before the tone curve.
    pub gain: f64,
    /// How long each row is exposed. [s]
    pub shutter_s: f64,
    /// The sensor's gain.
    pub iso: f64,
}

/// Follows the light.
#[derive(Clone, Debug, Default)]
pub struct Meter {
    gain: Follow,
}

impl Meter {
    /// Returns the exposure of an image `dt_s` after the last one, by what its bands see; the first is exposed right.
    pub fn next(
        &mut self,
        phone: &Phone,
        bands: &[Band],
        images: &[BandImage],
        dt_s: f64,
    ) -> Exposure {
        let wanted = AIM / mean_light(bands, images).max(1e-6);
        Exposure::of(phone, self.gain.next(wanted, [LEAST, MOST], LAG_S, dt_s))
    }
}

impl Exposure {
    /// Returns how a phone exposes for a gain: with the longest shutter that does not flicker under lamps, and the ISO that it
    /// needs; in bright light with the least ISO and a shorter shutter.
    pub fn of(phone: &Phone, gain: f64) -> Self {
        // Incident light: N^2 / t = E S / C (ISO 2720:1974, annex), of what shows as it is.
        let iso_s = gain * F_NUMBER * F_NUMBER * INCIDENT / phone.illuminance_lx;
        let iso = (iso_s / LONGEST_S).clamp(LEAST_ISO, MOST_ISO);
        Self { gain, shutter_s: (iso_s / iso).min(LONGEST_S), iso }
    }
}

/// Mean light of an image, the middle counting more, as phones do.
fn mean_light(bands: &[Band], images: &[BandImage]) -> f64 {
    let (mut sum, mut weights) = (0.0, 0.0);
    let height = bands.last().map_or(1, |band| band.rows.end);
    for (band, image) in bands.iter().zip(images) {
        let width = band.intrinsics.width_px;
        for row in band.rows.clone().step_by(STRIDE) {
            let y = row - band.rows.start + band.margin_px;
            for column in (band.margin_px..width - band.margin_px).step_by(STRIDE) {
                let at = 3 * (y * width + column) as usize;
                let [red, green, blue] = [0, 1, 2].map(|c| f64::from(image.light[at + c]));
                let u = f64::from(column) / f64::from(width) - 0.5;
                let v = f64::from(row) / f64::from(height) - 0.5;
                let weight = 1.0 - 1.2 * (u * u + v * v);
                // Luminance of ITU-R BT.709.
                sum += weight * (0.2126 * red + 0.7152 * green + 0.0722 * blue);
                weights += weight;
            }
        }
    }
    if weights > 0.0 { sum / weights } else { AIM }
}

/// Mean linear light that is aimed at: a grey card's 18 % and half as much again, as phones show rooms with windows.
const AIM: f64 = 0.27;
/// Least and greatest gain.
const LEAST: f64 = 0.35;
const MOST: f64 = 3.0;
/// How slowly it follows: a phone's exposure settles within about a second. [s]
const LAG_S: f64 = 0.35;
/// Of phones' main cameras.
const F_NUMBER: f64 = 1.8;
/// The constant of incident light meters.
const INCIDENT: f64 = 250.0;
/// A hundredth: lamps flicker at 100 Hz or are not seen to. [s]
const LONGEST_S: f64 = 0.01;
const MOST_ISO: f64 = 1600.0;
/// Every so many pixels are looked at.
const STRIDE: usize = 8;
