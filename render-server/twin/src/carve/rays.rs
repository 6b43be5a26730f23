//! Voxels that photos looked through.
//!
//! Voxels are projected into photos instead of tracing rays: a column of voxels is a line in each photo's frustum,
//! clipped to its visible part. Budget: 1.6 M voxels and 80 photos per second on two cores.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::depths::{Depths, PhotoDepths};
use super::{Seen, Voxels};
use crate::align::Similarity;
use crate::dataset::Dataset;
use crate::view::View;

/// Returns the voxels whose centres at least `photos` photos looked through.
pub(super) fn seen(
    dataset: &Dataset,
    depths: &Depths,
    world: &Similarity,
    voxels: Voxels,
    photos: u8,
) -> Seen {
    let back = world.rotation.inverse();
    let in_dataset = |p_m: DVec3| (back * (p_m - world.translation_m) / world.scale).as_vec3();
    let [nx, ny, nz] = voxels.size;
    let step = (back * DVec3::Z * (voxels.side_m / world.scale)).as_vec3();
    let planes: Vec<Vec<u8>> = (0..nx)
        .into_par_iter()
        .map(|x| {
            let mut counts = vec![0u8; ny * nz];
            for (y, column) in counts.chunks_exact_mut(nz).enumerate() {
                let first = in_dataset(voxels.center_m([x, y, 0]));
                for (photo, depths) in dataset.photos.iter().zip(&depths.photos) {
                    look(&photo.view, depths, first, step, column);
                }
            }
            counts
        })
        .collect();
    let mut seen = Seen::nothing(voxels);
    for (at, count) in planes.iter().flatten().enumerate() {
        seen.bits[at / 8] |= u8::from(*count >= photos.max(1)) << (at % 8);
    }
    seen
}

/// Counts the voxels of a column that a photo looks through. The column begins at `first`, in steps of `step`.
/// [dataset]
fn look(view: &View, depths: &PhotoDepths, first: Vec3, step: Vec3, column: &mut [u8]) {
    let (p, d) = (view.in_cam(first), view.in_cam(first + step) - view.in_cam(first));
    let (width, height) = (view.width as f32, view.height as f32);
    // A point is visible if all of these are above 0. Each is linear along the column.
    let edges = |v: Vec3| {
        let (x, y) = (view.focal[0] * v.x, view.focal[1] * v.y);
        let [u, v_px] = view.center;
        [v.z, x + u * v.z, (width - u) * v.z - x, y + v_px * v.z, (height - v_px) * v.z - y]
    };
    let (mut values, slopes) = (edges(p), edges(d));
    values[0] -= view.near;
    let (mut low, mut high) = (0.0f32, (column.len() - 1) as f32);
    for (value, slope) in values.into_iter().zip(slopes) {
        if slope > 0.0 {
            low = low.max(-value / slope);
        } else if slope < 0.0 {
            high = high.min(-value / slope);
        } else if !(value > 0.0) {
            return;
        }
    }
    let (low, high) = (low.ceil(), high.floor());
    if !(low <= high) {
        return;
    }
    for n in low as usize..=high as usize {
        let q = p + d * n as f32;
        let (x, y) = (
            view.focal[0] * q.x / q.z + view.center[0],
            view.focal[1] * q.y / q.z + view.center[1],
        );
        if !(q.z > view.near && x >= 0.0 && y >= 0.0 && x < width && y < height) {
            continue;
        }
        if depths.free[y as usize * view.width + x as usize] > q.z {
            column[n] = column[n].saturating_add(1);
        }
    }
}
