//! Smoothness loss for surfaces without texture: penalises the second difference of inverse depth along rows and
//! columns, less at edges of the photo.
//!
//! The inverse depth of a plane is affine in the pixel, so planes of any inclination cost nothing.

use rayon::prelude::*;

use crate::planes::{Planes, TILE};
use crate::render::channel;

/// Limit between quadratic and linear penalty (Huber) [fraction of the mean inverse depth].
const SMALL: f32 = 0.01;
/// Minimum alpha of a pixel with a depth.
const MIN_ALPHA: f32 = 0.1;
/// Edge strength of the photo at which the penalty falls to 1/e [1 is white].
const EDGE: f32 = 0.1;

/// Reusable buffers.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    /// Inverse depth; NaN if undefined.
    inverse: Planes,
    /// Derivative of the penalty by the second difference at a pixel: across, down.
    slopes: Planes,
}

/// Adds the derivative of `weight` times the mean penalty to `by`; returns that mean. `truth` is the photo.
pub(crate) fn add(
    image: &Planes,
    truth: &Planes,
    weight: f32,
    scratch: &mut Scratch,
    by: &mut Planes,
) -> f64 {
    let (width, height) = (image.width, image.height);
    let Scratch { inverse, slopes } = scratch;
    let (sum, count) = invert(image, inverse);
    if count == 0 {
        return 0.0;
    }
    let scale = (f64::from(count) / sum) as f32;
    slopes.resize(2, width, height);
    let (len, stride) = (slopes.band_len(), slopes.stride);
    let tolls: Vec<f64> = slopes
        .values
        .par_chunks_mut(len)
        .enumerate()
        .with_max_len(1)
        .map(|(band, out)| {
            let mut total = 0.0;
            for row in 0..TILE.min(height - band * TILE) {
                let y = band * TILE + row;
                let (across, down) = out.split_at_mut(TILE * stride);
                let (across, down) = (&mut across[row * stride..], &mut down[row * stride..]);
                across[..width].fill(0.0);
                down[..width].fill(0.0);
                if width > 2 {
                    let shades = [0, 1, 2].map(|channel| beside(truth, channel, y));
                    let slopes = &mut across[1..width - 1];
                    total += bends(beside(inverse, 0, y), shades, scale, slopes);
                }
                if y > 0 && y + 1 < height {
                    let shades = [0, 1, 2].map(|channel| around(truth, channel, y));
                    total += bends(around(inverse, 0, y), shades, scale, &mut down[..width]);
                }
            }
            total
        })
        .collect();
    take_back(image, scratch, weight * scale / (width * height) as f32, by);
    tolls.iter().sum::<f64>() / (width * height) as f64
}

/// Fills the inverse depths; returns their sum and their number.
fn invert(image: &Planes, inverse: &mut Planes) -> (f64, u32) {
    let (width, height) = (image.width, image.height);
    inverse.resize(1, width, height);
    let (len, stride) = (inverse.band_len(), inverse.stride);
    let sums: Vec<(f64, u32)> = inverse
        .values
        .par_chunks_mut(len)
        .enumerate()
        .with_max_len(1)
        .map(|(band, out)| {
            let (mut sum, mut count) = (0.0, 0);
            for row in 0..TILE.min(height - band * TILE) {
                let y = band * TILE + row;
                let first = image.row(channel::FIRST, y);
                let through = image.row(channel::TRANSMITTANCE, y);
                for (x, out) in out[row * stride..][..width].iter_mut().enumerate() {
                    let alpha = 1.0 - through[x];
                    let is_known = alpha >= MIN_ALPHA && first[x] > 0.0;
                    *out = if is_known { alpha / first[x] } else { f32::NAN };
                    if out.is_finite() {
                        sum += f64::from(*out);
                        count += 1;
                    }
                }
            }
            (sum, count)
        })
        .collect();
    sums.iter().fold((0.0, 0), |(sum, count), band| (sum + band.0, count + band.1))
}

/// Returns three views of a row, without its ends: the previous pixel, the pixel, the next pixel.
fn beside(plane: &Planes, channel: usize, y: usize) -> [&[f32]; 3] {
    let row = plane.row(channel, y);
    let len = row.len() - 2;
    [&row[..len], &row[1..=len], &row[2..]]
}

/// Returns a row of a channel with the rows above and below it: above, the row, below.
fn around(plane: &Planes, channel: usize, y: usize) -> [&[f32]; 3] {
    [plane.row(channel, y - 1), plane.row(channel, y), plane.row(channel, y + 1)]
}

/// Writes the derivative of the penalty by each second difference of a row (0 if undefined); returns the sum of the
/// penalties. Inverse depths and colours are those before, at and after each pixel.
fn bends(inverse: [&[f32]; 3], shades: [[&[f32]; 3]; 3], scale: f32, slopes: &mut [f32]) -> f64 {
    let mut total = 0.0;
    for (x, slope) in slopes.iter_mut().enumerate() {
        let [before, here, behind] = inverse.map(|row| row[x]);
        let bend = (before - 2.0 * here + behind) * scale;
        if !bend.is_finite() {
            *slope = 0.0;
            continue;
        }
        let edge: f32 = shades
            .iter()
            .map(|shade| {
                let [before, here, behind] = shade.map(|row| row[x]);
                (before - here).abs() + (behind - here).abs()
            })
            .sum();
        let weight = (-edge / (3.0 * EDGE)).exp();
        // Huber loss.
        let size = bend.abs();
        let toll = if size < SMALL { bend * bend / (2.0 * SMALL) } else { size - SMALL / 2.0 };
        total += f64::from(weight * toll);
        *slope = weight * (bend / SMALL).clamp(-1.0, 1.0);
    }
    total
}

/// Adds the derivative of `share` times the sum of all penalties, through the inverse depths.
fn take_back(image: &Planes, scratch: &Scratch, share: f32, by: &mut Planes) {
    let Scratch { inverse, slopes } = scratch;
    let (width, height) = (image.width, image.height);
    let (len, stride) = (by.band_len(), by.stride);
    by.values.par_chunks_mut(len).enumerate().with_max_len(1).for_each(|(band, by)| {
        let none = vec![0.0; width];
        for row in 0..TILE.min(height - band * TILE) {
            let y = band * TILE + row;
            let across = slopes.row(0, y);
            let above = if y > 0 { slopes.row(1, y - 1) } else { &none };
            let below = if y + 1 < height { slopes.row(1, y + 1) } else { &none };
            let (down, first) = (slopes.row(1, y), image.row(channel::FIRST, y));
            for (x, &inverse) in inverse.row(0, y).iter().enumerate() {
                if !inverse.is_finite() {
                    continue;
                }
                let left = if x > 0 { across[x - 1] } else { 0.0 };
                let right = if x + 1 < width { across[x + 1] } else { 0.0 };
                let step = (left + right - 2.0 * across[x]) + (above[x] + below[x] - 2.0 * down[x]);
                let at = row * stride + x;
                by[channel::FIRST * TILE * stride + at] -= share * step * inverse / first[x];
                by[channel::TRANSMITTANCE * TILE * stride + at] -= share * step / first[x];
            }
        }
    });
}
