//! The renderers' own copy of a scene, of which the one for graphics cards is made too: reordered, precomputed, packed for
//! vectors. What stands still is one part, every rigid object another: a part that moves is rendered as one that stands
//! still before a camera that moves.
//!
//! Splats stand in blocks ([`crate::blocks`]). Within a block, groups of 16 splats hold column after column
//! (16 x, 16 y, ...), so that a vector of 8 or 16 lanes is one load. What would be dropped from
//! every image (opacity below 1/255, numbers that are not finite) is dropped here, once.
//!
//! Memory: 52 bytes per splat and 6, 24, 54 or 96 for its harmonics as f16; coarser levels, where
//! asked for, a third more.

use glam::Vec3;
use half::f16;
use half::slice::{HalfBitsSliceExt as _, HalfFloatSliceExt as _};
use rayon::prelude::*;

use super::detail::{Detail, add_levels};
use crate::Splats;
use crate::blocks::{self, Bounds};

pub(super) use crate::blocks::BLOCK;
/// Splats per group: the widest vector.
pub(crate) const GROUP: usize = 16;

/// Columns of a group.
pub(crate) mod column {
    /// Centre, x y z. [m, world]
    pub(crate) const MEAN: usize = 0;
    /// The square root of the covariance: axes times scales, column by column. [m, world]
    pub(crate) const AXES: usize = 3;
    /// log2 of the opacity.
    pub(crate) const LEVEL: usize = 12;
    /// How many.
    pub(crate) const COUNT: usize = 13;
}

/// Numbers of one group's geometry.
pub(crate) const GROUP_NUMBERS: usize = column::COUNT * GROUP;

/// Bounds of [`BLOCK`] consecutive splats.
#[allow(clippy::struct_field_names, reason = "metres, all of them")]
#[derive(Clone, Copy, Debug)]
pub(crate) struct Block {
    /// Middle of the box around the centres. [m, world]
    pub(crate) center_m: Vec3,
    /// Half the sides of that box. [m]
    pub(crate) half_m: Vec3,
    /// The greatest distance from its centre at which a splat of the block still counts. [m]
    pub(crate) reach_m: f32,
    /// How far its splats are from what they stand for, as root mean square; 0 for the scene's own
    /// splats. [m]
    pub(crate) error_m: f32,
}

/// What stands still, or one rigid object; packed in its own frame.
#[derive(Clone, Debug, Default)]
pub(crate) struct Part {
    /// What the image of ids shows.
    pub(crate) id: u16,
    /// Level by level, the finest first.
    pub(crate) blocks: Vec<Block>,
    /// The first block of each level; at least one.
    pub(crate) levels: Vec<usize>,
    /// [`GROUP_NUMBERS`] per group, whole blocks; the last is padded with centres that are NaN.
    pub(crate) geometry: Vec<f32>,
    /// Halves: per group, coefficient by coefficient, RGB within, 16 splats each.
    pub(crate) sh: Vec<u16>,
    /// Coefficients per colour channel.
    pub(crate) coefficients: usize,
    /// Splats kept.
    pub(crate) len: usize,
    /// [`Splats::antialiased`].
    pub(crate) antialiased: bool,
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
    pub(crate) fn sh_numbers(&self) -> usize {
        self.coefficients * 3
    }

    fn packed(id: u16, splats: &Splats) -> Self {
        let order = blocks::order(splats);
        let coefficients = splats.sh_coefficients();
        let count = order.len().div_ceil(BLOCK);
        let sh_numbers = coefficients * 3 * GROUP;
        let mut geometry = vec![f32::NAN; count * BLOCK / GROUP * GROUP_NUMBERS];
        let mut sh = vec![0; count * BLOCK / GROUP * sh_numbers];
        geometry
            .par_chunks_mut(GROUP_NUMBERS)
            .zip(sh.par_chunks_mut(sh_numbers))
            .zip(order.par_chunks(GROUP))
            .for_each(|((geometry, sh), order)| {
                for (lane, &i) in order.iter().enumerate() {
                    let i = i as usize;
                    let mut put = |column: usize, v: f32| geometry[column * GROUP + lane] = v;
                    let axes = blocks::axes(splats, i);
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
        let block = |order: &[u32]| {
            let Bounds { center_m, half_m, reach_m } = blocks::bounds(splats, order);
            Block { center_m, half_m, reach_m, error_m: 0.0 }
        };
        let blocks = order.par_chunks(BLOCK).map(block).collect();
        Self {
            id,
            blocks,
            levels: vec![0],
            geometry,
            sh,
            coefficients,
            len: order.len(),
            antialiased: splats.antialiased,
        }
    }
}
