//! The renderer's own copy of a scene: reordered, precomputed, packed for vectors. What stands
//! still is one part, every rigid object another: a part that moves is drawn as one that stands
//! still before a camera that moves.
//!
//! Splats stand in Morton order, so that 256 neighbours in memory are neighbours in space: a block,
//! with bounds, that is culled as one. Within a block, groups of 16 splats hold column after column
//! (16 x, 16 y, ...), so that a vector of 8 or 16 lanes is one load. What would be dropped from
//! every image (opacity below 1/255, numbers that are not finite) is dropped here, once.
//!
//! Memory: 52 bytes per splat and 6, 24, 54 or 96 for its harmonics as f16; coarser levels, where
//! asked for, a third more.

use glam::{Mat3, Vec3};
use half::f16;
use half::slice::{HalfBitsSliceExt as _, HalfFloatSliceExt as _};
use rayon::prelude::*;

use super::detail::{Detail, add_levels};
use crate::Splats;
use crate::limits::{ALPHA_MIN, MAX_SCALE_M};

/// Splats per block: bounds cost 28 bytes, and 256 depths sort from one cache line to the next.
pub(super) const BLOCK: usize = 256;
/// Splats per group: the widest vector.
pub(super) const GROUP: usize = 16;

/// Columns of a group.
pub(super) mod column {
    /// Centre, x y z. [m, world]
    pub(in crate::cpu) const MEAN: usize = 0;
    /// The square root of the covariance: axes times scales, column by column. [m, world]
    pub(in crate::cpu) const AXES: usize = 3;
    /// log2 of the opacity.
    pub(in crate::cpu) const LEVEL: usize = 12;
    /// How many.
    pub(in crate::cpu) const COUNT: usize = 13;
}

/// Numbers of one group's geometry.
pub(super) const GROUP_NUMBERS: usize = column::COUNT * GROUP;

/// Bounds of [`BLOCK`] consecutive splats.
#[allow(clippy::struct_field_names, reason = "metres, all of them")]
#[derive(Clone, Copy, Debug)]
pub(super) struct Block {
    /// Middle of the box around the centres. [m, world]
    pub(super) center_m: Vec3,
    /// Half the sides of that box. [m]
    pub(super) half_m: Vec3,
    /// The greatest distance from its centre at which a splat of the block still counts. [m]
    pub(super) reach_m: f32,
    /// How far its splats are from what they stand for, as root mean square; 0 for the scene's own
    /// splats. [m]
    pub(super) error_m: f32,
}

/// What stands still, or one rigid object; packed in its own frame.
#[derive(Clone, Debug, Default)]
pub(super) struct Part {
    /// What the image of ids shows.
    pub(super) id: u16,
    /// Level by level, the finest first.
    pub(super) blocks: Vec<Block>,
    /// The first block of each level; at least one.
    pub(super) levels: Vec<usize>,
    /// [`GROUP_NUMBERS`] per group, whole blocks; the last is padded with centres that are NaN.
    pub(super) geometry: Vec<f32>,
    /// Halves: per group, coefficient by coefficient, RGB within, 16 splats each.
    pub(super) sh: Vec<u16>,
    /// Coefficients per colour channel.
    pub(super) coefficients: usize,
    /// Splats kept.
    pub(super) len: usize,
}

impl Part {
    /// Packs splats, and their coarser levels where asked for.
    pub(super) fn new(id: u16, splats: &Splats, detail: Detail) -> Self {
        let mut part = Self::packed(id, splats);
        if let Detail::Adaptive { max_error_px } = detail {
            add_levels(&mut part, max_error_px);
        }
        part
    }

    /// Returns how many numbers the harmonics of a splat are.
    pub(super) fn sh_numbers(&self) -> usize {
        self.coefficients * 3
    }

