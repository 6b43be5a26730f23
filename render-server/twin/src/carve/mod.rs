//! What a capture has proven to be free: its rays, and the way that it was carried.
//!
//! ```text
//! Dataset (poses, points) + trained Splats
//!   depths   how far each photo looks, held against the points that structure from motion saw there
//!   votes    splats that many photos look through, that hang on the capture's own way, or that
//!            nobody sees -> pruned
//!   rays     voxels that several photos looked through                                    -> Seen
//!   path     voxels in which the camera itself has been                                   -> Seen
//! ```
//! Once after a training, in seconds. What no ray has passed is *unseen*: behind surfaces, outside of every
//! photo, in front of what is only guessed. A referee takes it for solid if its arena says so. Glass, mirrors
//! and wires thinner than a pixel are no surfaces to photos: rays pass where a vehicle would not.

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

/// What counts as proof.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CarveOptions {
    /// So many photos must have looked through a voxel.
    pub photos: u8,
    /// Around the camera, wherever it was, is free. [m]
    pub camera_radius_m: f64,
    /// Photos this close to each other, in the order of their names, are one way. [m]
    pub stride_m: f64,
    /// What a rendered depth may be off, as a share of it.
    pub depth_error: f32,
}

impl Default for CarveOptions {
    /// Two photos, as one may be rendered wrong; a fist around a phone; a stride; twice the median error of
    /// depth of a trained hall.
    fn default() -> Self {
        Self { photos: 2, camera_radius_m: 0.1, stride_m: 0.75, depth_error: 0.03 }
    }
}

/// A twin without what stood in the way of its own capture.
#[derive(Clone, Debug)]
pub struct Carved {
    /// In the dataset's frame, as they came, in their order.
    pub splats: Splats,
    /// Which of those given are in [`Self::splats`].
    pub kept: Vec<bool>,
    /// What was seen. [m, world]
    pub seen: Seen,
    /// For people.
    pub counts: CarveCounts,
}

/// What was found and done.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct CarveCounts {
    /// Splats pruned as photos look through them.
    pub looked_through: usize,
    /// Splats pruned as the camera itself was there.
    pub on_path: usize,
    /// Splats pruned as no photo shows them.
    pub hidden: usize,
    /// Points of structure from motion before which something hid them, and how many there are.
    pub hidden_points: usize,
    /// See [`Self::hidden_points`].
    pub points: usize,
    /// Voxels of the region.
    pub voxels: usize,
    /// Of these, seen.
    pub seen: usize,
    /// How long it took.
    pub seconds: f64,
}

/// Carves a trained scene by the capture that it was trained from: prunes what stands in proven free space, and
/// says which of `voxels` were seen. `splats` and `dataset` are in the same frame, which `world_from_dataset`
/// takes to the world.
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
    // What hid it may be gone by now.
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

/// Takes from those kept so far the ones that do not stay.
fn mark_pruned(kept: &mut [bool], stays: &[bool]) {
    for (kept, stays) in kept.iter_mut().filter(|kept| **kept).zip(stays) {
        *kept = *stays;
    }
}

/// Leaves out the splats that do not stay.
fn keep(splats: &mut Splats, stays: &[bool]) {
    let numbers = 3 * splats.sh_coefficients();
    retain(&mut splats.means_m, 1, |i| stays[i]);
    retain(&mut splats.scales_m, 1, |i| stays[i]);
    retain(&mut splats.rotations, 1, |i| stays[i]);
    retain(&mut splats.opacities, 1, |i| stays[i]);
    retain(&mut splats.sh, numbers, |i| stays[i]);
}

/// Of all photos together, of one splat: less is behind something in each. [px]
const LEAST_PIXELS: f32 = 1.0;
/// Behind a floater may be another.
const ROUNDS: usize = 3;

#[cfg(test)]
mod tests;
