//! Similarity of two images.

use std::fmt;

use vizflyt_splat::RgbdImage;

/// Similarity of an image to its reference.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Likeness {
    /// Peak signal-to-noise ratio of RGB, for a peak of 1. [dB]
    pub(crate) rgb_db: f64,
    /// Peak signal-to-noise ratio of alpha. [dB]
    pub(crate) alpha_db: f64,
    /// Share of the pixels with reference alpha > 0.5 and a median depth off by more than 1 %.
    pub(crate) median_off: f64,
    /// Share of the same pixels with an expected depth off by more than 1 %.
    pub(crate) expected_off: f64,
    /// Share of the pixels with a channel off by more than 8 of 255.
    pub(crate) rgb_off: f64,
    /// Share of the opaque pixels (alpha > 0.95) that lost more than 0.1 of alpha: holes.
    pub(crate) holes: f64,
}

impl Likeness {
    pub(crate) fn of(image: &RgbdImage, truth: &RgbdImage) -> Self {
        let seen = |i: &usize| truth.alpha[*i] > 0.5;
        let off = |a: &[f32], b: &[f32]| {
            share((0..a.len()).filter(seen), |i| (a[i] - b[i]).abs() > 0.01 * b[i])
        };
        Self {
            rgb_db: psnr_db(&image.rgb, &truth.rgb),
            alpha_db: psnr_db(&image.alpha, &truth.alpha),
            median_off: off(&image.depth_median_m, &truth.depth_median_m),
            expected_off: off(&image.depth_expected_m, &truth.depth_expected_m),
            rgb_off: share(0..truth.alpha.len(), |i| {
                let channels = i * 3..i * 3 + 3;
                channels.into_iter().any(|k| {
                    (image.rgb[k].clamp(0.0, 1.0) - truth.rgb[k].clamp(0.0, 1.0)).abs()
                        > 8.0 / 255.0
                })
            }),
            holes: share((0..truth.alpha.len()).filter(|&i| truth.alpha[i] > 0.95), |i| {
                truth.alpha[i] - image.alpha[i] > 0.1
            }),
        }
    }
}

impl fmt::Display for Likeness {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "RGB {:.1} dB, off > 8/255 {:.2} %, alpha {:.1} dB, depth off > 1 %: median {:.2} %, expected {:.2} %, holes {:.3} %",
            self.rgb_db,
            self.rgb_off * 100.0,
            self.alpha_db,
            self.median_off * 100.0,
            self.expected_off * 100.0,
            self.holes * 100.0
        )
    }
}

fn psnr_db(a: &[f32], b: &[f32]) -> f64 {
    let sum: f64 = a
        .iter()
        .zip(b)
        .map(|(&a, &b)| f64::from(a.clamp(0.0, 1.0) - b.clamp(0.0, 1.0)).powi(2))
        .sum();
    -10.0 * (sum / a.len() as f64).max(1e-20).log10()
}

fn share(pixels: impl Iterator<Item = usize>, holds: impl Fn(usize) -> bool) -> f64 {
    let (mut all, mut held) = (0usize, 0usize);
    for i in pixels {
        all += 1;
        held += usize::from(holds(i));
    }
    held as f64 / all.max(1) as f64
}
