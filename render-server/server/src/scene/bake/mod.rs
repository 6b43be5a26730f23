//! Obstacles for the referee, baked from the splats and cached for the next start.

mod cache;
#[cfg(test)]
mod tests;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use tracing::{info, warn};
use vizflyt_arena::occupancy::BakeCounts;
use vizflyt_arena::{ArenaConfig, BakeSpec, DistanceField, Ellipsoid, OccupancyGrid};
use vizflyt_splat::Splats;

use super::seen::Seen;

use cache::CachedField;
pub use cache::{BakeCache, BakeKey, parse as parse_kept};

/// Result of a bake.
#[derive(Debug)]
pub struct Baked {
    pub field: DistanceField,
    /// Statistics of the baker; `None` if the obstacles came from the cache.
    pub counts: Option<BakeCounts>,
    /// Path in the cache.
    pub kept_at: Option<PathBuf>,
    /// Duration of the bake.
    pub took: Duration,
}

/// Returns the obstacles of a scene with the settings of its arena, from the cache or newly baked. If `seen` is
/// given, all other space is solid.
pub fn bake(splats: &Splats, arena: &ArenaConfig, seen: Option<&Seen>) -> DistanceField {
    let spec = BakeSpec::of(arena);
    info!("baking obstacles: {} splats into {} voxels", splats.len(), spec.grid.voxels());
    let baked = bake_with(splats, &spec, seen, BakeCache::of_user().as_ref(), &|_| ());
    let took_ms = baked.took.as_secs_f64() * 1e3;
    match (&baked.counts, &baked.kept_at) {
        (None, Some(path)) => info!("obstacles read in {took_ms:.0} ms from {}", path.display()),
        (Some(counts), _) => info!(
            "obstacles baked in {took_ms:.0} ms: {} voxels solid, {} of them unseen, {:.1} MB; left out {} \
             faint or outside splats and {} floating voxels",
            counts.occupied,
            counts.unseen,
            baked.field.memory_bytes() as f64 / 1e6,
            counts.splats_left_out,
            counts.floating
        ),
        (None, None) => {}
    }
    baked.field
}

/// Returns the obstacles of splats, from `cache` or newly baked and stored. If `seen` is given, all other space
/// is solid. `progress` receives the completed share, 0 to 1, from any thread.
pub fn bake_with(
    splats: &Splats,
    spec: &BakeSpec,
    seen: Option<&Seen>,
    cache: Option<&BakeCache>,
    progress: &(dyn Fn(f64) + Sync),
) -> Baked {
    let start = Instant::now();
    let key = cache.map(|cache| (cache, BakeKey::of(splats, spec, seen)));
    if let Some((cache, key)) = &key {
        match cache.read(key) {
            CachedField::Field(field) => {
                progress(1.0);
                let kept_at = Some(cache.path(key));
                return Baked { field, counts: None, kept_at, took: start.elapsed() };
            }
            CachedField::Nothing => {}
            CachedField::Broken(why) => {
                warn!(
                    "{} is invalid, so the obstacles are baked again: {why}",
                    cache.path(key).display()
                );
            }
        }
    }
    let ellipsoids = (0..splats.len()).map(|k| Ellipsoid {
        center_m: splats.means_m[k],
        scales_m: splats.scales_m[k],
        rotation: splats.rotations[k],
        opacity: splats.opacities[k],
    });
    let seen = seen.map(|seen| seen.space.at(&seen.place));
    let progress_of_grid = |share| progress(GRID_SHARE * share);
    let grid = OccupancyGrid::bake_with(ellipsoids, spec, seen, &progress_of_grid);
    let counts = Some(grid.counts());
    let field = DistanceField::of(grid);
    let kept_at = key.and_then(|(cache, key)| match cache.write(&key, &field) {
        Ok(path) => Some(path),
        Err(error) => {
            warn!("cannot store the baked obstacles: {}: {error}", cache.path(&key).display());
            None
        }
    });
    progress(1.0);
    Baked { field, counts, kept_at, took: start.elapsed() }
}

/// Share of the grid in the work; the rest is the distance transform.
const GRID_SHARE: f64 = 0.7;
