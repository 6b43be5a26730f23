//! A rebuilt room against the true one: depths as cameras see them, obstacles as the referee bakes them.

use vizflyt_arena::{ArenaConfig, BakeSpec, Ellipsoid, OccupancyGrid};
use vizflyt_splat::{CpuRenderer, Splats};

use crate::capture::{Capture, depth_m, render};

/// What is off.
#[derive(Debug)]
pub(crate) struct Verdict {
    /// Median relative error of the median depth, over pixels of the photos.
    pub(crate) depth_median: f64,
    /// Share of pixels within 10 %; no return is off.
    pub(crate) within_tenth: f64,
    /// Occupied voxels over those baked from the true splats.
    pub(crate) occupied: f64,
    /// Share of the occupied voxels with no true one within two voxels.
    pub(crate) made_up: f64,
}

/// Judges; `only` says by which photos.
pub(crate) fn judge(
    splats: &Splats,
    truth: &Splats,
    arena: &ArenaConfig,
    capture: &Capture,
    only: impl Fn(usize) -> bool,
) -> Verdict {
    let mut renderer = CpuRenderer::new(splats);
    let mut errors = Vec::new();
    for (_, photo) in capture.photos.iter().enumerate().filter(|(i, _)| only(*i)) {
        let image = render(&mut renderer, capture.intrinsics, photo.world_from_cam);
        let pairs = depth_m(&image).into_iter().zip(&photo.true_depth_m);
        errors.extend(pairs.filter(|(_, t)| **t > 0.0).map(|(d, t)| (d / t - 1.0).abs()));
    }
    errors.sort_by(f32::total_cmp);
    let within = errors.partition_point(|&e| e <= 0.1) as f64 / errors.len() as f64;

    let spec = BakeSpec::of(arena);
    let bake = |splats: &Splats| {
        let ellipsoids = (0..splats.len()).map(|i| Ellipsoid {
            center_m: splats.means_m[i],
            scales_m: splats.scales_m[i],
            rotation: splats.rotations[i],
            opacity: splats.opacities[i],
        });
        OccupancyGrid::bake(ellipsoids, &spec)
    };
    let (rebuilt, right) = (bake(splats), bake(truth));
    let size = spec.grid.size;
    let (mut count, mut made_up) = (0usize, 0usize);
    let mut heights = [0usize; 12];
    for n in 0..spec.grid.voxels() {
        let voxel = [n / (size[1] * size[2]), n / size[2] % size[1], n % size[2]];
        if !rebuilt.is_occupied(voxel) {
            continue;
        }
        count += 1;
        let near = (0..125).any(|k| {
            let at: [isize; 3] = [k / 25 - 2, k / 5 % 5 - 2, k % 5 - 2];
            let at: [isize; 3] = std::array::from_fn(|a| voxel[a] as isize + at[a]);
            (0..3).all(|a| at[a] >= 0 && (at[a] as usize) < size[a])
                && right.is_occupied(at.map(|v| v as usize))
        });
        made_up += usize::from(!near);
        if !near {
            heights[(voxel[2] * 12 / size[2]).min(11)] += 1;
        }
    }
    println!("{heights:?} of {} true {}", rebuilt.counts().occupied, right.counts().occupied);
    Verdict {
        depth_median: f64::from(errors[errors.len() / 2]),
        within_tenth: within,
        occupied: rebuilt.counts().occupied as f64 / right.counts().occupied as f64,
        made_up: made_up as f64 / count.max(1) as f64,
    }
}
