//! Coarser levels of a part, computed once, so that the cost of an image depends on what it shows and not on the size
//! of the scene.
//!
//! Level 0 contains the part's original blocks. A block of level l + 1 represents four consecutive blocks of level l:
//! its 256 splats are merged from their 1024. The levels form a tree over the Morton order and take a third more
//! memory. `cull` walks it from the top: a subtree out of view costs one test, and a subtree whose merged splats have
//! an error below the allowed pixels is rendered by them.
//!
//! Clusters of splats are found by repeated splitting: the cluster with the greatest weighted spread is cut across
//! its longest axis, until there are a quarter as many clusters as splats. Isolated splats remain; dense ones merge
//! by the dozen.
//!
//! Cost: 0.3 ms per 1024 splats and thread, once.

use glam::{DMat3, DVec3, Vec3};
use half::f16;
use half::slice::{HalfBitsSliceExt as _, HalfFloatSliceExt as _};
use rayon::prelude::*;

use super::merge::{Blob, Origin, merge, square_root, trace};
use super::scene::{BLOCK, Block, GROUP, GROUP_NUMBERS, Part, column};
use crate::Scene;
use crate::limits::BLUR_PX2;

/// Level of detail of a rendered scene.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Detail {
    /// Renders every splat in view.
    #[default]
    Full,
    /// Renders merged splats where the scene is small in the image. Memory and packing time grow by a third; the cost
    /// of an image depends on what it shows.
    Adaptive {
        /// Maximum error of the position of splats, as root mean square; splats are merged only if it is above 0.
        /// [px]
        max_error_px: f32,
    },
}

impl Detail {
    /// Coarsest setting that stays similar to full detail, on generated and captured scenes. With up to 15 visible
    /// splats per pixel: RGB and alpha within 37 dB, a channel off by more than 8 of 255 in at most 4 % of the
    /// pixels, and the median depth off by more than 1 % in at most 6 % of the covered pixels. With up to 100 splats
    /// per pixel: RGB within 30 dB. Such density occurs only in distant views, and which splat hides which is random
    /// in full detail too. Single pixels at edges may have any error. `tests/lod` checks these limits; 0.5 px does
    /// not meet them.
    pub const ADAPTIVE: Self = Self::Adaptive { max_error_px: Self::ADAPTIVE_PX };
    /// Maximum error of [`Self::ADAPTIVE`]. [px]
    pub const ADAPTIVE_PX: f32 = 0.35;
    /// Minimum number of splats for adaptive detail; smaller scenes are rendered fast enough in full detail. [splats]
    pub const WORTHWHILE_FROM: usize = 1_000_000;

    /// Returns the detail for a scene: full for a small one, adaptive for a large one.
    pub fn suited_to(scene: &Scene<'_>) -> Self {
        let moving: usize = scene.objects.iter().map(|object| object.splats.len()).sum();
        let all = scene.splats.len() + moving;
        if all < Self::WORTHWHILE_FROM { Self::Full } else { Self::ADAPTIVE }
    }
}

/// Number of blocks of one level that a block of the next level represents.
pub(crate) const BRANCH: usize = 4;

