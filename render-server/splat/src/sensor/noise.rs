//! Counter-based random numbers: the numbers of a beam depend on its index in the scan, not on the
//! thread that casts it.

use vizflyt_protocol::random::{GOLDEN, SplitMix64, mix};

/// Sequence of random numbers of one beam. Gaussian numbers are by Box and Muller (1958).
#[derive(Clone, Debug)]
pub(super) struct Draws(SplitMix64);

impl Draws {
    /// Returns the sequence of beam `beam` in scan `seq` of a sensor with this seed.
    pub(super) fn new(seed: u64, seq: u64, beam: u64) -> Self {
        let seeded = mix(seed.wrapping_add(GOLDEN));
        let scanned = mix(seeded ^ seq.wrapping_mul(0xD1B5_4A32_D192_ED03));
        Self(SplitMix64::new(mix(scanned ^ beam.wrapping_mul(0x8CB9_2BA7_2F3D_8DD7))))
    }

    /// Returns a uniform number in [0, 1).
    pub(super) fn uniform(&mut self) -> f32 {
        self.0.unit_f32()
    }

    /// Returns two independent numbers of zero mean and unit variance.
    pub(super) fn gaussians(&mut self) -> [f32; 2] {
        // 1 - u is in (0, 1], so the logarithm is finite.
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        let (sin, cos) = (std::f32::consts::TAU * self.uniform()).sin_cos();
        [radius * cos, radius * sin]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn is_gaussian_over_beams_and_scans() {
        let over = |draw: &dyn Fn(u64) -> f32| {
            let values: Vec<f64> = (0..40_000).map(|n| f64::from(draw(n))).collect();
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            let square = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
            (mean, square / values.len() as f64)
        };
        let along_beams = over(&|n| Draws::new(3, 1, n).gaussians()[0]);
        let along_scans = over(&|n| Draws::new(3, n, 5).gaussians()[1]);
        for (mean, variance) in [along_beams, along_scans] {
            // Five standard errors of the mean of 40 000 draws.
            assert!(mean.abs() < 0.025, "mean {mean}");
            assert!((variance - 1.0).abs() < 0.036, "variance {variance}");
        }
        let first = |seed, seq, beam| Draws::new(seed, seq, beam).uniform();
        assert_eq!(first(1, 2, 3), first(1, 2, 3));
        assert!(first(1, 2, 3) != first(2, 2, 3) && first(1, 2, 3) != first(1, 3, 2));
    }
}
