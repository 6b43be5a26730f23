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
    /// Occupied voxels within the fence, where vehicles fly, and those baked from the true splats.
    pub(crate) within_fence: usize,
    pub(crate) truly_within_fence: usize,
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
    let share = errors.partition_point(|&e| e <= 0.1) as f64 / errors.len() as f64;

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
    let fence = &arena.geofence;
    let within = |grid: &OccupancyGrid| {
        let [across, deep, high] = spec.grid.size;
        let voxels =
            (0..across * deep * high).map(|n| [n / (deep * high), n / high % deep, n % high]);
        let inside = |voxel: &[usize; 3]| {
            let center_m = spec.grid.center_m(*voxel);
            center_m.cmpge(fence.min_m).all() && center_m.cmple(fence.max_m).all()
        };
        voxels.filter(|voxel| grid.is_occupied(*voxel) && inside(voxel)).count()
    };
    Verdict {
        depth_median: f64::from(errors[errors.len() / 2]),
        within_tenth: share,
        occupied: rebuilt.counts().occupied as f64 / right.counts().occupied as f64,
        within_fence: within(&rebuilt),
        truly_within_fence: within(&right),
    }
}