/// Adds the coarser levels to a part that has only the finest level.
pub(super) fn add_levels(part: &mut Part, max_error_px: f32) {
    if !(max_error_px > 0.0) {
        return;
    }
    let sh_block = part.sh_numbers() * BLOCK;
    let geometry_block = BLOCK / GROUP * GROUP_NUMBERS;
    let mut sizes = vec![part.blocks.len()];
    while sizes[sizes.len() - 1] > 1 {
        sizes.push(sizes[sizes.len() - 1].div_ceil(BRANCH));
    }
    let total: usize = sizes.iter().sum();
    part.geometry.resize(total * geometry_block, f32::NAN);
    part.sh.resize(total * sh_block, 0);
    part.blocks.reserve_exact(total - part.blocks.len());

    let mut origins: Vec<Origin> = Vec::new();
    for pair in sizes.windows(2) {
        let (finer, coarser) = (pair[0], pair[1]);
        let first = part.levels[part.levels.len() - 1];
        let end = first + finer;
        let (geometry, out_geometry) = part.geometry.split_at_mut(end * geometry_block);
        let (sh, out_sh) = part.sh.split_at_mut(end * sh_block);
        let coefficients = part.coefficients;
        // An anti-aliased splat is dimmed by as much as the blur adds, so it covers its own area at any distance.
        let blur_px2 = if part.antialiased { 0.0 } else { BLUR_PX2 };
        let blocks = &part.blocks[first..];
        let mut out_origins = vec![Origin::default(); coarser * BLOCK];
        let out_blocks: Vec<Block> = out_geometry[..coarser * geometry_block]
            .par_chunks_mut(geometry_block)
            .zip(out_sh[..coarser * sh_block].par_chunks_mut(sh_block))
            .zip(out_origins.par_chunks_mut(BLOCK))
            .enumerate()
            .map_init(Scratch::default, |scratch, (i, ((out_geometry, out_sh), out_origins))| {
                let kids = i * BRANCH..((i + 1) * BRANCH).min(finer);
                let slice = |size: usize| (first + kids.start) * size..(first + kids.end) * size;
                let from = From {
                    geometry: &geometry[slice(geometry_block)],
                    sh: &sh[slice(sh_block)],
                    coefficients,
                    origins: origins.get(kids.start * BLOCK..kids.end * BLOCK),
                    blocks: &blocks[kids],
                    max_error_px: f64::from(max_error_px),
                    blur_px2,
                };
                let out = Out { geometry: out_geometry, sh: out_sh, origins: out_origins };
                merge_blocks(&from, out, scratch)
            })
            .collect();
        part.blocks.extend(out_blocks);
        part.levels.push(end);
        origins = out_origins;
    }
}

/// Up to [`BRANCH`] blocks of a level: the input of a merge.
struct From<'a> {
    geometry: &'a [f32],
    sh: &'a [u16],
    coefficients: usize,
    /// Sums per splat; `None` for original splats.
    origins: Option<&'a [Origin]>,
    blocks: &'a [Block],
    max_error_px: f64,
    /// Variance that the pixel adds to a splat. [px^2]
    blur_px2: f64,
}

/// Merged block: the output of a merge.
struct Out<'a> {
    geometry: &'a mut [f32],
    sh: &'a mut [u16],
    origins: &'a mut [Origin],
}

#[derive(Default)]
struct Scratch {
    blobs: Vec<Blob>,
    /// Index of each blob in the packed blocks.
    places: Vec<u32>,
    order: Vec<u32>,
    clusters: Vec<Cluster>,
    sh: Vec<f32>,
}

/// Range of `order`, with the axis of its next cut.
#[derive(Clone, Copy)]
struct Cluster {
    start: u32,
    end: u32,
    mean_m: DVec3,
    axis: DVec3,
    /// Weighted sum of squared distances from the mean; 0 if the cluster cannot be cut.
    score: f64,
}

