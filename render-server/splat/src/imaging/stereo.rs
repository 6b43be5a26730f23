//! Depth of a stereo pair, like that of an Intel RealSense D435.
//!
//! The image and its depth are those of the left camera; the right one is a baseline to the right. For a point at
//! depth `z`, the disparity is `d = f B / z`. The measured depth differs from the truth by:
//!
//! - **noise**: the error of a disparity is a fraction of a pixel, so that of depth is
//!   `sigma_z = z^2 sigma_d / (f B)` (Intel, "Tuning depth cameras for best performance", dev.intelrealsense.com:
//!   a well tuned camera has `sigma_d` below 0.1 px, usually 0.08);
//! - **steps**: disparities are 32nds of a pixel, depths whole millimetres (z16);
//! - **shadow**: areas hidden from the right camera by something nearer have no depth: a strip of width
//!   `f B (1/near - 1/far)` on the left of each foreground object, and a strip of width `f B / z` at the left border,
//!   which is outside the right image;
//! - **range**: at most `most_disparity_px` are searched, 126 for a D435, so nothing nearer than `f B / 126` is
//!   measured;
//! - **fattening**: a window is matched as a whole, so the foreground extends over the background by about half of it
//!   (D. Scharstein, R. Szeliski, IJCV 2002, section 3.2);
//! - **holes** without a projector: areas without texture cannot be matched.
//!
//! `f` is the focal length of the matched images, not that of the rendered image. Not modelled: correlated noise of
//! neighbours, unrectified rows (the lens of the rendered image should be a pinhole), the range of the projector,
//! repeated textures.

use rayon::prelude::*;
use vizflyt_protocol::geometry::Intrinsics;

use super::noise::{NoiseKey, Normals};
use super::tone::luminance;
use crate::RgbdImage;

/// Stereo pair with its matching parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stereo {
    /// Distance between the two cameras. [m]
    pub baseline_m: f64,
    /// Focal length of the matched images. [px]
    pub focal_px: f64,
    /// Standard deviation of a disparity. [px]
    pub subpixel_px: f64,
    /// Maximum disparity that is searched. [px]
    pub most_disparity_px: f64,
    /// Maximum reported depth. [m]
    pub most_m: f64,
    /// Extension of the foreground over the background, in pixels of the matched images. [px]
    pub fattening_px: f64,
    /// Minimum difference of the luminance within 3 x 3 pixels for a match, relative to the brightest; 0 with a
    /// projector.
    pub least_texture: f64,
}

/// Buffers, reused for the next image.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    /// Disparities in pixels of the rendered image; 0 means no disparity.
    disparity: Vec<f32>,
    /// Maximum within a row's window.
    across: Vec<f32>,
    /// Disparity of the nearest surface at each pixel of the right image.
    right: Vec<f32>,
}

impl Stereo {
    /// Returns the minimum depth, at the maximum disparity. [m]
    pub fn least_m(&self) -> f64 {
        self.focal_px * self.baseline_m / self.most_disparity_px
    }

    /// Returns the standard deviation of a depth. [m]
    pub fn sigma_m(&self, depth_m: f64) -> f64 {
        depth_m * depth_m * self.subpixel_px / (self.focal_px * self.baseline_m)
    }

    /// Measures camera-z depths in whole millimetres into `out`, H x W; 0 means no return. [m, cam]
    pub(super) fn measure(
        &self,
        k: &Intrinsics,
        image: &RgbdImage,
        light: &[f32],
        key: NoiseKey,
        scratch: &mut Scratch,
        out: &mut [f32],
    ) {
        let (width, height) = (k.width_px as usize, k.height_px as usize);
        let count = width * height;
        for buffer in [&mut scratch.disparity, &mut scratch.across, &mut scratch.right] {
            buffer.resize(count, 0.0);
        }
        let Scratch { disparity, across, right } = scratch;
        // Product of disparity and depth in the rendered image.
        let product = (k.fx_px * self.baseline_m) as f32;
        let reach = (self.fattening_px * k.fx_px / self.focal_px).round() as usize;
        // A pixel is in the foreground if its disparity is greater by more than noise and slopes cause.
        let jump = |d: f32| 1.05 * d;

        let rows = disparity.par_chunks_mut(width).zip(right.par_chunks_mut(width));
        rows.zip(across.par_chunks_mut(width)).enumerate().for_each(
            |(y, ((disparity, right), across))| {
                let from = y * width;
                for (x, d) in disparity.iter_mut().enumerate() {
                    let (z, alpha) = (image.depth_median_m[from + x], image.alpha[from + x]);
                    let returned = alpha >= RgbdImage::MIN_DEPTH_ALPHA && z > 0.0 && z.is_finite();
                    *d = if returned { product / z } else { 0.0 };
                }
                see_from_the_right(disparity, right);
                for x in 0..width {
                    let window = &disparity[x.saturating_sub(reach)..width.min(x + reach + 1)];
                    across[x] = window.iter().copied().fold(0.0, f32::max);
                }
            },
        );
        let (disparity, across, right) = (&*disparity, &*across, &*right);
        let table = Normals::table();
        out.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
            let from = y * width;
            let rows = y.saturating_sub(reach)..height.min(y + reach + 1);
            for (x, out) in out.iter_mut().enumerate() {
                let own = disparity[from + x];
                let front = rows.clone().map(|y| across[y * width + x]).fold(0.0, f32::max);
                let d = if front > jump(own) {
                    front
                } else if is_seen_from_the_right(own, x, &right[from..][..width]) {
                    own
                } else {
                    0.0
                };
                let is_matched = d > 0.0
                    && (self.least_texture <= 0.0
                        || texture(light, (width, height), (x, y)) >= self.least_texture as f32);
                let normal = table.of(key.bits(from + x), 0);
                *out = if is_matched {
                    self.depth_m(f64::from(d) / f64::from(product), normal)
                } else {
                    0.0
                };
            }
        });
    }

    /// Returns the measured depth for the inverse depth `near`; 0 if out of range. [m]
    fn depth_m(&self, near: f64, normal: f32) -> f32 {
        let product = self.focal_px * self.baseline_m;
        let disparity = product * near + self.subpixel_px * f64::from(normal);
        let disparity = (disparity * STEPS).round() / STEPS;
        if !(disparity > 0.0 && disparity <= self.most_disparity_px) {
            return 0.0;
        }
        let depth_m = product / disparity;
        if depth_m > self.most_m { 0.0 } else { ((depth_m * 1000.0).round() / 1000.0) as f32 }
    }
}

