//! Packing shared by all renderers: removes invisible splats, orders the rest, and computes the bounds of each block.
//!
//! Splats are in Morton order, so that [`BLOCK`] consecutive splats are neighbours in space and are culled as one
//! block.

use glam::{Mat3, Vec3};
use rayon::prelude::*;

use crate::Splats;
use crate::limits::{ALPHA_MIN, MAX_SCALE_M};

/// Splats per block. Bounds cost about 28 bytes, 256 depths sort within few cache lines, and a workgroup of any
/// graphics card processes one splat per thread.
pub(crate) const BLOCK: usize = 256;

/// Position and extent of the splats of a block.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bounds {
    /// Centre of the box around the splats' centres. [m, part]
    pub(crate) center_m: Vec3,
    /// Half side lengths of that box. [m]
    pub(crate) half_m: Vec3,
    /// Maximum distance from its centre at which a splat of the block is visible. [m]
    pub(crate) reach_m: f32,
}

/// Returns the indices of all visible splats along a Morton curve. Omits splats with opacity below 1/255 and invalid
/// numbers.
pub(crate) fn order(splats: &Splats) -> Vec<u32> {
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
    // The same scale for all axes keeps blocks compact.
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

/// Spreads 21 bits so that two zeros follow each bit.
fn spread(v: u64) -> u64 {
    let v = v & 0x1f_ffff;
    let v = (v | v << 32) & 0x001f_0000_0000_ffff;
    let v = (v | v << 16) & 0x001f_0000_ff00_00ff;
    let v = (v | v << 8) & 0x100f_00f0_0f00_f00f;
    let v = (v | v << 4) & 0x10c3_0c30_c30c_30c3;
    (v | v << 2) & 0x1249_2492_4924_9249
}

/// Returns the square root of a splat's covariance: axes times scales. [m, part]
pub(crate) fn axes(splats: &Splats, i: usize) -> Mat3 {
    let scale_m = splats.scales_m[i].min(Vec3::splat(MAX_SCALE_M));
    Mat3::from_quat(splats.rotations[i].normalize()) * Mat3::from_diagonal(scale_m)
}

/// Returns the bounds of the splats of `order`.
pub(crate) fn bounds(splats: &Splats, order: &[u32]) -> Bounds {
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
    // Halved before the addition, so that the sum cannot overflow. Widened by the rounding error.
    let center_m = low * 0.5 + high * 0.5;
    let half_m = (high * 0.5 - low * 0.5) + center_m.abs() * 1e-6;
    Bounds { center_m, half_m, reach_m: reach_m * 1.0001 }
}
