//! Raw numbers of a splat to activated, checked ones, written straight to their place in [`Splats`].

use glam::{Quat, Vec3};

use super::DropCounts;
use super::layout::{Layout, slot};
use crate::Splats;

/// All arrays of a scene at full length, and which rows are good.
pub(super) struct Builder {
    splats: Splats,
    kept: Vec<bool>,
}

/// A run of consecutive rows of a [`Builder`].
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

impl Builder {
    /// Allocates for `count` rows; the caller knows that the file holds as many.
    pub(super) fn new(layout: &Layout, count: usize) -> Self {
        let mut splats = Splats { sh_degree: layout.sh_degree, ..Splats::default() };
        let numbers = splats.sh_coefficients() * 3;
        splats.means_m = vec![Vec3::ZERO; count];
        splats.scales_m = vec![Vec3::ZERO; count];
        splats.rotations = vec![Quat::IDENTITY; count];
        splats.opacities = vec![0.0; count];
        splats.sh = vec![0.0; count * numbers];
        Self { splats, kept: vec![false; count] }
    }

    /// Returns the rows in runs of `rows`, the last perhaps shorter.
    pub(super) fn blocks(&mut self, rows: usize) -> impl Iterator<Item = Block<'_>> {
        let coefficients = self.splats.sh_coefficients();
        let splats = &mut self.splats;
        splats
            .means_m
            .chunks_mut(rows)
            .zip(splats.scales_m.chunks_mut(rows))
            .zip(splats.rotations.chunks_mut(rows))
            .zip(splats.opacities.chunks_mut(rows))
            .zip(splats.sh.chunks_mut(rows * coefficients * 3))
            .zip(self.kept.chunks_mut(rows))
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

    /// Returns the good rows.
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
    /// Returns the number of rows.
    pub(super) fn len(&self) -> usize {
        self.means_m.len()
    }

    /// Returns what was dropped so far.
    pub(super) fn dropped(&self) -> DropCounts {
        self.dropped
    }

    /// Stores row `i` from its raw numbers, `raw(slot)`, or counts it as dropped.
    #[inline]
    pub(super) fn put(&mut self, i: usize, raw: impl Fn(usize) -> f32) {
        let three = |first: usize| Vec3::new(raw(first), raw(first + 1), raw(first + 2));
        let mean_m = three(slot::MEAN);
        let log_scale = three(slot::LOG_SCALE);
        let wxyz = [0, 1, 2, 3].map(|k| raw(slot::ROTATION_WXYZ + k));
        let logit = raw(slot::OPACITY_LOGIT);
        let sh = &mut self.sh[i * self.coefficients * 3..][..self.coefficients * 3];
        for channel in 0..3 {
            sh[channel] = raw(slot::SH_DC + channel);
            for k in 1..self.coefficients {
                // Channel-major in the file, colour by colour in memory.
                let rest = channel * (self.coefficients - 1) + k - 1;
                sh[k * 3 + channel] = raw(slot::SH_REST + rest);
            }
        }
        // Summed rather than compared one by one: any NaN or infinity makes the product NaN.
        let zero_if_finite = sh.iter().fold(0.0, |sum, v| sum + v * 0.0);
        let finite = mean_m.is_finite()
            && wxyz.iter().all(|v| v.is_finite())
            && zero_if_finite == 0.0
            && !logit.is_nan()
            && !log_scale.is_nan();
        if !finite {
            self.dropped.non_finite += 1;
            return;
        }
        // Normalised in f64, where the square of no finite f32 overflows or vanishes.
        let squares: f64 = wxyz.iter().map(|&v| f64::from(v) * f64::from(v)).sum();
        if squares == 0.0 {
            self.dropped.zero_rotation += 1;
            return;
        }
        let scale_m = Vec3::new(log_scale.x.exp(), log_scale.y.exp(), log_scale.z.exp());
        if !scale_m.is_finite() {
            self.dropped.scale_overflow += 1;
            return;
        }
        let [w, x, y, z] = wxyz.map(|v| (f64::from(v) / squares.sqrt()) as f32);
        self.means_m[i] = mean_m;
        self.scales_m[i] = scale_m;
        self.rotations[i] = Quat::from_xyzw(x, y, z, w);
        self.opacities[i] = 1.0 / (1.0 + (-logit).exp());
        self.kept[i] = true;
    }
}

/// Keeps the rows, `width` values each, whose flag is set.
fn retain<T: Copy>(values: &mut Vec<T>, kept: &[bool], width: usize) {
    let mut end = 0;
    for (row, _) in kept.iter().enumerate().filter(|&(_, &kept)| kept) {
        values.copy_within(row * width..(row + 1) * width, end);
        end += width;
    }
    values.truncate(end);
}
