//! Last stage: removes splats that contradict the capture, creates an arena around the seen space, and checks whether
//! it can be flown.

use std::path::Path;

use anyhow::{Context, Result};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use vizflyt_arena::check::check_start;
use vizflyt_arena::config::{Spawn, Unseen};
use vizflyt_arena::seen::ScenePlace;
use vizflyt_arena::{ArenaConfig, BakeSpec, Obstacles, SeenSpace};
use vizflyt_server::scene::{
    BakeCache, Seen as SeenPlace, bake_with, bounds, check_fit, core, default_arena, scene_hash,
    seen_path,
};
use vizflyt_splat::{Splats, format};
use vizflyt_twin::Dataset;
use vizflyt_twin::align::Similarity;
use vizflyt_twin::align::level::{self, Held};
use vizflyt_twin::carve::{CarveOptions, Seen, Voxels, carve};

use super::metric::{Metric, Placed};
use super::unseen::{Area, areas};

/// Result of the stage, in addition to `scene.ply` and `arena.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Finished {
    /// Number of remaining splats.
    pub(super) splats: usize,
    /// Number of removed splats: photos look through them, or they are on the camera's path.
    pub(super) carved: usize,
    /// Share of the fence's voxels that photos look through.
    pub(super) seen_share: f64,
    /// Unseen areas at the heights of flight, the largest first.
    pub(super) unseen: Vec<Area>,
    /// Number of solid voxels.
    pub(super) solid_voxels: usize,
    pub(super) voxel_m: f64,
    /// Number of camera positions within solid voxels.
    pub(super) solid_on_way: usize,
    /// Minimum corner of the fence. [m, world]
    pub(super) fence_min_m: DVec3,
    /// Maximum corner of the fence. [m, world]
    pub(super) fence_max_m: DVec3,
    /// [m, world]
    pub(super) spawn_m: DVec3,
    /// Problems that prevent a flight, in words.
    pub(super) findings: Vec<String>,
}

