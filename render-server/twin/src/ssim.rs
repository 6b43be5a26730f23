//! Structural similarity of two images, and its derivative (Wang et al. 2004, "Image quality assessment", with their
//! Gaussian window of 11 pixels and sigma 1.5; zero beyond the border, as in other trainers).
//!
//! The computation runs band by band: five window sums, across then down; then three maps of derivatives, blurred by
//! the same window, which is symmetric. It takes about 12 ns per pixel and channel.

use rayon::prelude::*;
use vizflyt_splat::simd::{InstructionSet, Kernel, Simd};

use crate::planes::{Planes, TILE};

/// Radius of the window without its centre. [px]
const REACH: usize = 5;
const ROWS: usize = TILE + 2 * REACH;
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
/// Maximum vector length.
const MAX_LANES: usize = 16;

/// Returns half of the window, from its centre; the complete window sums to 1.
fn window() -> [f32; REACH + 1] {
    let bell = |k: usize| (-((k * k) as f32) / (2.0 * 1.5 * 1.5)).exp();
    let sum = bell(0) + 2.0 * (1..=REACH).map(bell).sum::<f32>();
    std::array::from_fn(|k| bell(k) / sum)
}

/// Writes the derivatives of the sum of similarities (over all pixels and channels) by the window sums of `shown`,
/// `shown^2` and `shown truth` to `maps`, three maps for each channel. Returns the sum of similarities.
pub(crate) fn similarity(
    instructions: InstructionSet,
    shown: &Planes,
    truth: &Planes,
    maps: &mut Planes,
) -> f64 {
    maps.resize(3 * shown.channels, shown.width, shown.height);
    let len = maps.band_len();
    let sums: Vec<f64> = maps
        .values
        .par_chunks_mut(len)
        .enumerate()
        .with_max_len(1)
        .map(|(band, out)| instructions.run(Similarity { shown, truth, band, out }))
        .collect();
    sums.iter().sum()
}

/// Writes the derivative of the sum of similarities by every value of `shown`, from its maps.
pub(crate) fn derivative(
    instructions: InstructionSet,
    shown: &Planes,
    truth: &Planes,
    maps: &Planes,
    out: &mut Planes,
) {
    out.resize(shown.channels, shown.width, shown.height);
    let len = out.band_len();
    out.values.par_chunks_mut(len).enumerate().with_max_len(1).for_each(|(band, out)| {
        instructions.run(Derivative { shown, truth, maps, band, out });
    });
}

/// Rows of a band and its surroundings, blurred across; one map for each sum or product of images.
struct Strip<const N: usize> {
    stride: usize,
    padded: Vec<f32>,
    rows: Vec<f32>,
}

impl<const N: usize> Strip<N> {
    fn new(stride: usize) -> Self {
        Self {
            stride,
            padded: vec![0.0; stride + 2 * REACH + MAX_LANES],
            rows: vec![0.0; N * ROWS * stride],
        }
    }

    /// Blurs row `row` of the strip across. `value` returns each pixel's value.
    #[inline(always)]
    fn across<S: Simd>(
        &mut self,
        s: S,
        map: usize,
        row: usize,
        width: usize,
        value: impl Fn(usize) -> f32,
    ) {
        let window = window();
        for (x, out) in self.padded[REACH..REACH + width].iter_mut().enumerate() {
            *out = value(x);
        }
        let out = &mut self.rows[(map * ROWS + row) * self.stride..][..self.stride];
        for x in (0..self.stride).step_by(S::LANES) {
            let mut sum = s.splat(window[0]) * s.load(&self.padded[x + REACH..]);
            for k in 1..=REACH {
                let both =
                    s.load(&self.padded[x + REACH - k..]) + s.load(&self.padded[x + REACH + k..]);
                sum = s.mul_add(s.splat(window[k]), both, sum);
            }
            s.store(sum, &mut out[x..]);
        }
    }

    /// Clears a row of the strip that lies outside the image.
    fn clear(&mut self, row: usize) {
        for map in 0..N {
            self.rows[(map * ROWS + row) * self.stride..][..self.stride].fill(0.0);
        }
    }

