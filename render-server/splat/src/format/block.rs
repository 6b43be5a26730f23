//! Checks decoded splats of any format, and stores them in [`Splats`], in parallel.

use glam::{Quat, Vec3};
use rayon::prelude::*;

use super::progress::Meter;
use crate::Splats;

/// Number of invalid splats in a file, by reason. Each splat is counted once, under the first
/// reason that applies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DropCounts {
    /// A value is NaN, or infinite where only a finite number is meaningful. (An infinite opacity
    /// logit is kept: it means fully transparent or fully opaque. A log scale of -infinity is also
    /// kept: it means zero.)
    pub non_finite: usize,
    /// The quaternion is zero.
    pub zero_rotation: usize,
    /// A scale exceeds the range of `f32`.
    pub scale_overflow: usize,
}

impl DropCounts {
    /// Returns the number of splats that were dropped for any reason.
    pub fn total(&self) -> usize {
        self.non_finite + self.zero_rotation + self.scale_overflow
    }

    pub(super) fn plus(self, other: Self) -> Self {
        Self {
            non_finite: self.non_finite + other.non_finite,
            zero_rotation: self.zero_rotation + other.zero_rotation,
            scale_overflow: self.scale_overflow + other.scale_overflow,
        }
    }
}

/// Splats per task: about 100 kB, so that tasks outnumber threads and their overhead is negligible.
pub(super) const SPLATS_PER_TASK: usize = 2048;

/// Splat without its colour, activated, not yet checked.
pub(super) struct Gaussian {
    /// Centre. [m]
    pub(super) mean_m: Vec3,
    /// Standard deviation along each axis. [m]
    pub(super) scale_m: Vec3,
    /// Quaternion of any length except zero.
    pub(super) rotation_xyzw: [f32; 4],
    /// Opacity, 0 to 1.
    pub(super) opacity: f32,
}

/// All arrays of a scene at full length, and a flag for each valid splat.
pub(super) struct Builder {
    splats: Splats,
    kept: Vec<bool>,
}

/// Run of consecutive splats of a [`Builder`].
pub(super) struct Block<'a> {
    means_m: &'a mut [Vec3],
    scales_m: &'a mut [Vec3],
    rotations: &'a mut [Quat],
    opacities: &'a mut [f32],
    sh: &'a mut [f32],
    kept: &'a mut [bool],
    coefficients: usize,
    dropped: DropCounts,
}

/// Runs `fill(first splat, block)` over `count` splats in parallel. The caller has checked that the
/// file holds `count` splats.
pub(super) fn decode_all(
    sh_degree: u8,
    count: usize,
    meter: &Meter,
    fill: impl Fn(usize, &mut Block) + Sync,
) -> (Splats, DropCounts) {
    let mut builder = Builder::new(sh_degree, count);
    let dropped = builder
        .blocks(SPLATS_PER_TASK)
        .collect::<Vec<_>>()
        .into_par_iter()
        .enumerate()
        .map(|(task, mut block)| {
            fill(task * SPLATS_PER_TASK, &mut block);
            meter.add(block.len());
            block.dropped()
        })
        .reduce(DropCounts::default, DropCounts::plus);
    (builder.finish(dropped), dropped)
}

impl Builder {
    /// Allocates memory for `count` splats.
    pub(super) fn new(sh_degree: u8, count: usize) -> Self {
        let mut splats = Splats { sh_degree, ..Splats::default() };
        let numbers = splats.sh_coefficients() * 3;
        splats.means_m = vec![Vec3::ZERO; count];
        splats.scales_m = vec![Vec3::ZERO; count];
        splats.rotations = vec![Quat::IDENTITY; count];
        splats.opacities = vec![0.0; count];
        splats.sh = vec![0.0; count * numbers];
        Self { splats, kept: vec![false; count] }
    }

