//! Floaters: splats that photos look through. A floater appears only in the few photos that caused it; all others look
//! past it or through its haze.

use rayon::prelude::*;
use vizflyt_splat::Splats;

use super::depths::Depths;
use crate::dataset::Dataset;

/// Returns for each splat whether many photos look through it and few end at it. `slack` is the minimum distance that a
/// ray must continue behind the splat's centre. [units of the dataset]
pub(super) fn looked_through(
    dataset: &Dataset,
    splats: &Splats,
    depths: &Depths,
    slack: f32,
    depth_error: f32,
) -> Vec<bool> {
    let vote = |i: usize| {
        let [a, b, c] = splats.scales_m[i].to_array();
        // Two standard deviations of the middle axis: the shorter side of the splat's outline.
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
                // Rays pass next to splats thinner than a pixel.
                through += u32::from(width * view.focal[0] >= z);
            } else if (depths.surface[pixel] - z).abs() <= slack + depth_error * z {
                stopped += 1;
            }
        }
        through >= LEAST_THROUGH && through >= MAJORITY * stopped
    };
    (0..splats.len()).into_par_iter().map(vote).collect()
}

/// Minimum number of photos that look through.
const LEAST_THROUGH: u32 = 3;
/// Minimum ratio of photos that look through to photos that stop.
const MAJORITY: u32 = 3;
