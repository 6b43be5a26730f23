//! Difference between an image and a photo, and its derivative by the image's channels.
//!
//! `(1 - d) L1 + d (1 - SSIM)` of the exposed image (Kerbl et al. 2023, equation 7), plus terms for what photos leave
//! undetermined: the depth of points of structure from motion or of depth images, and the spread of depths along a ray
//! (haze): `sum w (z - D)^2 / D^2` with `D` the ray's own mean depth.

use rayon::prelude::*;
use vizflyt_splat::simd::InstructionSet;

use crate::planes::{Planes, TILE};
use crate::render::channel;
use crate::{smooth, ssim};

/// A photo and its known depths.
#[derive(Clone, Debug, Default)]
pub struct Target {
    /// Width. [px]
    pub width: usize,
    /// Height. [px]
    pub height: usize,
    /// H x W x 3, sRGB.
    pub rgb: Vec<u8>,
    /// Mask, H x W; pixels with 0 are ignored. Empty: no mask.
    pub mask: Vec<u8>,
    /// Points visible in the photo.
    pub points: Vec<SeenPoint>,
    /// Camera-z depth, H x W, 0 where unknown. Empty: no depth image. [units of the dataset]
    pub depth: Vec<f32>,
}

/// A point of structure from motion in a photo.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SeenPoint {
    /// Pixel, y * width + x.
    pub pixel: u32,
    /// Camera-z depth. [units of the dataset]
    pub z: f32,
}

/// Weights of the parts of the loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weights {
    /// Fraction of the dissimilarity in the colour loss, 0 to 1.
    pub dssim: f32,
    /// Weight of the mean relative depth error at points and at pixels of a depth image.
    pub depth: f32,
    /// Weight of the mean relative variance of depth along rays.
    pub spread: f32,
    /// Weight of the mean second difference of inverse depth.
    pub bend: f32,
}

/// Brightness and colour of a photo relative to the others: `gain rgb + offset`, channel by channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    pub gain: [f32; 3],
    pub offset: [f32; 3],
}

impl Default for Exposure {
    fn default() -> Self {
        Self { gain: [1.0; 3], offset: [0.0; 3] }
    }
}