    /// Returns the splats in runs of `length`; the last run may be shorter.
    pub(super) fn blocks(&mut self, length: usize) -> impl Iterator<Item = Block<'_>> {
        let coefficients = self.splats.sh_coefficients();
        let splats = &mut self.splats;
        splats
            .means_m
            .chunks_mut(length)
            .zip(splats.scales_m.chunks_mut(length))
            .zip(splats.rotations.chunks_mut(length))
            .zip(splats.opacities.chunks_mut(length))
            .zip(splats.sh.chunks_mut(length * coefficients * 3))
            .zip(self.kept.chunks_mut(length))
            .map(move |(((((means_m, scales_m), rotations), opacities), sh), kept)| Block {
                means_m,
                scales_m,
                rotations,
                opacities,
                sh,
                kept,
                coefficients,
                dropped: DropCounts::default(),
            })
    }

    /// Returns the valid splats.
    pub(super) fn finish(mut self, dropped: DropCounts) -> Splats {
        if dropped.total() > 0 {
            let numbers = self.splats.sh_coefficients() * 3;
            retain(&mut self.splats.means_m, &self.kept, 1);
            retain(&mut self.splats.scales_m, &self.kept, 1);
            retain(&mut self.splats.rotations, &self.kept, 1);
            retain(&mut self.splats.opacities, &self.kept, 1);
            retain(&mut self.splats.sh, &self.kept, numbers);
        }
        self.splats
    }
}

impl Block<'_> {
    /// Returns the number of splats.
    pub(super) fn len(&self) -> usize {
        self.means_m.len()
    }

    /// Returns the counts of splats dropped from this block.
    pub(super) fn dropped(&self) -> DropCounts {
        self.dropped
    }

    /// Stores splat `i` with the harmonics `sh(coefficient, channel)`, or counts it as dropped.
    #[inline]
    pub(super) fn put(&mut self, i: usize, gaussian: &Gaussian, sh: impl Fn(usize, usize) -> f32) {
        let out = &mut self.sh[i * self.coefficients * 3..][..self.coefficients * 3];
        for (k, rgb) in out.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            *rgb = [sh(k, 0), sh(k, 1), sh(k, 2)];
        }
        // A sum is faster than single comparisons: any NaN or infinity makes it NaN.
        let zero_if_finite = out.iter().fold(0.0, |sum, v| sum + v * 0.0);
        let Gaussian { mean_m, scale_m, rotation_xyzw, opacity } = *gaussian;
        let finite = mean_m.is_finite()
            && rotation_xyzw.iter().all(|v| v.is_finite())
            && zero_if_finite == 0.0
            && !opacity.is_nan()
            && !scale_m.is_nan();
        if !finite {
            self.dropped.non_finite += 1;
            return;
        }
        // Normalised in f64, in which the square of a finite f32 neither overflows nor vanishes.
        let squares: f64 = rotation_xyzw.iter().map(|&v| f64::from(v) * f64::from(v)).sum();
        if squares == 0.0 {
            self.dropped.zero_rotation += 1;
            return;
        }
        if !scale_m.is_finite() {
            self.dropped.scale_overflow += 1;
            return;
        }
        let length = squares.sqrt();
        self.means_m[i] = mean_m;
        // The covariance uses the square, so the sign has no meaning.
        self.scales_m[i] = scale_m.abs();
        self.rotations[i] = Quat::from_array(rotation_xyzw.map(|v| (f64::from(v) / length) as f32));
        self.opacities[i] = opacity.clamp(0.0, 1.0);
        self.kept[i] = true;
    }
}

/// Keeps the rows of `width` values with a set flag.
fn retain<T: Copy>(values: &mut Vec<T>, kept: &[bool], width: usize) {
    let mut end = 0;
    for (row, _) in kept.iter().enumerate().filter(|&(_, &kept)| kept) {
        values.copy_within(row * width..(row + 1) * width, end);
        end += width;
    }
    values.truncate(end);
}