    /// Blurs down: returns the window sum at a pixel of row `row` of the band.
    #[inline(always)]
    fn down<S: Simd>(&self, s: S, map: usize, row: usize, x: usize) -> S::F {
        let window = window();
        let at = |k: usize| s.load(&self.rows[(map * ROWS + row + k) * self.stride + x..]);
        let mut sum = s.splat(window[0]) * at(REACH);
        for k in 1..=REACH {
            sum = s.mul_add(s.splat(window[k]), at(REACH - k) + at(REACH + k), sum);
        }
        sum
    }

    /// Calls `fill` with each row of the strip inside the image: index in the strip, y.
    #[inline(always)]
    fn fill(&mut self, band: usize, height: usize, mut fill: impl FnMut(&mut Self, usize, usize)) {
        for row in 0..ROWS {
            match (band * TILE + row).checked_sub(REACH) {
                Some(y) if y < height => fill(self, row, y),
                _ => self.clear(row),
            }
        }
    }
}

struct Similarity<'a> {
    shown: &'a Planes,
    truth: &'a Planes,
    band: usize,
    out: &'a mut [f32],
}

impl Kernel for Similarity<'_> {
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> f64 {
        let Planes { channels, width, height, stride, .. } = *self.shown;
        let mut strip = Strip::<5>::new(stride);
        let mut sum = 0.0;
        let mut values = vec![0.0; stride];
        let plane = TILE * stride;
        for channel in 0..channels {
            strip.fill(self.band, height, |strip, row, y| {
                let (a, b) = (self.shown.row(channel, y), self.truth.row(channel, y));
                strip.across(s, 0, row, width, |x| a[x]);
                strip.across(s, 1, row, width, |x| b[x]);
                strip.across(s, 2, row, width, |x| a[x] * a[x]);
                strip.across(s, 3, row, width, |x| b[x] * b[x]);
                strip.across(s, 4, row, width, |x| a[x] * b[x]);
            });
            for row in 0..TILE.min(height - self.band * TILE) {
                for x in (0..stride).step_by(S::LANES) {
                    let [ma, mb, aa, bb, ab]: [S::F; 5] =
                        std::array::from_fn(|map| strip.down(s, map, row, x));
                    let (c1, c2) = (s.splat(C1), s.splat(C2));
                    let (one, two) = (s.splat(1.0), s.splat(2.0));
                    let (ma2, mb2) = (ma * ma, mb * mb);
                    let means = s.mul_add(two * ma, mb, c1);
                    let covariance = s.mul_add(two, s.neg_mul_add(ma, mb, ab), c2);
                    let brightness = ma2 + mb2 + c1;
                    let variance = aa - ma2 + (bb - mb2) + c2;
                    let by_product = one / (brightness * variance);
                    let similar = means * covariance * by_product;
                    s.store(similar, &mut values[x..]);
                    // By the sums of a, a^2 and a b; variances are a^2 and a b minus the products of the means.
                    let by_mean = two * mb * (covariance - means) * by_product
                        + two * ma * similar * (one / variance - one / brightness);
                    let by_square = s.splat(0.0) - similar / variance;
                    let by_cross = two * means * by_product;
                    for (k, value) in [by_mean, by_square, by_cross].into_iter().enumerate() {
                        let at = (3 * channel + k) * plane + row * stride + x;
                        s.store(value, &mut self.out[at..]);
                    }
                }
                sum += values[..width].iter().map(|&v| f64::from(v)).sum::<f64>();
            }
        }
        sum
    }
}

struct Derivative<'a> {
    shown: &'a Planes,
    truth: &'a Planes,
    maps: &'a Planes,
    band: usize,
    out: &'a mut [f32],
}