impl Exposure {
    /// Returns the exposure that brings an image closest to a photo, channel by channel (least squares).
    pub(crate) fn fitting(image: &Planes, target: &Target) -> Self {
        let mut exposure = Self::default();
        for c in 0..3 {
            // n, sum a, sum b, sum a^2, sum a b
            let mut sums = [0.0f64; 5];
            for y in 0..image.height {
                for (x, &a) in image.row(c, y).iter().enumerate() {
                    let i = y * image.width + x;
                    if target.mask.get(i) != Some(&0) {
                        let (a, b) = (f64::from(a), f64::from(target.rgb[3 * i + c]) / 255.0);
                        for (sum, term) in sums.iter_mut().zip([1.0, a, b, a * a, a * b]) {
                            *sum += term;
                        }
                    }
                }
            }
            let [n, a, b, aa, ab] = sums;
            let variance = n * aa - a * a;
            if variance > 1e-9 * n * n {
                let gain = (n * ab - a * b) / variance;
                exposure.gain[c] = gain as f32;
                exposure.offset[c] = ((b - gain * a) / n) as f32;
            }
        }
        exposure
    }
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Parts {
    /// Mean absolute error.
    pub l1: f64,
    /// Mean structural similarity; at most 1.
    pub ssim: f64,
    /// Mean relative depth error.
    pub depth: f64,
    /// Mean relative variance of depth along rays.
    pub spread: f64,
    /// Mean second difference of inverse depth, relative to its mean.
    pub bend: f64,
}

impl Parts {
    /// Returns the weighted sum.
    pub fn total(&self, weights: &Weights) -> f64 {
        let dssim = f64::from(weights.dssim);
        (1.0 - dssim) * self.l1
            + dssim * (1.0 - self.ssim)
            + f64::from(weights.depth) * self.depth
            + f64::from(weights.spread) * self.spread
            + f64::from(weights.bend) * self.bend
    }
}

/// Computes losses. Buffers are reused between images.
#[derive(Debug)]
pub struct Loss {
    instructions: InstructionSet,
    shown: Planes,
    truth: Planes,
    maps: Planes,
    by_shown: Planes,
    smooth: smooth::Scratch,
    /// Derivative by the image's channels.
    by: Planes,
}

impl Default for Loss {
    fn default() -> Self {
        Self {
            instructions: InstructionSet::available()[0],
            shown: Planes::default(),
            truth: Planes::default(),
            maps: Planes::default(),
            by_shown: Planes::default(),
            smooth: smooth::Scratch::default(),
            by: Planes::default(),
        }
    }
}

impl Loss {
    /// Returns the loss of an image, and the derivatives by its exposure and by its channels.
    ///
    /// # Panics
    /// If image and target differ in size.
    pub fn of(
        &mut self,
        image: &Planes,
        target: &Target,
        exposure: &Exposure,
        background: [f32; 3],
        weights: &Weights,
    ) -> (Parts, Exposure, &Planes) {
        let (width, height) = (image.width, image.height);
        assert_eq!((width, height), (target.width, target.height));
        self.expose(image, target, exposure, background);
        let numbers = (3 * width * height) as f64;
        let sum = ssim::similarity(self.instructions, &self.shown, &self.truth, &mut self.maps);
        let Self { shown, truth, maps, by_shown, smooth, by, .. } = self;
        ssim::derivative(self.instructions, shown, truth, maps, by_shown);

        by.resize(channel::BY_COUNT, width, height);
        let (len, shown_len, image_len) = (by.band_len(), shown.band_len(), image.band_len());
        let stride = by.stride;
        let l1_step = ((1.0 - f64::from(weights.dssim)) / numbers) as f32;
        let ssim_step = (-f64::from(weights.dssim) / numbers) as f32;
        let rows = |band: usize| TILE.min(height - band * TILE);
        // Sums of a band: absolute error, spread, derivatives by gain and offset, depth error.
        let sums: Vec<[f64; 9]> = by
            .values
            .par_chunks_mut(len)
            .zip(shown.values.par_chunks(shown_len))
            .zip(truth.values.par_chunks(shown_len))
            .zip(by_shown.values.par_chunks(shown_len))
            .zip(image.values.par_chunks(image_len))
            .enumerate()
            .with_max_len(1)
            .map(|(band, ((((by, shown), truth), by_ssim), image))| {
                let plane = TILE * stride;
                by.fill(0.0);
                let mut sums = [0.0; 9];
                for at in (0..rows(band)).flat_map(|row| row * stride..row * stride + width) {
                    let i = band * TILE * width + at / stride * width + at % stride;
                    if target.mask.get(i) == Some(&0) {
                        continue;
                    }
                    for c in 0..3 {
                        let off = shown[c * plane + at] - truth[c * plane + at];
                        let sign = if off == 0.0 { 0.0 } else { off.signum() };
                        let step = l1_step * sign + ssim_step * by_ssim[c * plane + at];
                        let bare = image[c * plane + at]
                            + image[channel::TRANSMITTANCE * plane + at] * background[c];
                        by[c * plane + at] = exposure.gain[c] * step;
                        by[channel::TRANSMITTANCE * plane + at] +=
                            exposure.gain[c] * step * background[c];
                        by[channel::ERROR * plane + at] += off.abs();
                        sums[0] += f64::from(off.abs());
                        sums[2 + c] += f64::from(step * bare);
                        sums[5 + c] += f64::from(step);
                    }
                    let ray = Ray::of(|channel| image[channel * plane + at]);
                    if ray.alpha < MIN_ALPHA {
                        continue;
                    }
                    let mut add = |step: [f32; 3]| {
                        by[channel::FIRST * plane + at] += step[0];
                        by[channel::SECOND * plane + at] += step[1];
                        by[channel::TRANSMITTANCE * plane + at] += step[2];
                    };
                    sums[1] += f64::from(ray.spread());
                    let pixels = (width * height) as f32;
                    add(ray.by_spread().map(|v| v * weights.spread / pixels));
                    if let Some(&z) = target.depth.get(i)
                        && z > 0.0
                    {
                        sums[8] += f64::from((ray.mean / z - 1.0).abs());
                        add(ray.by_depth(z).map(|v| v * weights.depth / pixels));
                    }
                }
                sums
            })
            .collect();
        let mut total = [0.0; 9];
        for band in &sums {
            for k in 0..9 {
                total[k] += band[k];
            }
        }
        let mut parts = Parts {
            l1: total[0] / numbers,
            ssim: sum / numbers,
            depth: total[8] / (width * height) as f64,
            spread: total[1] / (width * height) as f64,
            bend: 0.0,
        };
        if weights.bend > 0.0 {
            parts.bend = smooth::add(image, truth, weights.bend, smooth, by);
        }
        let share = 1.0 / target.points.len().max(1) as f32;
        for point in &target.points {
            let (x, y) = (point.pixel as usize % width, point.pixel as usize / width);
            let ray = Ray::of(|c| image.at(c, x, y));
            if ray.alpha < MIN_ALPHA {
                continue;
            }
            parts.depth += f64::from(share * (ray.mean / point.z - 1.0).abs());
            let step = ray.by_depth(point.z).map(|v| v * weights.depth * share);
            *by.at_mut(channel::FIRST, x, y) += step[0];
            *by.at_mut(channel::TRANSMITTANCE, x, y) += step[2];
        }
        let by_exposure = Exposure {
            gain: std::array::from_fn(|c| total[2 + c] as f32),
            offset: std::array::from_fn(|c| total[5 + c] as f32),
        };
        (parts, by_exposure, &self.by)
    }