/// Writes the disparity of the nearest surface to each pixel of the right camera's row.
fn see_from_the_right(disparity: &[f32], right: &mut [f32]) {
    right.fill(0.0);
    for (x, &d) in disparity.iter().enumerate() {
        let at = x as f32 - d;
        if d > 0.0 && at >= 0.0 {
            // A pixel overlaps two pixels.
            for at in [at as usize, at as usize + 1] {
                if let Some(nearest) = right.get_mut(at) {
                    *nearest = nearest.max(d);
                }
            }
        }
    }
}

/// Returns whether the right camera sees the point of a pixel: no surface is in front of it that is nearer by more
/// than a neighbour's difference.
#[inline]
fn is_seen_from_the_right(d: f32, x: usize, right: &[f32]) -> bool {
    let at = x as f32 - d + 0.5;
    d > 0.0 && at >= 0.5 && right[(at as usize).min(right.len() - 1)] <= d * 1.05 + 0.5
}

/// Returns the range of the luminance around a pixel, relative to the brightest.
fn texture(light: &[f32], (width, height): (usize, usize), (x, y): (usize, usize)) -> f32 {
    let (mut low, mut high) = (f32::INFINITY, 0f32);
    for y in y.saturating_sub(1)..height.min(y + 2) {
        for rgb in light[3 * (y * width + x.saturating_sub(1))..3 * (y * width + width.min(x + 2))]
            .chunks_exact(3)
        {
            let value = luminance(rgb[0], rgb[1], rgb[2]);
            (low, high) = (low.min(value), high.max(value));
        }
    }
    (high - low) / high.max(1e-6)
}

/// Steps of a disparity per pixel (Intel, "Subpixel linearity improvement", dev.intelrealsense.com).
const STEPS: f64 = 32.0;

#[cfg(test)]
mod tests {
    use super::*;

    /// D435 at 848 x 480, 87 degrees.
    const D435: Stereo = Stereo {
        baseline_m: 0.05,
        focal_px: 446.8,
        subpixel_px: 0.08,
        most_disparity_px: 126.0,
        most_m: 10.0,
        fattening_px: 0.0,
        least_texture: 0.0,
    };
    const NO_NOISE: Stereo = Stereo { subpixel_px: 0.0, ..D435 };

    fn measured(
        stereo: &Stereo,
        size: (u32, u32),
        depth_m: impl Fn(usize, usize) -> f32,
    ) -> (Intrinsics, Vec<f32>) {
        let k = Intrinsics::from_horizontal_fov(size.0, size.1, 87f64.to_radians());
        let mut image = RgbdImage::default();
        image.resize(size.0, size.1);
        image.alpha.fill(1.0);
        let (width, mut out) = (size.0 as usize, vec![0.0; k.pixels()]);
        for (n, z) in image.depth_median_m.iter_mut().enumerate() {
            *z = depth_m(n % width, n / width);
        }
        let light = vec![0.5; 3 * k.pixels()];
        let key = NoiseKey::new(1, 0, 1);
        stereo.measure(&k, &image, &light, key, &mut Scratch::default(), &mut out);
        (k, out)
    }

