//! Photon noise and read noise by the linear model of EMVA 1288 (release 3.1, section 2): a pixel with `mu` expected
//! electrons has the variance `mu + read^2` electrons, is limited by its full well, and is rounded to the numbers of
//! the converter:
//!
//! ```text
//! mean  = K mu              K: numbers of the converter per electron
//! var   = K^2 (read^2 + mu) + 1/12
//! ```
//! The Poisson distribution of photons is approximated by a normal distribution of the same variance, which is
//! accurate from about ten electrons on.
//!
//! Random numbers are hashes of (seed, camera, image, pixel): they do not depend on the order of pixels or the number
//! of threads.

use std::sync::LazyLock;

use vizflyt_protocol::random::{GOLDEN, mix};

/// Seed of the random numbers of one image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NoiseKey(u64);

impl NoiseKey {
    /// Creates the key of an image; `seq` counts the images of a camera in a flight.
    pub fn new(seed: u64, camera: u64, seq: u64) -> Self {
        Self(mix(mix(mix(seed.wrapping_add(GOLDEN)) ^ camera).wrapping_add(GOLDEN) ^ seq))
    }

    /// Returns a key for another use in the same image.
    #[must_use]
    pub(super) fn stream(self, stream: u64) -> Self {
        Self(mix(self.0 ^ stream.wrapping_mul(GOLDEN)))
    }

    /// Returns the random bits of a pixel.
    #[inline]
    pub(super) fn bits(self, pixel: usize) -> u64 {
        mix(self.0.wrapping_add((pixel as u64).wrapping_mul(GOLDEN)))
    }
}

