//! Compares a rebuilt room with the true one: depths seen by the cameras, and obstacles baked for the referee.

use glam::{DQuat, DVec3};
use vizflyt_arena::{ArenaConfig, BakeSpec, Ellipsoid, OccupancyGrid};
use vizflyt_splat::{CpuRenderer, Splats};
use vizflyt_twin::Dataset;
use vizflyt_twin::align::Similarity;
use vizflyt_twin::carve::{CarveOptions, Carved, Seen, Voxels};

use crate::capture::{Capture, depth_m, render};
use crate::profile::Profile;

/// Errors of a rebuilt room.
#[derive(Debug)]
pub(crate) struct Verdict {
    /// Median relative error of the median depth, over pixels of the photos.
    pub(crate) depth_median: f64,
    /// Fraction of pixels with a depth error within 10 %; no return counts as an error.
    pub(crate) within_tenth: f64,
    /// Number of occupied voxels, relative to those baked from the true splats.
    pub(crate) occupied: f64,
    /// Occupied voxels inside the fence, where vehicles fly, and the number of true ones.
    pub(crate) within_fence: usize,
    pub(crate) truly_within_fence: usize,
    /// Like `occupied`, for voxels next to seen free space, which a vehicle can meet; NaN before carving.
    pub(crate) beside_seen: f64,
    /// Occupied voxels in which the camera has been.
    pub(crate) on_way: usize,
    /// PSNR of the photos, without exposure correction.
    pub(crate) psnr_db: f64,
    /// Classification of the occupied voxels.
    pub(crate) profile: Profile,
}

/// Carves a rebuilt room by its capture, in the arena's voxels.
pub(crate) fn carve(dataset: &Dataset, splats: &Splats, arena: &ArenaConfig) -> Carved {
    let grid = BakeSpec::of(arena).grid;
    let voxels = Voxels { min_m: grid.min_m, side_m: grid.voxel_m, size: grid.size };
    vizflyt_twin::carve::carve(dataset, splats, &IN_WORLD, voxels, &CarveOptions::default())
}

/// The room's poses are in the world frame.
const IN_WORLD: Similarity =
    Similarity { scale: 1.0, rotation: DQuat::IDENTITY, translation_m: DVec3::ZERO };

/// Evaluates the rebuilt room; `only` selects the photos.
pub(crate) fn judge(
    splats: &Splats,
    truth: &Splats,
    arena: &ArenaConfig,
    capture: &Capture,
    seen: Option<&Seen>,
    only: impl Fn(usize) -> bool,
) -> Verdict {
    let mut renderer = CpuRenderer::new(splats);
    let mut errors = Vec::new();
    let mut squares = (0.0, 0usize);
    for (_, photo) in capture.photos.iter().enumerate().filter(|(i, _)| only(*i)) {
        let image = render(&mut renderer, capture.intrinsics, photo.world_from_cam);
        squares.0 += (image.rgb.iter().zip(&photo.rgb))
            .map(|(v, t)| f64::from(v.clamp(0.0, 1.0) - f32::from(*t) / 255.0).powi(2))
            .sum::<f64>();
        squares.1 += photo.rgb.len();
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
    let [across, deep, high] = spec.grid.size;
    let voxels = |grid: &OccupancyGrid| {
        let all = (0..across * deep * high).map(|n| [n / (deep * high), n / high % deep, n % high]);
        all.filter(|voxel| grid.is_occupied(*voxel)).collect::<Vec<_>>().into_iter()
    };
    let within = |grid: &OccupancyGrid| {
        let inside = |voxel: &[usize; 3]| {
            let center_m = spec.grid.center_m(*voxel);
            center_m.cmpge(fence.min_m).all() && center_m.cmple(fence.max_m).all()
        };
        voxels(grid).filter(inside).count()
    };
    let beside_seen = |grid: &OccupancyGrid| {
        let beside = |voxel: &[usize; 3]| {
            let around = (0..27).map(|n| [n / 9, n / 3 % 3, n % 3]).map(|offset| {
                std::array::from_fn::<usize, 3, _>(|k| {
                    (voxel[k] + offset[k]).saturating_sub(1).min(spec.grid.size[k] - 1)
                })
            });
            seen.is_some_and(|seen| around.clone().any(|near| seen.is_seen(near)))
        };
        voxels(grid).filter(beside).count() as f64
    };
    let near_m = CarveOptions::default().camera_radius_m;
    let on_way = voxels(&rebuilt)
        .filter(|voxel| {
            let center_m = spec.grid.center_m(*voxel);
            (capture.photos.iter())
                .any(|photo| photo.world_from_cam.translation_m.distance(center_m) < near_m)
        })
        .count();
    Verdict {
        profile: Profile::of(&rebuilt, &right, &spec.grid, capture, fence.max_m.z),
        on_way,
        beside_seen: beside_seen(&rebuilt) / beside_seen(&right),
        psnr_db: -10.0 * (squares.0 / squares.1.max(1) as f64).log10(),
        depth_median: f64::from(errors[errors.len() / 2]),
        within_tenth: share,
        occupied: rebuilt.counts().occupied as f64 / right.counts().occupied as f64,
        within_fence: within(&rebuilt),
        truly_within_fence: within(&right),
    }
}