    /// Returns PSNR [dB] and mean structural similarity of an image.
    pub fn quality(&mut self, image: &Planes, target: &Target, exposure: &Exposure) -> (f64, f64) {
        self.expose(image, target, exposure, [0.0; 3]);
        let (width, height) = (image.width, image.height);
        let sum = ssim::similarity(self.instructions, &self.shown, &self.truth, &mut self.maps);
        let mut squares = 0.0;
        for channel in 0..3 {
            for y in 0..height {
                let rows = self.shown.row(channel, y).iter().zip(self.truth.row(channel, y));
                squares += rows.map(|(a, b)| f64::from(a.clamp(0.0, 1.0) - b).powi(2)).sum::<f64>();
            }
        }
        let numbers = (3 * width * height) as f64;
        (-10.0 * (squares / numbers).max(1e-10).log10(), sum / numbers)
    }

    /// Fills `shown` and `truth`. Masked pixels are equal in both.
    fn expose(
        &mut self,
        image: &Planes,
        target: &Target,
        exposure: &Exposure,
        background: [f32; 3],
    ) {
        let (width, height) = (image.width, image.height);
        self.shown.resize(3, width, height);
        self.truth.resize(3, width, height);
        let (len, stride, from) = (self.shown.band_len(), self.shown.stride, image.band_len());
        self.shown
            .values
            .par_chunks_mut(len)
            .zip(self.truth.values.par_chunks_mut(len))
            .zip(image.values.par_chunks(from))
            .enumerate()
            .for_each(|(band, ((shown, truth), image))| {
                let plane = TILE * stride;
                for row in 0..TILE.min(height - band * TILE) {
                    for x in 0..width {
                        let at = row * stride + x;
                        let i = (band * TILE + row) * width + x;
                        let looked_at = target.mask.get(i) != Some(&0);
                        let through = image[channel::TRANSMITTANCE * plane + at];
                        for c in 0..3 {
                            let right = f32::from(target.rgb[3 * i + c]) / 255.0;
                            let bare = image[c * plane + at] + through * background[c];
                            truth[c * plane + at] = right;
                            shown[c * plane + at] = if looked_at {
                                exposure.gain[c] * bare + exposure.offset[c]
                            } else {
                                right
                            };
                        }
                    }
                }
            });
    }
}

/// Minimum alpha of a ray with a depth.
const MIN_ALPHA: f32 = 0.1;

/// Sums along a ray.
struct Ray {
    alpha: f32,
    /// Mean depth and mean squared depth.
    mean: f32,
    square: f32,
}

impl Ray {
    #[inline(always)]
    fn of(channel: impl Fn(usize) -> f32) -> Self {
        let alpha = 1.0 - channel(channel::TRANSMITTANCE);
        let by = 1.0 / alpha.max(1e-6);
        Self { alpha, mean: channel(channel::FIRST) * by, square: channel(channel::SECOND) * by }
    }

    /// Returns `sum w (z - D)^2 / D^2`.
    fn spread(&self) -> f32 {
        self.alpha * (self.square / (self.mean * self.mean) - 1.0).max(0.0)
    }

    /// Returns the derivative of the spread at constant D, by the sums of z and z^2 and by transmittance.
    fn by_spread(&self) -> [f32; 3] {
        [-2.0 / self.mean, 1.0 / (self.mean * self.mean), -1.0]
    }

    /// Returns the derivative of `|D / z - 1|` by the same sums.
    fn by_depth(&self, z: f32) -> [f32; 3] {
        let step = (self.mean / z - 1.0).signum() / (z * self.alpha);
        [step, 0.0, step * self.mean]
    }
}

#[cfg(test)]
mod tests;
