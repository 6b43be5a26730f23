//! Positions of samples in a pixel and in the exposure; random numbers.

use glam::DVec2;
use vizflyt_protocol::random::SplitMix64;

/// Positions of samples relative to the middle of a pixel.
pub(super) struct Pattern {
    pub(super) offsets_px: Vec<DVec2>,
    /// Instant of each sample in the exposure, from 0 to 1.
    pub(super) instants: Vec<f64>,
    /// Largest offset of a sample along an axis. [px]
    pub(super) reach_px: f64,
}

impl Pattern {
    /// Distributes samples over the pixel's box convolved with a Gaussian of this standard deviation. x uses every
    /// quantile once, and y also, in bit-reversed order (Hammersley), so that an edge in any direction crosses few
    /// samples at once.
    pub(super) fn new(samples: usize, blur_px: f64) -> Self {
        let quantiles: Vec<f64> =
            (0..samples).map(|i| quantile((i as f64 + 0.5) / samples as f64, blur_px)).collect();
        let rank = ranks(samples, 2);
        let offsets_px =
            (0..samples).map(|i| DVec2::new(quantiles[i], quantiles[rank[i]])).collect();
        let instants = (0..samples).map(|i| instant(i, samples)).collect();
        Self { offsets_px, instants, reach_px: quantiles[samples - 1] }
    }
}

/// Returns the instant of a sample in the exposure, from 0 to 1.
fn instant(sample: usize, samples: usize) -> f64 {
    (ranks(samples, 3)[sample] as f64 + 0.5) / samples as f64
}

/// Returns 0..samples ordered by their reversed digits.
fn ranks(samples: usize, base: usize) -> Vec<usize> {
    let inverse = |mut i: usize| {
        let (mut sum, mut weight) = (0.0, 1.0);
        while i > 0 {
            weight /= base as f64;
            sum += weight * (i % base) as f64;
            i /= base;
        }
        sum
    };
    let mut order: Vec<usize> = (0..samples).collect();
    order.sort_by(|&a, &b| inverse(a).total_cmp(&inverse(b)));
    let mut rank = vec![0; samples];
    for (place, &i) in order.iter().enumerate() {
        rank[i] = place;
    }
    rank
}

/// Returns the quantile of a box of width 1 convolved with a Gaussian.
fn quantile(share: f64, blur_px: f64) -> f64 {
    if !(blur_px > 0.0) {
        return share - 0.5;
    }
    let (mut low, mut high) = (-0.5 - 6.0 * blur_px, 0.5 + 6.0 * blur_px);
    for _ in 0..50 {
        let middle = 0.5 * (low + high);
        if below(middle, blur_px) < share {
            low = middle;
        } else {
            high = middle;
        }
    }
    0.5 * (low + high)
}

/// Returns the share of a box of width 1, convolved with a Gaussian, that is below `x`: the integral of the Gaussian's
/// distribution over the box.
fn below(x: f64, blur_px: f64) -> f64 {
    // The antiderivative of the normal distribution F is z F(z) + f(z).
    let antiderivative = |z: f64| {
        let density = (-0.5 * z * z).exp() / std::f64::consts::TAU.sqrt();
        z * normal_below(z) + density
    };
    blur_px * (antiderivative((x + 0.5) / blur_px) - antiderivative((x - 0.5) / blur_px))
}

/// Returns the standard normal distribution at `z`, accurate to 1e-7 (Abramowitz and Stegun 26.2.17).
fn normal_below(z: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.2316419 * z.abs());
    let series = [1.330274429, -1.821255978, 1.781477937, -0.356563782, 0.319381530];
    let tail = series.iter().fold(0.0, |sum, k| (sum + k) * t) * (-0.5 * z * z).exp()
        / std::f64::consts::TAU.sqrt();
    if z > 0.0 { 1.0 - tail } else { tail }
}

/// Reproducible random numbers.
#[derive(Clone, Debug)]
pub(crate) struct Random(SplitMix64);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self(SplitMix64::new(seed))
    }

    pub(crate) fn next(&mut self) -> u64 {
        self.0.bits()
    }

    /// Returns a number in [0, 1).
    pub(crate) fn unit(&mut self) -> f64 {
        self.0.unit()
    }

    /// Returns a standard normal number (Box and Muller 1958).
    pub(crate) fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.unit()).cos()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_have_mean_and_variance_of_box_and_blur() {
        for blur_px in [0.0, 0.3, 0.7, 1.5] {
            let pattern = Pattern::new(16, blur_px);
            let n = pattern.offsets_px.len() as f64;
            let mean = pattern.offsets_px.iter().sum::<DVec2>() / n;
            assert!(mean.length() < 1e-6, "{blur_px}: {mean}");
            let variance = pattern.offsets_px.iter().map(|o| *o * *o).sum::<DVec2>() / n;
            let expected = 1.0 / 12.0 + blur_px * blur_px;
            // Sixteen quantiles omit the ends of the tails.
            assert!((variance / expected - DVec2::ONE).abs().max_element() < 0.1, "{variance}");
        }
    }

    #[test]
    fn uses_every_instant_once() {
        let mut instants: Vec<f64> = (0..16).map(|i| instant(i, 16)).collect();
        instants.sort_by(f64::total_cmp);
        assert_eq!((instants[0], instants[15]), (0.5 / 16.0, 15.5 / 16.0));
        assert!(instants.windows(2).all(|w| (w[1] - w[0] - 1.0 / 16.0).abs() < 1e-12));
    }
}
