//! Free space proven by a capture: its rays, and the path of its camera.
//!
//! ```text
//! Dataset (poses, points) + trained Splats
//!   depths   viewing distance of each photo, checked against points of structure from motion
//!   votes    splats that many photos look through, that lie on the camera's path, or that no photo
//!            shows -> pruned
//!   rays     voxels that several photos looked through                                    -> Seen
//!   path     voxels in which the camera itself has been                                   -> Seen
//! ```
//! Carving runs once after a training and takes seconds. Space that no ray has passed is *unseen*: behind surfaces,
//! outside all photos, in front of guessed surfaces. A referee treats it as solid if its arena says so. Limitation:
//! glass, mirrors and wires thinner than a pixel are not visible as surfaces, so rays pass where a vehicle would not.

mod depths;
mod path;
mod rays;
mod visible;
mod votes;
mod voxels;

use std::time::Instant;

use vizflyt_splat::Splats;

use crate::align::Similarity;
use crate::dataset::Dataset;
use crate::train::retain;

use depths::Depths;
use path::Path;

pub use voxels::{Seen, Voxels};

/// Evidence required for free space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CarveOptions {
    /// Minimum number of photos that must have looked through a voxel.
    pub photos: u8,
    /// Radius around each camera position that is assumed free. [m]
    pub camera_radius_m: f64,
    /// Maximum distance of two photos, in the order of their names, between which the camera's path is interpolated.
    /// [m]
    pub stride_m: f64,
    /// Relative error of a rendered depth.
    pub depth_error: f32,
}

impl Default for CarveOptions {
    /// Two photos, because one may be rendered wrongly; the size of a hand around a phone; a stride; twice the median
    /// depth error of a trained hall.
    fn default() -> Self {
        Self { photos: 2, camera_radius_m: 0.1, stride_m: 0.75, depth_error: 0.03 }
    }
}

/// A twin without splats in its capture's free space.
#[derive(Clone, Debug)]
pub struct Carved {
    /// Remaining splats in the dataset's frame, in their original order.
    pub splats: Splats,
    /// For each given splat, whether it is in [`Self::splats`].
    pub kept: Vec<bool>,
    /// Seen space. [m, world]
    pub seen: Seen,
    /// Statistics.
    pub counts: CarveCounts,
}

/// Statistics of a carving.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct CarveCounts {
    /// Splats pruned because photos look through them.
    pub looked_through: usize,
    /// Splats pruned because the camera was there.
    pub on_path: usize,
    /// Splats pruned because no photo shows them.
    pub hidden: usize,
    /// Points of structure from motion hidden by a splat; out of [`Self::points`].
    pub hidden_points: usize,
    /// Points of structure from motion, counted once per photo.
    pub points: usize,
    /// Voxels of the region.
    pub voxels: usize,
    /// Seen voxels of the region.
    pub seen: usize,
    /// Computing time. [s]
    pub seconds: f64,
}

/// Carves a trained scene by its own capture: prunes splats in proven free space, and determines which of `voxels` were
/// seen. `splats` and `dataset` are in the same frame, which `world_from_dataset` transforms to the world.
pub fn carve(
    dataset: &Dataset,
    splats: &Splats,
    world_from_dataset: &Similarity,
    voxels: Voxels,
    options: &CarveOptions,
) -> Carved {
    let start = Instant::now();
    let mut counts = CarveCounts { voxels: voxels.len(), ..CarveCounts::default() };
    let path = Path::of(dataset, world_from_dataset, options);
    let unit_m = world_from_dataset.scale;
    let slack = (voxels.side_m / unit_m) as f32;
    let mut kept = vec![true; splats.len()];
    let mut left = splats.clone();
    for _ in 0..ROUNDS {
        let depths = Depths::render(dataset, &left, options.depth_error);
        let through = votes::looked_through(dataset, &left, &depths, slack, options.depth_error);
        let on_path = path.touches(&left, world_from_dataset);
        counts.looked_through += through.iter().filter(|through| **through).count();
        counts.on_path += through.iter().zip(&on_path).filter(|(t, p)| !**t && **p).count();
        let stays: Vec<bool> = through.iter().zip(&on_path).map(|(t, p)| !t && !p).collect();
        mark_pruned(&mut kept, &stays);
        if stays.iter().all(|stays| *stays) {
            break;
        }
        keep(&mut left, &stays);
    }
    // A splat that hid it may have been pruned.
    let shown: Vec<bool> =
        visible::pixels(dataset, &left).iter().map(|pixels| *pixels >= LEAST_PIXELS).collect();
    counts.hidden = shown.iter().filter(|shown| !**shown).count();
    mark_pruned(&mut kept, &shown);
    keep(&mut left, &shown);
    let depths = Depths::render(dataset, &left, options.depth_error);
    (counts.hidden_points, counts.points) = (depths.hidden_points, depths.points);
    let mut seen = rays::seen(dataset, &depths, world_from_dataset, voxels, options.photos);
    path.mark(&mut seen);
    counts.seen = seen.count();
    counts.seconds = start.elapsed().as_secs_f64();
    Carved { splats: left, kept, seen, counts }
}

/// Clears the flag of kept splats that do not stay.
fn mark_pruned(kept: &mut [bool], stays: &[bool]) {
    for (kept, stays) in kept.iter_mut().filter(|kept| **kept).zip(stays) {
        *kept = *stays;
    }
}

/// Removes the splats that do not stay.
fn keep(splats: &mut Splats, stays: &[bool]) {
    let numbers = 3 * splats.sh_coefficients();
    retain(&mut splats.means_m, 1, |i| stays[i]);
    retain(&mut splats.scales_m, 1, |i| stays[i]);
    retain(&mut splats.rotations, 1, |i| stays[i]);
    retain(&mut splats.opacities, 1, |i| stays[i]);
    retain(&mut splats.sh, numbers, |i| stays[i]);
}

/// Minimum sum of a splat's visible pixels over all photos; less means that it is hidden in each. [px]
const LEAST_PIXELS: f32 = 1.0;
/// Number of pruning rounds: behind a floater may be another.
const ROUNDS: usize = 3;

#[cfg(test)]
mod tests;
