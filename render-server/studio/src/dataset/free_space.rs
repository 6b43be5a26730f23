//! Where a camera may be: the free space of a scene.
//!
//! Of a generated scene by its true solids; of any other by the distance field that the referee bakes of its splats, where what
//! a capture has not seen is solid if its arena says so.

use glam::DVec3;
use vizflyt_arena::Obstacles;
use vizflyt_arena::config::Geofence;
use vizflyt_arena::objects::MovingObjects;
use vizflyt_protocol::geometry::Volume;
use vizflyt_twin::random::Random;

/// The free space within a fence.
#[derive(Debug)]
pub(super) struct FreeSpace {
    pub(super) fence: Geofence,
    /// What must not be entered though nothing is there. [m, world]
    pub(super) no_fly: Vec<Volume>,
    pub(super) solid: Solid,
}

/// What is not free.
#[derive(Debug)]
pub(super) enum Solid {
    /// True solids; of objects in their own frames.
    True { still: Vec<Volume>, moving: Vec<Vec<Volume>>, objects: MovingObjects },
    /// As the referee has them.
    Baked(Obstacles),
}

impl FreeSpace {
    /// Whether a ball is free at an instant; false for what is no number. [m, world; ns]
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

    /// Draws a point within the fence, free or not. [m, world]
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
    fn solids_fence_and_forbidden_places_are_not_free() {
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
