//! Automatic exposure: gain, shutter and ISO from the light of the image, with the lag of a phone.

use vizflyt_splat::imaging::exposure::Follow;

use super::phone::LEAST_ISO;
use super::{Band, BandImage, Phone};

/// Exposure of an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// Factor on linear light before the tone curve.
    pub gain: f64,
    /// Exposure time of each row. [s]
    pub shutter_s: f64,
    /// Gain of the sensor.
    pub iso: f64,
}

/// Automatic exposure control.
#[derive(Clone, Debug, Default)]
pub struct Meter {
    gain: Follow,
}

impl Meter {
    /// Returns the exposure of an image `dt_s` after the last one, from the light of its bands. The first image has the
    /// exact exposure.
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
    /// Returns the exposure of a phone for a gain: the longest shutter without flicker under lamps, and the ISO for it.
    /// In bright light, it uses the minimum ISO and a shorter shutter.
    pub fn of(phone: &Phone, gain: f64) -> Self {
        // Incident light: N^2 / t = E S / C (ISO 2720:1974, annex), at gain 1.
        let iso_s = gain * F_NUMBER * F_NUMBER * INCIDENT / phone.illuminance_lx;
        let iso = (iso_s / LONGEST_S).clamp(LEAST_ISO, MOST_ISO);
        Self { gain, shutter_s: (iso_s / iso).min(LONGEST_S), iso }
    }
}

/// Returns the centre-weighted mean light of an image, as phones measure it.
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

/// Target for the mean linear light: 1.5 times the 18 % of a grey card, as phones show rooms with windows.
const AIM: f64 = 0.27;
/// Minimum and maximum gain.
const LEAST: f64 = 0.35;
const MOST: f64 = 3.0;
/// Time constant of the control: a phone's exposure settles within about a second. [s]
const LAG_S: f64 = 0.35;
/// F-number of phones' main cameras.
const F_NUMBER: f64 = 1.8;
/// Calibration constant C of incident light meters.
const INCIDENT: f64 = 250.0;
/// Maximum exposure time: one period of lamps that flicker at 100 Hz. [s]
const LONGEST_S: f64 = 0.01;
const MOST_ISO: f64 = 1600.0;
/// Distance between the measured pixels. [px]
const STRIDE: usize = 8;
