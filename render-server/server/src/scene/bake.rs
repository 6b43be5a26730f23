//! Obstacles for the referee, from the splats.

use std::time::Instant;

use tracing::info;
use vizflyt_arena::{ArenaConfig, BakeSpec, DistanceField, Ellipsoid, OccupancyGrid};
use vizflyt_splat::Splats;

/// Bakes the obstacles of a scene into a distance field, as its arena asks.
pub fn bake(splats: &Splats, arena: &ArenaConfig) -> DistanceField {
    let start = Instant::now();
    let spec = BakeSpec::of(arena);
    info!("baking obstacles: {} splats into {} voxels", splats.len(), spec.grid.voxels());
    let ellipsoids = (0..splats.len()).map(|k| Ellipsoid {
        center_m: splats.means_m[k],
        scales_m: splats.scales_m[k],
        rotation: splats.rotations[k],
        opacity: splats.opacities[k],
    });
    let grid = OccupancyGrid::bake(ellipsoids, &spec);
    let counts = grid.counts();
    let field = DistanceField::of(grid);
    info!(
        "obstacles baked in {:.0} ms: {} voxels solid, {:.1} MB; left out {} faint or outside \
         splats and {} floating voxels",
        start.elapsed().as_secs_f64() * 1e3,
        counts.occupied,
        field.memory_bytes() as f64 / 1e6,
        counts.splats_left_out,
        counts.floating
    );
    field
}