fn merge_blocks(from: &From<'_>, out: Out<'_>, scratch: &mut Scratch) -> Block {
    let Out { geometry: out_geometry, sh: out_sh, origins: out_origins } = out;
    let (low, high) = from.blocks.iter().fold((Vec3::MAX, Vec3::MIN), |(low, high), block| {
        (low.min(block.center_m - block.half_m), high.max(block.center_m + block.half_m))
    });
    let center_m = low * 0.5 + high * 0.5;
    let mut block = Block {
        center_m,
        half_m: (high * 0.5 - low * 0.5) + center_m.abs() * 1e-6,
        reach_m: from.blocks.iter().map(|block| block.reach_m).fold(0.0, f32::max),
        error_m: from.blocks.iter().map(|block| block.error_m).fold(0.0, f32::max),
    };
    unpack(from, center_m.as_dvec3(), scratch);
    let count = scratch.blobs.len().div_ceil(BRANCH).min(BLOCK);
    let error_m = cluster(count, from.blur_px2 / from.max_error_px.powi(2), scratch);

    // The next level is used from twice the minimum distance on, so the merge is made for the middle of that range.
    let Scratch { blobs, places, order, clusters, sh } = scratch;
    let pixel_blur = |error_m: f64| from.blur_px2 * (1.4 * error_m / from.max_error_px).powi(2);
    let weight_blur_m2 = pixel_blur(error_m);
    let merged = |cluster: &Cluster| {
        let members = &order[cluster.start as usize..cluster.end as usize];
        merge(members.iter().map(|&i| blobs[i as usize]), weight_blur_m2)
    };
    let (mut mass, mut error_m2) = (0.0, 0.0);
    for (cluster, origin) in clusters.iter().zip(out_origins) {
        let blob = merged(cluster);
        let m = blob.mass(weight_blur_m2);
        mass += m;
        error_m2 += m * blob.error_m2();
        *origin = blob.origin;
    }
    // NaN and overflow become infinite: such a block is never rendered.
    let error_m = (error_m2 / mass).sqrt() as f32;
    block.error_m = if error_m.is_finite() { block.error_m.max(error_m) } else { f32::INFINITY };

    let blur_m2 = pixel_blur(f64::from(block.error_m));
    sh.resize(from.sh.len(), 0.0);
    from.sh.reinterpret_cast::<f16>().convert_to_f32_slice(sh);
    let numbers = from.coefficients * 3;
    let mut rows = vec![0f32; numbers * GROUP];
    for (i, group) in clusters.chunks(GROUP).enumerate() {
        rows.fill(0.0);
        let geometry = &mut out_geometry[i * GROUP_NUMBERS..][..GROUP_NUMBERS];
        for (lane, cluster) in group.iter().enumerate() {
            let mut put = |column: usize, v: f32| geometry[column * GROUP + lane] = v;
            let blob = merged(cluster);
            let (covariance_m2, opacity) = blob.rendered(blur_m2);
            let mean_m = (blob.mean_m + center_m.as_dvec3()).as_vec3();
            for k in 0..3 {
                put(column::MEAN + k, mean_m[k]);
            }
            for (k, v) in square_root(&covariance_m2).to_cols_array().into_iter().enumerate() {
                put(column::AXES + k, v as f32);
            }
            put(column::LEVEL, opacity.log2() as f32);
            let deviations = (2.0 * (opacity * 255.0).ln().max(0.0)).sqrt();
            // The greatest deviation is at most the root of the matrix's norm.
            let norm = covariance_m2.to_cols_array().iter().map(|v| v * v).sum::<f64>().sqrt();
            block.reach_m = block.reach_m.max((deviations * norm.sqrt() * 1.0001) as f32);

            let members = &order[cluster.start as usize..cluster.end as usize];
            let mass = blob.mass(weight_blur_m2);
            for &member in members {
                let weight = (blobs[member as usize].mass(weight_blur_m2) / mass) as f32;
                let place = places[member as usize] as usize;
                let column = &sh[place / GROUP * numbers * GROUP + place % GROUP..];
                for k in 0..numbers {
                    rows[k * GROUP + lane] += weight * column[k * GROUP];
                }
            }
        }
        let halves = &mut out_sh[i * numbers * GROUP..][..numbers * GROUP];
        halves.reinterpret_cast_mut::<f16>().convert_from_f32_slice(&rows);
    }
    block
}

/// Fills `blobs` with the splats of the blocks, relative to `center_m`.
fn unpack(from: &From<'_>, center_m: DVec3, scratch: &mut Scratch) {
    let Scratch { blobs, places, .. } = scratch;
    blobs.clear();
    places.clear();
    for (i, geometry) in from.geometry.chunks_exact(GROUP_NUMBERS).enumerate() {
        for lane in 0..GROUP {
            let at = |column: usize| f64::from(geometry[column * GROUP + lane]);
            let vector = |column: usize| DVec3::new(at(column), at(column + 1), at(column + 2));
            let mean_m = vector(column::MEAN);
            // Padding.
            if mean_m.is_nan() {
                continue;
            }
            let axes_m = DMat3::from_cols(
                vector(column::AXES),
                vector(column::AXES + 3),
                vector(column::AXES + 6),
            );
            let mut blob = Blob::new(mean_m - center_m, axes_m, at(column::LEVEL).exp2());
            let place = i * GROUP + lane;
            if let Some(origins) = from.origins {
                blob.origin = origins[place];
            }
            blobs.push(blob);
            places.push(place as u32);
        }
    }
}