    /// Intel's curve: the standard deviation of depth grows with its square.
    #[test]
    fn noise_grows_with_the_square_of_depth() {
        for z in [0.5f64, 1.0, 2.0, 4.0] {
            let (_, out) = measured(&D435, (320, 240), |_, _| z as f32);
            let kept: Vec<f64> = out.iter().filter(|&&z| z > 0.0).map(|&z| f64::from(z)).collect();
            let mean = kept.iter().sum::<f64>() / kept.len() as f64;
            let variance = kept.iter().map(|z| (z - mean).powi(2)).sum::<f64>() / kept.len() as f64;
            let expected_m = z * z * 0.08 / (446.8 * 0.05);
            // Quantisation to a 32nd of a pixel and to a millimetre adds a twelfth of each squared step.
            let step_m = z * z / 32.0 / (446.8 * 0.05);
            let all = (expected_m.powi(2) + (step_m.powi(2) + 1e-6) / 12.0).sqrt();
            assert!((variance.sqrt() / all - 1.0).abs() < 0.05, "{z} m: {}", variance.sqrt());
            assert!((D435.sigma_m(z) - expected_m).abs() < 1e-12);
            assert!((mean - z).abs() < 0.02 * expected_m + 2e-3 * z, "{z} m: mean {mean}");
        }
    }

    #[test]
    fn range_and_left_border_follow_from_the_disparity() {
        assert!((D435.least_m() - 0.1773).abs() < 1e-4);
        assert!(measured(&NO_NOISE, (64, 8), |_, _| 0.17).1.iter().all(|&z| z == 0.0));
        assert!(measured(&NO_NOISE, (64, 8), |_, _| 11.0).1.iter().all(|&z| z == 0.0));
        let (k, out) = measured(&NO_NOISE, (320, 8), |_, _| 0.8);
        let lost = out[4 * 320..][..320].iter().take_while(|&&z| z == 0.0).count();
        // Invalid depth band of the data sheet: share of the width, baseline over twice the depth and the tangent of
        // the half angle.
        let band = 0.05 / (2.0 * 0.8 * libm::tan(43.5f64.to_radians())) * 320.0;
        assert!((lost as f64 - band).abs() <= 1.0, "{lost} px, not {band}");
        assert!((band - k.fx_px * 0.05 / 0.8).abs() < 1e-9);
        assert!(out[4 * 320 + lost..][..320 - lost].iter().all(|&z| (z - 0.8).abs() < 0.002));
    }

    #[test]
    fn shadow_is_on_the_left_of_the_foreground() {
        // A board 1 m ahead, columns 150 to 249, in front of a wall 4 m ahead.
        let board = |x: usize, _: usize| if (150..250).contains(&x) { 1.0 } else { 4.0 };
        let (k, out) = measured(&NO_NOISE, (640, 8), board);
        let row = &out[4 * 640..][..640];
        let width_px = k.fx_px * 0.05 * (1.0 - 0.25);
        let shadow = row[..150].iter().rev().take_while(|&&z| z == 0.0).count();
        assert!((shadow as f64 - width_px).abs() <= 1.5, "{shadow} px, not {width_px}");
        assert!(row[150..250].iter().all(|&z| (z - 1.0).abs() < 0.005));
        assert!(row[250..].iter().all(|&z| (z - 4.0).abs() < 0.05), "none on the right");
        // The background of a pole is visible on its other side: the shadow is as wide as the pole.
        let pole = |x: usize, _: usize| if (300..308).contains(&x) { 1.0 } else { 4.0 };
        let (_, out) = measured(&NO_NOISE, (640, 8), pole);
        let dark = out[4 * 640 + 20..][..620].iter().filter(|&&z| z == 0.0).count();
        assert!((7..=11).contains(&dark), "{dark} px");
    }

    #[test]
    fn slopes_have_no_shadow() {
        // A floor and a wall that is seen at a steep angle.
        let slope = |x: usize, y: usize| 1.0 + 0.004 * x as f32 + 0.002 * y as f32;
        let (_, out) = measured(&NO_NOISE, (320, 240), slope);
        let inside = out.chunks(320).flat_map(|row| &row[30..]);
        assert!(inside.clone().all(|&z| z > 0.0), "{}", inside.filter(|&&z| z == 0.0).count());
    }

    #[test]
    fn fattens_edges_and_leaves_holes_in_textureless_walls() {
        let board = |x: usize, _: usize| if (150..250).contains(&x) { 1.0 } else { 4.0 };
        // Rendered at the focal length of the matched images, so that pixels are equal.
        let fat = Stereo { fattening_px: 3.0, ..NO_NOISE };
        let (_, out) = measured(&fat, (848, 8), board);
        let near = out[4 * 848..][..848].iter().filter(|&&z| (z - 1.0).abs() < 0.01).count();
        assert_eq!(near, 100 + 2 * 3);
        let blind = Stereo { least_texture: 0.02, ..NO_NOISE };
        assert!(measured(&blind, (64, 8), |_, _| 1.0).1.iter().all(|&z| z == 0.0));
    }
}
