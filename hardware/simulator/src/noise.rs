//! Seeded random numbers: the same seed gives the same flight on every machine.

use glam::DVec3;
use vizflyt_protocol::random::{self, SplitMix64};

/// Stream of pseudo-random numbers; Gaussian by Box and Muller (1958).
#[derive(Clone, Debug)]
pub(crate) struct Noise {
    random: SplitMix64,
    spare: Option<f64>,
}

impl Noise {
    /// Returns stream number `stream` of `seed`; streams of one seed are independent.
    pub(crate) fn new(seed: u64, stream: u64) -> Self {
        // The start is a hash of the seed, so that neighbouring seeds and streams do not overlap.
        let start = random::nth(seed, 0) ^ stream.wrapping_mul(0xD1B5_4A32_D192_ED03);
        Self { random: SplitMix64::new(start), spare: None }
    }

    /// Returns a uniform number in [0, 1).
    pub(crate) fn uniform(&mut self) -> f64 {
        self.random.unit()
    }

    /// Returns a Gaussian number of zero mean and unit variance.
    pub(crate) fn gaussian(&mut self) -> f64 {
        if let Some(spare) = self.spare.take() {
            return spare;
        }
        // 1 - u lies in (0, 1], so that the logarithm is finite.
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        let (sin, cos) = (std::f64::consts::TAU * self.uniform()).sin_cos();
        self.spare = Some(radius * sin);
        radius * cos
    }

    /// Returns three independent Gaussian numbers of unit variance.
    pub(crate) fn gaussian3(&mut self) -> DVec3 {
        DVec3::new(self.gaussian(), self.gaussian(), self.gaussian())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaussian_numbers_have_unit_variance() {
        let mut noise = Noise::new(3, 1);
        let values: Vec<f64> = (0..40_000).map(|_| noise.gaussian()).collect();
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64;
        // Five standard errors of 40 000 draws.
        assert!(mean.abs() < 0.025, "mean {mean}");
        assert!((variance - 1.0).abs() < 0.036, "variance {variance}");
        assert!(values.iter().all(|v| v.is_finite()));
    }

    #[test]
    fn streams_are_independent_and_repeatable() {
        let draw = |seed, stream| Noise::new(seed, stream).gaussian3();
        assert_eq!(draw(7, 1), draw(7, 1));
        assert_ne!(draw(7, 1), draw(7, 2));
        assert_ne!(draw(7, 1), draw(8, 1));
    }
}