    fn packed(id: u16, splats: &Splats) -> Self {
        let order = morton_order(splats);
        let coefficients = splats.sh_coefficients();
        let blocks = order.len().div_ceil(BLOCK);
        let sh_numbers = coefficients * 3 * GROUP;
        let mut geometry = vec![f32::NAN; blocks * BLOCK / GROUP * GROUP_NUMBERS];
        let mut sh = vec![0; blocks * BLOCK / GROUP * sh_numbers];
        geometry
            .par_chunks_mut(GROUP_NUMBERS)
            .zip(sh.par_chunks_mut(sh_numbers))
            .zip(order.par_chunks(GROUP))
            .for_each(|((geometry, sh), order)| {
                for (lane, &i) in order.iter().enumerate() {
                    let i = i as usize;
                    let mut put = |column: usize, v: f32| geometry[column * GROUP + lane] = v;
                    let axes = axes(splats, i);
                    for k in 0..3 {
                        put(column::MEAN + k, splats.means_m[i][k]);
                    }
                    for (k, v) in axes.to_cols_array().into_iter().enumerate() {
                        put(column::AXES + k, v);
                    }
                    put(column::LEVEL, splats.opacities[i].log2());
                }
                // Coefficient by coefficient: sixteen at once convert in one instruction or two.
                for (k, halves) in sh.chunks_exact_mut(GROUP).enumerate() {
                    let mut lanes = [0f32; GROUP];
                    for (lane, &i) in lanes.iter_mut().zip(order) {
                        // Clamped: f16 ends at 65504, and an infinity would become NaN.
                        *lane = splats.sh[i as usize * sh_numbers / GROUP + k].clamp(-6e4, 6e4);
                    }
                    halves.reinterpret_cast_mut::<f16>().convert_from_f32_slice(&lanes);
                }
            });
        let blocks = order.par_chunks(BLOCK).map(|order| bounds(splats, order)).collect();
        Self { id, blocks, levels: vec![0], geometry, sh, coefficients, len: order.len() }
    }
}

/// Returns the indices of the splats that can be seen at all, along a Morton curve.
fn morton_order(splats: &Splats) -> Vec<u32> {
    let numbers = splats.sh_coefficients() * 3;
    let visible = |&i: &u32| {
        let i = i as usize;
        let q = splats.rotations[i];
        f64::from(splats.opacities[i]) >= ALPHA_MIN
            && splats.opacities[i] <= 1.0
            && splats.means_m[i].is_finite()
            && !splats.scales_m[i].is_nan()
            && splats.scales_m[i].min_element() >= 0.0
            && (q.length_squared() - 1.0).abs() < 1e-2
            && splats.sh[i * numbers..(i + 1) * numbers].iter().all(|v| v.is_finite())
    };
    let count = u32::try_from(splats.len()).expect("fewer than 2^32 splats");
    let kept: Vec<u32> = (0..count).into_par_iter().filter(visible).collect();
    let (low, high) = kept.iter().fold((Vec3::MAX, Vec3::MIN), |(low, high), &i| {
        let mean = splats.means_m[i as usize];
        (low.min(mean), high.max(mean))
    });
    // One scale for all axes keeps blocks roundish.
    let side = (high - low).max_element().max(f32::MIN_POSITIVE);
    let mut keyed: Vec<(u64, u32)> = kept
        .par_iter()
        .map(|&i| {
            let cell = (splats.means_m[i as usize] - low) / side * ((1 << 21) - 1) as f32;
            let [x, y, z] = cell.to_array().map(|v| spread(v as u64));
            (x | y << 1 | z << 2, i)
        })
        .collect();
    keyed.par_sort_unstable();
    keyed.into_iter().map(|(_, i)| i).collect()
}

/// Spreads 21 bits so that two zeros follow each.
fn spread(v: u64) -> u64 {
    let v = v & 0x1f_ffff;
    let v = (v | v << 32) & 0x001f_0000_0000_ffff;
    let v = (v | v << 16) & 0x001f_0000_ff00_00ff;
    let v = (v | v << 8) & 0x100f_00f0_0f00_f00f;
    let v = (v | v << 4) & 0x10c3_0c30_c30c_30c3;
    (v | v << 2) & 0x1249_2492_4924_9249
}

fn axes(splats: &Splats, i: usize) -> Mat3 {
    let scale_m = splats.scales_m[i].min(Vec3::splat(MAX_SCALE_M));
    Mat3::from_quat(splats.rotations[i].normalize()) * Mat3::from_diagonal(scale_m)
}

fn bounds(splats: &Splats, order: &[u32]) -> Block {
    let (mut low, mut high, mut reach_m) = (Vec3::MAX, Vec3::MIN, 0f32);
    for &i in order {
        let i = i as usize;
        low = low.min(splats.means_m[i]);
        high = high.max(splats.means_m[i]);
        // alpha >= 1/255 within this many standard deviations.
        let deviations = (2.0 * (splats.opacities[i] * 255.0).ln().max(0.0)).sqrt();
        let largest_m = splats.scales_m[i].max_element().min(MAX_SCALE_M);
        reach_m = reach_m.max(deviations * largest_m);
    }
    // Halved before they are added: no sum overflows. Widened by their own rounding.
    let center_m = low * 0.5 + high * 0.5;
    let half_m = (high * 0.5 - low * 0.5) + center_m.abs() * 1e-6;
    Block { center_m, half_m, reach_m: reach_m * 1.0001, error_m: 0.0 }
}
