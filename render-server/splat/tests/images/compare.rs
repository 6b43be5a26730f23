//! Comparison of images.

use vizflyt_splat::RgbdImage;

/// Returns the peak signal-to-noise ratio of two signals of peak 1. [dB]
pub(crate) fn psnr_db(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    -10.0 * (sum / a.len() as f64).log10()
}

/// Returns the share of pixels with a relative error above `limit`, among those with alpha above 1/2.
pub(crate) fn depth_off(actual: &[f32], expected: &[f32], alpha: &[f32], limit: f32) -> f64 {
    let solid: Vec<usize> = (0..alpha.len()).filter(|&i| alpha[i] > 0.5).collect();
    let off = |&&i: &&usize| !((actual[i] - expected[i]).abs() <= limit * expected[i].abs());
    solid.iter().filter(off).count() as f64 / solid.len().max(1) as f64
}

/// Results of a comparison.
#[derive(Debug)]
pub(crate) struct Difference {
    pub(crate) rgb_db: f64,
    pub(crate) alpha_db: f64,
    /// Share of pixels of alpha > 1/2 with a relative error of depth above 1e-3.
    pub(crate) expected_off: f64,
    pub(crate) median_off: f64,
}

/// Compares two images; depth only where the second has alpha above 1/2.
pub(crate) fn difference(actual: &RgbdImage, expected: &RgbdImage) -> Difference {
    let off = |a: &[f32], b: &[f32]| depth_off(a, b, &expected.alpha, 1e-3);
    Difference {
        rgb_db: psnr_db(&actual.rgb, &expected.rgb),
        alpha_db: psnr_db(&actual.alpha, &expected.alpha),
        expected_off: off(&actual.depth_expected_m, &expected.depth_expected_m),
        median_off: off(&actual.depth_median_m, &expected.depth_median_m),
    }
}

/// Checks that every value is finite and in its range.
pub(crate) fn assert_clean(image: &RgbdImage) {
    let pixels = image.width_px as usize * image.height_px as usize;
    assert_eq!(image.rgb.len(), pixels * 3);
    assert!(image.rgb.iter().all(|v| v.is_finite()), "rgb");
    assert!(image.alpha.iter().all(|v| (0.0..=1.0).contains(v)), "alpha");
    assert_eq!(image.ids.len(), pixels);
    for depth in [&image.depth_expected_m, &image.depth_median_m] {
        assert_eq!(depth.len(), pixels);
        assert!(depth.iter().all(|v| v.is_finite() && *v >= 0.0), "depth");
    }
}
