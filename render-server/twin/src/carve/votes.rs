//! Which splats hang where photos look through: a floater is seen by the few photos that it was made up for, and
//! all others look past it, or through its haze.

use rayon::prelude::*;
use vizflyt_splat::Splats;

use super::depths::Depths;
use crate::dataset::Dataset;

/// Returns which splats many photos look through, and few stop at. `slack` is how far behind a splat's centre a ray
/// must go on to count. [units of the dataset]
pub(super) fn looked_through(
    dataset: &Dataset,
    splats: &Splats,
    depths: &Depths,
    slack: f32,
    depth_error: f32,
) -> Vec<bool> {
    let vote = |i: usize| {
        let [a, b, c] = splats.scales_m[i].to_array();
        // Of the middle axis: the shorter side of what it looks like, from one deviation to the other.
        let width = 2.0 * a.max(b).min(a.max(c)).min(b.max(c));
        let (mut through, mut stopped) = (0u32, 0u32);
        for (photo, depths) in dataset.photos.iter().zip(&depths.photos) {
            let view = &photo.view;
            let Some(([x, y], z)) = view.project(splats.means_m[i]) else { continue };
            if !(x >= 0.0 && y >= 0.0 && x < view.width as f32 && y < view.height as f32) {
                continue;
            }
            let pixel = y as usize * view.width + x as usize;
            if depths.free[pixel] > z + slack {
                // Rays pass beside what is thinner than a pixel.
                through += u32::from(width * view.focal[0] >= z);
            } else if (depths.surface[pixel] - z).abs() <= slack + depth_error * z {
                stopped += 1;
            }
        }
        through >= LEAST_THROUGH && through >= MAJORITY * stopped
    };
    (0..splats.len()).into_par_iter().map(vote).collect()
}

/// Fewer photos prove nothing.
const LEAST_THROUGH: u32 = 3;
/// So many times as many look through as stop.
const MAJORITY: u32 = 3;