/// Table of standard normal numbers, indexed by random bits.
#[derive(Clone, Copy, Debug)]
pub(super) struct Normals(&'static [f32; NORMALS]);

impl Normals {
    pub(super) fn table() -> Self {
        static TABLE: LazyLock<[f32; NORMALS]> = LazyLock::new(|| {
            let at = |n: usize| quantile((n as f64 + 0.5) / NORMALS as f64) as f32;
            std::array::from_fn(at)
        });
        Self(&TABLE)
    }

    /// Returns the `n`-th of up to four normal numbers from 64 random bits.
    #[inline]
    pub(super) fn of(self, bits: u64, n: u32) -> f32 {
        self.0[(bits >> (16 * n)) as usize % NORMALS]
    }
}

/// Conversion of light to a number of the converter.
#[derive(Clone, Copy, Debug)]
pub(super) struct Readout {
    /// Electrons of a light of 1 in this exposure. [e]
    pub electrons: f32,
    /// Full well capacity of a pixel. [e]
    pub full_well_e: f32,
    /// Read noise of a pixel, standard deviation. [e]
    pub read_noise_e: f32,
    /// Numbers of the converter per electron.
    pub numbers_per_e: f32,
    /// Maximum number of the converter.
    pub full_scale: f32,
    /// 1, or 0 without noise.
    pub amount: f32,
}

impl Readout {
    /// Returns the digitised value of a light, 0 to 1 of full scale; `normal` is a standard normal number.
    #[inline]
    pub(super) fn read(&self, light: f32, normal: f32) -> f32 {
        let electrons = light * self.electrons;
        let sigma_e = (electrons + self.read_noise_e * self.read_noise_e).sqrt();
        let held = (electrons + sigma_e * normal * self.amount).min(self.full_well_e);
        let number = (held * self.numbers_per_e + 0.5).floor();
        number.clamp(0.0, self.full_scale) / self.full_scale
    }

    /// Returns the standard deviation of a digitised `value`, 0 to 1.
    #[inline]
    pub(super) fn sigma(&self, value: f32) -> f32 {
        let per_e = self.numbers_per_e / self.full_scale;
        let variance = per_e * (value + per_e * self.read_noise_e * self.read_noise_e);
        (variance + 1.0 / (12.0 * self.full_scale * self.full_scale)).sqrt()
    }
}

/// Returns the standard normal quantile of a probability, by Newton's method on the distribution.
fn quantile(p: f64) -> f64 {
    let mut x = 0.0;
    for _ in 0..60 {
        let below = 0.5 * libm::erfc(-x / core::f64::consts::SQRT_2);
        let density = libm::exp(-0.5 * x * x) / core::f64::consts::TAU.sqrt();
        x += ((p - below) / density).clamp(-0.5, 0.5);
    }
    x
}

/// Size of the table: 16 kB, within the L1 cache; the last number is at 3.67 standard deviations.
const NORMALS: usize = 4096;

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns mean and variance.
    fn moments(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
        let count = values.clone().count() as f64;
        let mean = values.clone().sum::<f64>() / count;
        (mean, values.map(|x| (x - mean).powi(2)).sum::<f64>() / count)
    }

    #[test]
    fn table_has_a_normal_distribution() {
        let table = Normals::table();
        let (mean, variance) = moments(table.0.iter().map(|&x| f64::from(x)));
        assert!(mean.abs() < 1e-6 && (variance - 1.0).abs() < 1e-3, "{mean} {variance}");
        // Published quantiles.
        for (p, expected) in [(0.975, 1.959_963_985), (0.5, 0.0), (0.0013498980316, -3.0)] {
            assert!((quantile(p) - expected).abs() < 1e-7, "{p}: {}", quantile(p));
        }
    }

    #[test]
    fn pixels_images_cameras_and_seeds_are_independent() {
        let key = NoiseKey::new(1, 2, 3);
        for other in [NoiseKey::new(2, 2, 3), NoiseKey::new(1, 3, 3), NoiseKey::new(1, 2, 4)] {
            let table = Normals::table();
            let both = (0..100_000).map(|n| {
                f64::from(table.of(key.bits(n), 0)) * f64::from(table.of(other.bits(n), 0))
            });
            assert!(moments(both).0.abs() < 0.015);
        }
        // Neighbouring pixels, and the numbers of one pixel.
        let table = Normals::table();
        let neighbours = (0..100_000)
            .map(|n| f64::from(table.of(key.bits(n), 0)) * f64::from(table.of(key.bits(n + 1), 0)));
        assert!(moments(neighbours).0.abs() < 0.015);
        let within = (0..100_000)
            .map(|n| f64::from(table.of(key.bits(n), 0)) * f64::from(table.of(key.bits(n), 1)));
        assert!(moments(within).0.abs() < 0.015);
    }

    /// Photon transfer curve of EMVA 1288: variance against mean is a line of slope K, offset by the dark noise.
    #[test]
    fn photon_transfer_curve_follows_emva_1288() {
        let readout = Readout {
            electrons: 8000.0,
            full_well_e: 8180.0,
            read_noise_e: 3.0,
            numbers_per_e: 0.47,
            full_scale: 4095.0,
            amount: 1.0,
        };
        let (key, table) = (NoiseKey::new(7, 0, 1), Normals::table());
        for light in [0.01, 0.05, 0.2, 0.5, 0.8] {
            let read = (0..200_000).map(|n| {
                f64::from(readout.read(light, table.of(key.bits(n), 0)) * readout.full_scale)
            });
            let (mean, variance) = moments(read);
            let (electrons, k) = (8000.0 * f64::from(light), 0.47);
            let expected = k * k * (9.0 + electrons) + 1.0 / 12.0;
            assert!((mean - k * electrons).abs() < 0.3, "{light}: mean {mean}");
            assert!(
                (variance / expected - 1.0).abs() < 0.015,
                "{light}: {variance}, not {expected}"
            );
            let sigma = f64::from(readout.sigma((mean / 4095.0) as f32)) * 4095.0;
            assert!((sigma * sigma / expected - 1.0).abs() < 1e-2);
        }
        // A full well is the maximum, and dark values are not below 0.
        assert!((readout.read(3.0, 0.0) * 4095.0 - (8180.0f32 * 0.47 + 0.5).floor()).abs() < 1e-2);
        assert_eq!(readout.read(0.0, -3.0), 0.0);
    }
}
