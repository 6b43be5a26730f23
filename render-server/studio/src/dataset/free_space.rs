//! Free space of a scene, in which a camera may be.
//!
//! For a generated scene, its true solids define it. For any other scene, the referee's distance field defines it, in
//! which unseen space is solid if the arena says so.

use glam::DVec3;
use vizflyt_arena::Obstacles;
use vizflyt_arena::config::Geofence;
use vizflyt_arena::objects::MovingObjects;
use vizflyt_protocol::geometry::Volume;
use vizflyt_twin::random::Random;

/// Free space within a fence.
#[derive(Debug)]
pub(super) struct FreeSpace {
    pub(super) fence: Geofence,
    /// No-fly volumes. [m, world]
    pub(super) no_fly: Vec<Volume>,
    pub(super) solid: Solid,
}

/// Solid space.
#[derive(Debug)]
pub(super) enum Solid {
    /// True solids; those of objects are in the object's frame.
    True { still: Vec<Volume>, moving: Vec<Vec<Volume>>, objects: MovingObjects },
    /// Obstacles of the referee.
    Baked(Obstacles),
}

impl FreeSpace {
    /// Whether a sphere is free at an instant; false for a NaN position. [m, world; ns]
    pub(super) fn is_free(&self, at_ns: i64, p_m: DVec3, radius_m: f64) -> bool {
        let Geofence { min_m, max_m } = self.fence;
        let room_m = (p_m - min_m).min(max_m - p_m).min_element();
        room_m >= radius_m && self.clearance_m(at_ns, p_m) >= radius_m
    }

    fn clearance_m(&self, at_ns: i64, p_m: DVec3) -> f64 {
        let of = |volume: &Volume| volume.signed_distance_m(p_m);
        let forbidden_m = self.no_fly.iter().map(of).fold(f64::INFINITY, f64::min);
        let solid_m = match &self.solid {
            Solid::True { still, moving, objects } => {
                let mut nearest_m = still.iter().map(of).fold(f64::INFINITY, f64::min);
                for (index, volumes) in moving.iter().enumerate() {
                    let there_m = objects.placement(index, at_ns).inverse().transform_point(p_m);
                    let of = |volume: &Volume| volume.signed_distance_m(there_m);
                    nearest_m = volumes.iter().map(of).fold(nearest_m, f64::min);
                }
                nearest_m
            }
            Solid::Baked(obstacles) => {
                let floor_m = p_m.z - obstacles.still.floor_z_m();
                obstacles.distance_m(at_ns, p_m).min(floor_m)
            }
        };
        forbidden_m.min(solid_m)
    }

    /// Draws a point within the fence, which need not be free. [m, world]
    pub(super) fn draw(&self, random: &mut Random) -> DVec3 {
        let Geofence { min_m, max_m } = self.fence;
        let share = DVec3::from_array([(); 3].map(|()| f64::from(random.unit())));
        min_m + (max_m - min_m) * share
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solids_fence_and_no_fly_volumes_are_not_free() {
        let space = FreeSpace {
            fence: Geofence { min_m: DVec3::ZERO, max_m: DVec3::splat(10.0) },
            no_fly: vec![Volume::aabb(DVec3::splat(8.0), DVec3::splat(9.0))],
            solid: Solid::True {
                still: vec![Volume::Sphere { center_m: DVec3::splat(5.0), radius_m: 1.0 }],
                moving: Vec::new(),
                objects: MovingObjects::default(),
            },
        };
        for (at_m, is_free) in
            [(2.0, true), (0.2, false), (5.5, false), (8.5, false), (f64::NAN, false)]
        {
            assert_eq!(space.is_free(0, DVec3::splat(at_m), 0.3), is_free, "{at_m}");
        }
        assert!(space.is_free(0, DVec3::new(5.0, 5.0, 6.4), 0.3));
        assert!(!space.is_free(0, DVec3::new(5.0, 5.0, 6.2), 0.3));
        let mut random = Random::new(1);
        assert!((0..100).all(|_| space.draw(&mut random).cmpge(DVec3::ZERO).all()));
    }
}