/// Carves and prunes the scene, and writes its arena.
pub(super) fn finish(
    name: &str,
    dataset: &Dataset,
    trained: &Path,
    metric: &Metric,
    folder: &Path,
) -> Result<Finished> {
    let splats = read(trained)?;
    let ways: Vec<DVec3> = metric.way.iter().map(|placed| placed.position_m).collect();
    let carved =
        carve(dataset, &splats, &IDENTITY, region(&splats, &ways), &CarveOptions::default());
    let floor_m = floor(dataset, metric);
    let mut arena = default_arena(&carved.splats, "scene.ply")?;
    name.clone_into(&mut arena.name);
    arena.occupancy.floor_z_m = to_cm(floor_m);
    let [min_m, max_m] = fence(&carved.seen, floor_m, &ways);
    arena.geofence.min_m = min_m;
    arena.geofence.max_m = max_m;
    let path = folder.join("scene.ply");
    format::write(&path, &carved.splats)?;
    let spec = BakeSpec::of(&arena);
    let grid = spec.grid;
    let voxels = Voxels { min_m: grid.min_m, side_m: grid.voxel_m, size: grid.size };
    let seen = carve(dataset, &carved.splats, &IDENTITY, voxels, &CarveOptions::default()).seen;
    let hash = scene_hash(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let place = ScenePlace::of(&arena.scene);
    let space = SeenSpace::new(grid, place, hash, seen.bits);
    std::fs::write(seen_path(&path), space.to_bytes()).context("cannot write scene.ply.seen")?;
    arena.occupancy.unseen = Unseen::Solid;
    let seen = SeenPlace { space, place };
    let cache = BakeCache::of_user();
    let baked = bake_with(&carved.splats, &spec, Some(&seen), cache.as_ref(), &|_| ());
    let solid_voxels = baked.field.occupied_voxels();
    let on_way = ways.iter().filter(|p| baked.field.obstacle_distance_m(**p) < 0.0).count();
    let fit = check_fit(&carved.splats, &arena, &baked.field);
    let obstacles = Obstacles::from(baked.field);
    // Start at the position of the path with the most free space from which the vehicle can climb.
    let mut starts = starts(&metric.way, floor_m, &carved.seen, &arena, &obstacles);
    starts.truncate(STARTS);
    let mut first = None;
    for start in &starts {
        arena.spawn = *start;
        let against = check_start(&arena, &obstacles);
        if against.is_empty() {
            first = None;
            break;
        }
        first.get_or_insert((*start, against));
    }
    let mut findings: Vec<String> = fit.iter().map(ToString::to_string).collect();
    if let Some((start, against)) = first {
        arena.spawn = start;
        findings.extend(against.iter().map(ToString::to_string));
    }
    arena.validate().context("cannot create a valid arena for the capture")?;
    let text = format!("{HEAD}{}", arena.to_toml()?);
    ArenaConfig::parse(&text).context("the arena would not be read again")?;
    std::fs::write(folder.join("arena.toml"), text).context("cannot write arena.toml")?;
    Ok(Finished {
        splats: carved.splats.len(),
        carved: carved.kept.iter().filter(|kept| !**kept).count(),
        seen_share: share_within(&carved.seen, min_m, max_m),
        unseen: {
            let top_m = max_m.z.min(floor_m + HIGH_M);
            let (low_m, high_m) = (min_m.with_z(floor_m + LOW_M), max_m.with_z(top_m));
            areas(low_m, high_m, |low, high| share_within(&carved.seen, low, high))
        },
        solid_voxels,
        voxel_m: arena.occupancy.voxel_m,
        solid_on_way: on_way,
        fence_min_m: min_m,
        fence_max_m: max_m,
        spawn_m: arena.spawn.position_m,
        findings,
    })
}

fn read(trained: &Path) -> Result<Splats> {
    let path = trained.join("scene.ply");
    Ok(format::read(&path).with_context(|| format!("cannot read {}", path.display()))?.splats)
}

/// Returns the voxels around the scene's core and the camera's path.
fn region(splats: &Splats, ways: &[DVec3]) -> Voxels {
    let [min_m, max_m] = bounds(core(splats, |mean| mean));
    let low_m = ways.iter().fold(min_m, |low, p| low.min(*p)) - REGION_M;
    let high_m = ways.iter().fold(max_m, |high, p| high.max(*p)) + REGION_M;
    let span_m = (high_m - low_m).max(DVec3::splat(0.1));
    let side_m = (span_m.element_product() / MOST_VOXELS).cbrt().max(LEAST_SIDE_M);
    let size = (span_m / side_m).ceil().to_array().map(|n| (n as usize).max(1));
    Voxels { min_m: low_m, side_m, size }
}

/// Returns the height of the floor: that of the capture if it is found near z = 0, otherwise 0. [m, world]
fn floor(dataset: &Dataset, metric: &Metric) -> f64 {
    let points: Vec<DVec3> = dataset.points.iter().map(|point| point.position.as_dvec3()).collect();
    let held = metric.way.iter().map(|placed| Held { position: placed.position_m, up: DVec3::Z });
    let found = level::find(&points, &held.collect::<Vec<_>>());
    found.filter(|level| level.up.z > FLAT_COS).map_or(0.0, |level| level.height)
}

/// Returns the box around the seen voxels at the heights of flight, without the outermost few, and around the camera's
/// path. [m, world]
fn fence(seen: &Seen, floor_m: f64, ways: &[DVec3]) -> [DVec3; 2] {
    let mut along: [Vec<f64>; 3] = Default::default();
    each_seen(seen, |p| {
        if (floor_m + LOW_M..=floor_m + HIGH_M).contains(&p.z) {
            for (along, value) in along.iter_mut().zip(p.to_array()) {
                along.push(value);
            }
        }
    });
    let mut min_m = ways.iter().fold(DVec3::INFINITY, |low, p| low.min(*p)) - BODY_M;
    let mut max_m = ways.iter().fold(DVec3::NEG_INFINITY, |high, p| high.max(*p)) + BODY_M;
    if !along[0].is_empty() {
        let ends = along.each_mut().map(|along| {
            along.sort_by(f64::total_cmp);
            let off = (along.len() as f64 * OUTER) as usize;
            [along[off], along[along.len() - 1 - off]]
        });
        min_m = min_m.min(DVec3::from_array(ends.map(|end| end[0])));
        max_m = max_m.max(DVec3::from_array(ends.map(|end| end[1])));
    }
    min_m.z = floor_m - BELOW_FLOOR_M;
    [min_m, max_m].map(|p| DVec3::from_array(p.to_array().map(to_cm)))
}

/// Returns candidates for the start: on the floor below the camera's path, in the camera's heading, those with the most
/// free space first.
fn starts(
    way: &[Placed],
    floor_m: f64,
    seen: &Seen,
    arena: &ArenaConfig,
    obstacles: &Obstacles,
) -> Vec<Spawn> {
    let top_m = arena.takeoff_height_m + arena.body_radius_m;
    let mut starts: Vec<(f64, Spawn)> = way
        .iter()
        .map(|placed| {
            let position_m = DVec3::new(placed.position_m.x, placed.position_m.y, floor_m);
            let climb = (1..=4).map(|k| position_m + DVec3::Z * (top_m * f64::from(k) / 4.0));
            let room_m = climb
                .map(|p| obstacles.still.obstacle_distance_m(p).min(beside_m(arena, p)))
                .fold(f64::INFINITY, f64::min);
            let seen = share_within(seen, position_m - AROUND_M, position_m + AROUND_M + DVec3::Z);
            let yaw_deg = placed.ahead.y.atan2(placed.ahead.x).to_degrees().round();
            let position_m = DVec3::from_array(position_m.to_array().map(to_cm));
            (room_m.min(ROOM_M) + seen, Spawn { position_m, yaw_deg })
        })
        .collect();
    starts.sort_by(|a, b| b.0.total_cmp(&a.0));
    starts.into_iter().map(|(_, start)| start).collect()
}

/// Returns the horizontal distance to the nearest side of the fence. [m]
fn beside_m(arena: &ArenaConfig, p: DVec3) -> f64 {
    let fence = &arena.geofence;
    (p - fence.min_m).truncate().min((fence.max_m - p).truncate()).min_element()
}

fn each_seen(seen: &Seen, mut take: impl FnMut(DVec3)) {
    let [nx, ny, nz] = seen.voxels.size;
    for x in 0..nx {
        for y in 0..ny {
            for z in 0..nz {
                if seen.is_seen([x, y, z]) {
                    take(seen.voxels.center_m([x, y, z]));
                }
            }
        }
    }
}

/// Returns the share of a box's voxels that were seen; space outside of the grid counts as unseen.
fn share_within(seen: &Seen, min_m: DVec3, max_m: DVec3) -> f64 {
    let voxels = &seen.voxels;
    let index = |p: DVec3| ((p - voxels.min_m) / voxels.side_m).floor();
    let (low, high) = (index(min_m), index(max_m) + 1.0);
    let all = (high - low).max(DVec3::ZERO).element_product();
    let clamp = |p: DVec3| -> [usize; 3] {
        std::array::from_fn(|k| p[k].clamp(0.0, voxels.size[k] as f64) as usize)
    };
    let ([x0, y0, z0], [x1, y1, z1]) = (clamp(low), clamp(high));
    let mut count = 0usize;
    for x in x0..x1 {
        for y in y0..y1 {
            count += (z0..z1).filter(|&z| seen.is_seen([x, y, z])).count();
        }
    }
    if all > 0.0 { count as f64 / all } else { 0.0 }
}

fn to_cm(value: f64) -> f64 {
    (value * 100.0).round() / 100.0
}

const HEAD: &str = "\
# Written by `vizflyt scene capture`: the fence surrounds the seen space, the start lies on the camera's path.
# Add [goal] and [[stages]]: docs/guides/scenes.md, course.md. Repeating the capture keeps your edits of this file.
";
const IDENTITY: Similarity =
    Similarity { scale: 1.0, rotation: glam::DQuat::IDENTITY, translation_m: DVec3::ZERO };
/// Margin around core and path. [m]
const REGION_M: f64 = 0.5;
/// Maximum number of voxels: 5 MB of bits, some seconds of ray casting.
const MOST_VOXELS: f64 = 4e7;
/// Minimum side of a voxel; obstacles are not baked at a higher resolution. [m]
const LEAST_SIDE_M: f64 = 0.05;
/// cos(2 degrees): a plane with more tilt is not the floor of an upright world.
const FLAT_COS: f64 = 0.999_390_827_019_095_7;
/// Heights of flight above the floor. [m]
const LOW_M: f64 = 0.3;
const HIGH_M: f64 = 3.0;
/// Share of the seen voxels outside the fence, at each end of an axis.
const OUTER: f64 = 0.02;
/// Half a vehicle plus clearance. [m]
const BODY_M: f64 = 0.4;
/// Depth of the fence below the floor. [m]
const BELOW_FLOOR_M: f64 = 0.5;
/// Half size of the area around a start that should be seen. [m]
const AROUND_M: DVec3 = DVec3::new(0.8, 0.8, 0.0);
/// Free space beyond this does not improve a start. [m]
const ROOM_M: f64 = 1.5;
/// Maximum number of tested starts.
const STARTS: usize = 20;

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a grid of 10 x 10 x 10 voxels of 1 m, with the lower half seen.
    fn lower_half() -> Seen {
        let voxels = Voxels { min_m: DVec3::ZERO, side_m: 1.0, size: [10; 3] };
        let mut bits = vec![0u8; 125];
        for at in (0..1000).filter(|at| at % 10 < 5) {
            bits[at / 8] |= 1 << (at % 8);
        }
        Seen { voxels, bits }
    }

    #[test]
    fn counts_space_outside_of_the_grid_as_unseen() {
        let seen = lower_half();
        let share =
            |low: f64, high: f64| share_within(&seen, DVec3::splat(low), DVec3::splat(high));
        assert_eq!(share(0.0, 9.5), 0.5);
        assert_eq!(share(0.5, 3.5), 1.0);
        assert_eq!(share(20.0, 30.0), 0.0);
        assert!((share(-10.0, 9.5) - 0.5 / 8.0).abs() < 1e-9);
    }

    #[test]
    fn the_fence_contains_seen_space_and_path() {
        let [min_m, max_m] = fence(&lower_half(), 1.0, &[DVec3::new(12.0, 5.0, 2.5)]);
        assert!(min_m.x < 0.6 && min_m.z == 0.5, "{min_m}");
        assert_eq!(max_m.x, 12.4);
        assert!(max_m.y > 9.4 && max_m.z <= 4.0, "{max_m}");
        // Nothing seen: only the path.
        let nothing = Seen { bits: vec![0; 125], ..lower_half() };
        let [min_m, max_m] = fence(&nothing, 0.0, &[DVec3::new(1.0, 1.0, 1.4)]);
        assert_eq!((min_m, max_m), (DVec3::new(0.6, 0.6, -0.5), DVec3::new(1.4, 1.4, 1.8)));
    }
}