impl Kernel for Derivative<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Planes { channels, width, height, stride, .. } = *self.shown;
        let mut strip = Strip::<3>::new(stride);
        let plane = TILE * stride;
        let (mut shown, mut truth) = (vec![0.0; stride], vec![0.0; stride]);
        for channel in 0..channels {
            strip.fill(self.band, height, |strip, row, y| {
                for map in 0..3 {
                    let values = self.maps.row(3 * channel + map, y);
                    strip.across(s, map, row, width, |x| values[x]);
                }
            });
            for row in 0..TILE.min(height - self.band * TILE) {
                let y = self.band * TILE + row;
                shown[..width].copy_from_slice(self.shown.row(channel, y));
                truth[..width].copy_from_slice(self.truth.row(channel, y));
                for x in (0..stride).step_by(S::LANES) {
                    let [mean, square, cross]: [S::F; 3] =
                        std::array::from_fn(|map| strip.down(s, map, row, x));
                    let a = s.load(&shown[x..]);
                    let sum = s.mul_add(s.splat(2.0) * a, square, mean);
                    let sum = s.mul_add(s.load(&truth[x..]), cross, sum);
                    s.store(sum, &mut self.out[channel * plane + row * stride + x..]);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// Computes the definition, window by window.
    fn plain(a: &[f64], b: &[f64], width: i32, height: i32) -> f64 {
        let weight = |d: i32| f64::from(window()[d.unsigned_abs() as usize]);
        let mut total = 0.0;
        for y in 0..height {
            for x in 0..width {
                let mut sums = [0.0; 5];
                for dy in -5..=5i32 {
                    for dx in -5..=5i32 {
                        let (u, v) = (x + dx, y + dy);
                        if (0..width).contains(&u) && (0..height).contains(&v) {
                            let i = (v * width + u) as usize;
                            let w = weight(dx) * weight(dy);
                            let terms = [a[i], b[i], a[i] * a[i], b[i] * b[i], a[i] * b[i]];
                            for k in 0..5 {
                                sums[k] += w * terms[k];
                            }
                        }
                    }
                }
                let [ma, mb, aa, bb, ab] = sums;
                let (c1, c2) = (f64::from(C1), f64::from(C2));
                total += (2.0 * ma * mb + c1) * (2.0 * (ab - ma * mb) + c2)
                    / ((ma * ma + mb * mb + c1) * (aa - ma * ma + bb - mb * mb + c2));
            }
        }
        total
    }

    #[test]
    fn sum_and_derivative_match_the_definition() {
        let (width, height) = (37, 19);
        let mut random = Random::new(4);
        let (mut shown, mut truth) = (Planes::default(), Planes::default());
        shown.resize(2, width, height);
        truth.resize(2, width, height);
        let mut plains = Vec::new();
        for channel in 0..2 {
            let (mut a, mut b) = (Vec::new(), Vec::new());
            for y in 0..height {
                for x in 0..width {
                    b.push(f64::from(random.unit()));
                    a.push(0.7 * b[b.len() - 1] + 0.3 * f64::from(random.unit()));
                    *shown.at_mut(channel, x, y) = a[a.len() - 1] as f32;
                    *truth.at_mut(channel, x, y) = b[b.len() - 1] as f32;
                }
            }
            plains.push((a, b));
        }
        let of = |a: &[f64], b: &[f64]| plain(a, b, width as i32, height as i32);
        for instructions in InstructionSet::available() {
            let (mut maps, mut out) = (Planes::default(), Planes::default());
            let sum = similarity(instructions, &shown, &truth, &mut maps);
            let expected: f64 = plains.iter().map(|(a, b)| of(a, b)).sum();
            assert!((sum - expected).abs() < 1e-2, "{sum} for {expected}");
            derivative(instructions, &shown, &truth, &maps, &mut out);
            for (channel, (a, b)) in plains.iter_mut().enumerate() {
                for i in (0..width * height).step_by(23) {
                    let here = a[i];
                    a[i] = here + 1e-5;
                    let above = of(a, b);
                    a[i] = here - 1e-5;
                    let below = of(a, b);
                    a[i] = here;
                    let want = (above - below) / 2e-5;
                    let got = f64::from(out.at(channel, i % width, i / width));
                    assert!((want - got).abs() < 1e-3 * (1.0 + want.abs()), "{got} for {want}");
                }
            }
        }
    }
}
