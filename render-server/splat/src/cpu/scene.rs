//! Packed copy of a scene for the renderers, also for those on graphics cards: reordered, precomputed, and laid out
//! for vectors. The static part is one part, each rigid object another. A moving object before a camera is the same
//! as a static object before a moving camera.
//!
//! Splats are in blocks ([`crate::blocks`]). Within a block, groups of 16 splats are stored column by column (16 x,
//! 16 y, ...), so that one load fills a vector of 8 or 16 lanes. Splats that no image would show (opacity below
//! 1/255, numbers that are not finite) are removed once, here.
//!
//! Memory: 52 bytes per splat, and 6, 24, 54 or 96 for its harmonics as f16. Coarser levels add a third.

use glam::Vec3;
use half::f16;
use half::slice::{HalfBitsSliceExt as _, HalfFloatSliceExt as _};
use rayon::prelude::*;

use super::detail::{Detail, add_levels};
use crate::Splats;
use crate::blocks::{self, Bounds};

pub(super) use crate::blocks::BLOCK;
/// Splats per group: lanes of the widest vector.
pub(crate) const GROUP: usize = 16;

/// Indices of a group's columns.
pub(crate) mod column {
    /// Centre, x y z. [m, world]
    pub(crate) const MEAN: usize = 0;
    /// Square root of the covariance: axes times scales, column by column. [m, world]
    pub(crate) const AXES: usize = 3;
    /// Binary logarithm of the opacity.
    pub(crate) const LEVEL: usize = 12;
    /// Number of columns.
    pub(crate) const COUNT: usize = 13;
}

/// Number of values of one group's geometry.
pub(crate) const GROUP_NUMBERS: usize = column::COUNT * GROUP;

/// Bounds of [`BLOCK`] consecutive splats.
#[allow(clippy::struct_field_names, reason = "metres, all of them")]
#[derive(Clone, Copy, Debug)]
pub(crate) struct Block {
    /// Centre of the box around the splats' centres. [m, world]
    pub(crate) center_m: Vec3,
    /// Half side lengths of that box. [m]
    pub(crate) half_m: Vec3,
    /// Maximum distance from its centre at which a splat of the block is visible. [m]
    pub(crate) reach_m: f32,
    /// Root mean square distance of the block's splats from the finer splats that they replace; 0 for original
    /// splats. [m]
    pub(crate) error_m: f32,
}

/// Static part or one rigid object; packed in its own frame.
#[derive(Clone, Debug, Default)]
pub(crate) struct Part {
    /// Value in the image of ids.
    pub(crate) id: u16,
    /// Blocks level by level, the finest first.
    pub(crate) blocks: Vec<Block>,
    /// First block of each level; at least one level.
    pub(crate) levels: Vec<usize>,
    /// [`GROUP_NUMBERS`] values per group, whole blocks; the last block is padded with NaN centres.
    pub(crate) geometry: Vec<f32>,
    /// Harmonics as f16: per group, coefficient by coefficient, in each RGB, 16 splats each.
    pub(crate) sh: Vec<u16>,
    /// Coefficients per colour channel.
    pub(crate) coefficients: usize,
    /// Number of packed splats.
    pub(crate) len: usize,
    /// [`Splats::antialiased`].
    pub(crate) antialiased: bool,
}

impl Part {
    /// Packs splats, and adds coarser levels if `detail` is adaptive.
    pub(super) fn new(id: u16, splats: &Splats, detail: Detail) -> Self {
        let mut part = Self::packed(id, splats);
        if let Detail::Adaptive { max_error_px } = detail {
            add_levels(&mut part, max_error_px);
        }
        part
    }

    /// Returns the number of harmonics values per splat.
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
                // Coefficient by coefficient: one or two instructions convert sixteen values.
                for (k, halves) in sh.chunks_exact_mut(GROUP).enumerate() {
                    let mut lanes = [0f32; GROUP];
                    for (lane, &i) in lanes.iter_mut().zip(order) {
                        // Clamped: the maximum of f16 is 65504, and an infinity would become NaN.
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
