//! Compares a method of collision detection with the true geometry of a generated scene.

#![allow(dead_code)] // Why: test and bench use different parts.

use std::ops::Range;

use glam::DVec3;
use vizflyt_arena::occupancy::FLOOR_BAND_M;
use vizflyt_arena::{BakeSpec, DistanceField, Ellipsoid, OccupancyGrid};
use vizflyt_protocol::geometry::Volume;
use vizflyt_scenes::Generated;
use vizflyt_splat::Splats;

/// Radius of the tested body. [m]
pub(crate) const BODY_M: f64 = 0.12;

/// Heights above the litter and below the crowns of the forest, which have leaves that are not true solids. In a hall,
/// this includes everything. [m, world]
pub(crate) const FLOWN_M: Range<f64> = FLOOR_BAND_M + BODY_M..3.0;
/// Heights of the forest's crowns: twigs, some of them thinner than a voxel, between leaves. [m, world]
pub(crate) const CROWNS_M: Range<f64> = 3.0..4.0;

/// Maximum distance of tested positions from a solid. [m]
const NEAR_M: f64 = 0.6;

/// Positions of the body, with the distance to the nearest true surface.
pub(crate) struct Places(Vec<(DVec3, f64)>);

/// Comparison of verdicts with the truth.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Score {
    /// Number of positions with a penetration above the tolerance.
    pub touching: usize,
    /// Number of these that were not detected.
    pub missed: usize,
    /// Number of positions with a clearance above the other tolerance.
    pub clear: usize,
    /// Number of these that were reported as contact.
    pub alarms: usize,
}

impl Places {
    /// Draws positions within the fence, outside of solids but near one. At these heights, the body is above the band
    /// of litter, which counts as floor. [m, world]
    pub(crate) fn draw(scene: &Generated, heights: &Range<f64>, count: usize, seed: u64) -> Self {
        let solids: Vec<_> =
            scene.truth.iter().filter(|v| !matches!(v, Volume::HalfSpace { .. })).collect();
        let fence = scene.arena.geofence();
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let mut places = Vec::with_capacity(count);
        // Bounded, because there may be no near solid in an empty room.
        for _ in 0..1000 * count {
            // Positions are drawn around solids, because most of a forest is air.
            let solid = solids[(next() * solids.len() as f64) as usize];
            let (t, aside) = (next(), DVec3::new(next(), next(), next()) * 2.0 - 1.0);
            let p = match *solid {
                Volume::Sphere { center_m, radius_m } => center_m + aside * (radius_m + NEAR_M),
                Volume::Capsule { a_m, b_m, radius_m } => {
                    a_m.lerp(b_m, t) + aside * (radius_m + NEAR_M)
                }
                Volume::Cuboid { center_m, half_m, rotation } => {
                    center_m + rotation * (aside * (half_m + NEAR_M))
                }
                Volume::HalfSpace { .. } => continue,
            };
            if !heights.contains(&p.z) || fence.signed_distance_m(p) > 0.0 {
                continue;
            }
            let truth = solids.iter().map(|s| s.signed_distance_m(p)).fold(f64::INFINITY, f64::min);
            if (0.0..NEAR_M).contains(&truth) {
                places.push((p, truth));
            }
            if places.len() == count {
                break;
            }
        }
        Self(places)
    }

    /// Counts errors of verdicts: misses with a penetration above `deep_m`, false alarms with a clearance above
    /// `free_m`.
    pub(crate) fn judge(
        &self,
        deep_m: f64,
        free_m: f64,
        mut touches: impl FnMut(DVec3) -> bool,
    ) -> Score {
        let mut score = Score::default();
        for &(p, truth) in &self.0 {
            if truth < BODY_M - deep_m {
                score.touching += 1;
                score.missed += usize::from(!touches(p));
            } else if truth > BODY_M + free_m {
                score.clear += 1;
                score.alarms += usize::from(touches(p));
            }
        }
        score
    }

    pub(crate) fn points(&self) -> impl Iterator<Item = DVec3> {
        self.0.iter().map(|&(p, _)| p)
    }
}

impl Score {
    pub(crate) fn missed_percent(&self) -> f64 {
        100.0 * self.missed as f64 / self.touching.max(1) as f64
    }

    pub(crate) fn alarm_percent(&self) -> f64 {
        100.0 * self.alarms as f64 / self.clear.max(1) as f64
    }
}

/// Bakes a scene with its arena, but another voxel size.
pub(crate) fn bake(scene: &Generated, voxel_m: f64) -> DistanceField {
    let mut arena = scene.arena.clone();
    arena.occupancy.voxel_m = voxel_m;
    DistanceField::of(OccupancyGrid::bake(ellipsoids(&scene.splats), &BakeSpec::of(&arena)))
}

fn ellipsoids(splats: &Splats) -> impl Iterator<Item = Ellipsoid> {
    (0..splats.len()).map(|k| Ellipsoid {
        center_m: splats.means_m[k],
        scales_m: splats.scales_m[k],
        rotation: splats.rotations[k],
        opacity: splats.opacities[k],
    })
}
