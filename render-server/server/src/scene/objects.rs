//! Moving objects of an arena: loading, and baking of their distance fields.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Result, bail};
use glam::{DVec3, Vec3};
use tracing::info;
use vizflyt_arena::grid::Grid;
use vizflyt_arena::objects::MovingObjects;
use vizflyt_arena::obstacles::Obstacles;
use vizflyt_arena::{ArenaConfig, DistanceField, Ellipsoid, OccupancyGrid};
use vizflyt_splat::{RigidObject, Splats};

use super::models::model;

/// Reads an arena's objects, numbered from 1 in its order. Paths are relative to the arena's folder.
pub(super) fn read_all(
    arena: &ArenaConfig,
    arena_toml: &Path,
    read: impl Fn(&Path) -> Result<Splats>,
) -> Result<Vec<RigidObject>> {
    let folder = arena_toml.parent().unwrap_or(Path::new(""));
    let objects = arena.objects.iter().zip(1..);
    let object = |(config, id): (&vizflyt_arena::config::ObjectConfig, u16)| {
        let path = folder.join(&config.scene);
        if !path.exists() {
            // The name of a predefined model determines its splats, so its file is optional.
            if let Some(splats) = model(&config.scene) {
                return Ok(RigidObject { id, splats });
            }
            bail!(
                "the object '{}' of {} is in '{}', but there is no {}; correct its `scene`, or name a \
                 predefined model such as models/gate-120x100.ply",
                config.name,
                arena_toml.display(),
                config.scene,
                path.display()
            );
        }
        Ok(RigidObject { id, splats: read(&path)? })
    };
    objects.map(object).collect()
}

/// Returns all obstacles: the baked static ones, and each object with a field baked in its own frame. Phases
/// that the arena does not set are random, from the seed.
pub fn obstacles(
    arena: &ArenaConfig,
    objects: &[RigidObject],
    still: Arc<DistanceField>,
    seed: u64,
) -> Obstacles {
    let bake = |object: &RigidObject| Arc::new(bake_object(&object.splats, arena));
    let moving: Vec<_> = objects.iter().map(bake).collect();
    if !moving.is_empty() {
        let bytes: usize = moving.iter().map(|field| field.memory_bytes()).sum();
        info!("{} objects baked, {:.1} MB", moving.len(), bytes as f64 / 1e6);
    }
    Obstacles::new(still, moving, MovingObjects::new(arena, seed))
}

/// Returns the corners of a box around an object's splats, to three standard deviations. [m, object]
pub fn bounds_m(splats: &Splats) -> (Vec3, Vec3) {
    let reach = |k: usize| Vec3::splat(3.0 * splats.scales_m[k].max_element());
    let (mut low, mut high) = (Vec3::splat(f32::MAX), Vec3::splat(f32::MIN));
    for (k, &mean_m) in splats.means_m.iter().enumerate() {
        low = low.min(mean_m - reach(k));
        high = high.max(mean_m + reach(k));
    }
    if low.cmple(high).all() { (low, high) } else { (Vec3::ZERO, Vec3::ZERO) }
}

/// Bakes an object's splats in its own frame, with the arena's settings.
pub(crate) fn bake_object(splats: &Splats, arena: &ArenaConfig) -> DistanceField {
    let (low_m, high_m) = bounds_m(splats);
    let (low_m, high_m) = (low_m.as_dvec3() - MARGIN_M, high_m.as_dvec3() + MARGIN_M);
    let of_size = |voxel_m: f64| ((high_m - low_m) / voxel_m).element_product();
    let mut voxel_m = arena.occupancy.voxel_m.min(VOXEL_M);
    if of_size(voxel_m) > MAX_VOXELS {
        voxel_m = ((high_m - low_m).element_product() / MAX_VOXELS).cbrt();
    }
    let grid = Grid::covering(low_m, high_m, voxel_m);
    let ellipsoids = (0..splats.len()).map(|k| Ellipsoid {
        center_m: splats.means_m[k],
        scales_m: splats.scales_m[k],
        rotation: splats.rotations[k],
        opacity: splats.opacities[k],
    });
    let min_opacity = arena.occupancy.min_opacity as f32;
    DistanceField::of(OccupancyGrid::bake_object(ellipsoids, grid, min_opacity))
}

/// Maximum voxel size: finer than a scene's, so that a hand of 3 cm does not grow to 10 cm. [m]
const VOXEL_M: f64 = 0.02;
/// Margin in which the field has the distance to an object; further away, it has a lower bound. [m]
const MARGIN_M: DVec3 = DVec3::splat(0.5);
/// Maximum voxels of an object: 16 MB each. Larger objects get coarser voxels.
const MAX_VOXELS: f64 = 1.6e7;
