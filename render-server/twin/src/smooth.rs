//! Surfaces without texture are flat: a toll on how inverse depth bends along rows and columns, less where
//! the photo has an edge.
//!
//! The inverse depth of a plane is affine in the pixel, so that planes, however inclined, cost nothing.

use rayon::prelude::*;

use crate::planes::{Planes, TILE};
use crate::render::channel;

/// Bends up to here count by their square, more by their size. [shares of the mean inverse depth]
const SMALL: f32 = 0.01;
/// Rays with less on them have no depth.
const MIN_ALPHA: f32 = 0.1;
/// An edge of a photo by which the toll falls to a third. [1 is white]
const EDGE: f32 = 0.1;

/// Adds the derivative of `weight` times the mean bend to `by`; returns that mean. `truth` is the photo,
/// `inverse` memory to work in.
pub(crate) fn add(
    image: &Planes,
    truth: &Planes,
    weight: f32,
    inverse: &mut Planes,
    by: &mut Planes,
) -> f64 {
    let (width, height) = (image.width, image.height);
    inverse.resize(1, width, height);
    let (mut sum, mut count) = (0.0, 0);
    for y in 0..height {
        let (first, through) = (image.row(channel::FIRST, y), image.row(channel::TRANSMITTANCE, y));
        for (x, out) in inverse.row_mut(0, y).iter_mut().enumerate() {
            let alpha = 1.0 - through[x];
            *out = if alpha >= MIN_ALPHA && first[x] > 0.0 { alpha / first[x] } else { f32::NAN };
            if out.is_finite() {
                sum += f64::from(*out);
                count += 1;
            }
        }
    }
    if count == 0 {
        return 0.0;
    }
    let scale = (f64::from(count) / sum) as f32;
    let bends = Bends { inverse, truth, scale };
    let share = weight * scale / (width * height) as f32;
    let len = by.band_len();
    let stride = by.stride;
    let sums: Vec<f64> = by
        .values
        .par_chunks_mut(len)
        .enumerate()
        .with_max_len(1)
        .map(|(band, by)| {
            let mut total = 0.0;
            for row in 0..TILE.min(height - band * TILE) {
                for x in 0..width {
                    let y = band * TILE + row;
                    let q = bends.inverse.at(0, x, y);
                    if !q.is_finite() {
                        continue;
                    }
                    let mut by_q = 0.0;
                    for step in [(1, 0), (0, 1)] {
                        let (toll, slope) = bends.at((x, y), step, 0);
                        total += f64::from(toll);
                        by_q += bends.at((x, y), step, -1).1 + bends.at((x, y), step, 1).1
                            - 2.0 * slope;
                    }
                    let first = image.at(channel::FIRST, x, y);
                    let at = row * stride + x;
                    by[channel::FIRST * TILE * stride + at] -= share * by_q * q / first;
                    by[channel::TRANSMITTANCE * TILE * stride + at] -= share * by_q / first;
                }
            }
            total
        })
        .collect();
    sums.iter().sum::<f64>() / (width * height) as f64
}

struct Bends<'a> {
    inverse: &'a Planes,
    truth: &'a Planes,
    scale: f32,
}

impl Bends<'_> {
    /// Returns the toll of the bend at `along` steps from a pixel, and its slope by the bend; nothing where
    /// one of its three pixels is not there.
    #[inline(always)]
    fn at(&self, (x, y): (usize, usize), (dx, dy): (isize, isize), along: isize) -> (f32, f32) {
        let place = |k: isize| {
            let (u, v) = (x as isize + dx * (along + k), y as isize + dy * (along + k));
            let inside = u >= 0
                && v >= 0
                && (u as usize) < self.inverse.width
                && (v as usize) < self.inverse.height;
            inside.then_some((u as usize, v as usize))
        };
        let (Some(a), Some(b), Some(c)) = (place(-1), place(0), place(1)) else {
            return (0.0, 0.0);
        };
        let q = |(x, y): (usize, usize)| self.inverse.at(0, x, y);
        let bend = (q(a) - 2.0 * q(b) + q(c)) * self.scale;
        if !bend.is_finite() {
            return (0.0, 0.0);
        }
        let edge: f32 = (0..3)
            .map(|channel| {
                let shade = |(x, y): (usize, usize)| self.truth.at(channel, x, y);
                (shade(a) - shade(b)).abs() + (shade(c) - shade(b)).abs()
            })
            .sum();
        let weight = (-edge / (3.0 * EDGE)).exp();
        // Huber's.
        let size = bend.abs();
        let toll = if size < SMALL { bend * bend / (2.0 * SMALL) } else { size - SMALL / 2.0 };
        (weight * toll, weight * (bend / SMALL).clamp(-1.0, 1.0))
    }
}