/// Cuts the blobs into `count` clusters, or fewer if blobs coincide. Returns the expected error of a cluster [m].
/// `blur` is the pixel's blur, in squares of the allowed error.
fn cluster(count: usize, blur: f64, scratch: &mut Scratch) -> f64 {
    let Scratch { blobs, order, clusters, .. } = scratch;
    order.clear();
    order.extend(0..blobs.len() as u32);
    clusters.clear();
    if blobs.is_empty() {
        return 0.0;
    }
    // A surface cut into n pieces: the square extent of each is an n-th.
    let whole = examine(blobs, order, 0, order.len() as u32, 0.0);
    let mass: f64 = blobs.iter().map(|blob| blob.mass(0.0)).sum();
    let error_m = (whole.score / mass / count as f64).sqrt();
    let blur_m2 = blur * (1.4 * error_m).powi(2);
    clusters.push(examine(blobs, order, 0, order.len() as u32, blur_m2));
    while clusters.len() < count {
        let (worst, cluster) = clusters
            .iter()
            .copied()
            .enumerate()
            .max_by(|(_, a), (_, b)| a.score.total_cmp(&b.score))
            .expect("one at least");
        let members = &mut order[cluster.start as usize..cluster.end as usize];
        let cut = partition(members, |i| {
            (blobs[i as usize].mean_m - cluster.mean_m).dot(cluster.axis) < 0.0
        });
        if !(cluster.score > 0.0) {
            break;
        }
        if cut == 0 || cut == members.len() {
            // Too close to distinguish after rounding.
            clusters[worst].score = 0.0;
            continue;
        }
        let cut = cluster.start + cut as u32;
        clusters[worst] = examine(blobs, order, cluster.start, cut, blur_m2);
        clusters.push(examine(blobs, order, cut, cluster.end, blur_m2));
    }
    // Keeps neighbours in space close in memory.
    clusters.sort_unstable_by_key(|cluster| cluster.start);
    error_m
}

/// Moves the members that satisfy `holds` to the front. Returns their number.
fn partition(members: &mut [u32], holds: impl Fn(u32) -> bool) -> usize {
    let mut front = 0;
    for i in 0..members.len() {
        if holds(members[i]) {
            members.swap(front, i);
            front += 1;
        }
    }
    front
}

/// Returns the cluster of a range of `order`.
fn examine(blobs: &[Blob], order: &[u32], start: u32, end: u32, blur_m2: f64) -> Cluster {
    let members = order[start as usize..end as usize].iter().map(|&i| &blobs[i as usize]);
    let (mut mass, mut sum) = (0.0, DVec3::ZERO);
    for blob in members.clone() {
        let m = blob.mass(blur_m2);
        mass += m;
        sum += blob.mean_m * m;
    }
    let mean_m = sum / mass;
    let mut moment = DMat3::ZERO;
    for blob in members {
        let d = blob.mean_m - mean_m;
        let weighted = d * blob.mass(blur_m2);
        moment += DMat3::from_cols(weighted * d.x, weighted * d.y, weighted * d.z);
    }
    let score = trace(&moment);
    // Longest axis, by repeated multiplication from the largest column.
    let columns = [moment.x_axis, moment.y_axis, moment.z_axis];
    let mut axis = columns
        .into_iter()
        .max_by(|a, b| a.length_squared().total_cmp(&b.length_squared()))
        .expect("three columns");
    for _ in 0..6 {
        axis = (moment * axis).normalize_or_zero();
    }
    Cluster { start, end, mean_m, axis, score: if score.is_finite() { score } else { 0.0 } }
}
