//! Baked light of the hall: ceiling tubes with soft shadows, sun through the windows, and light reflected by walls and
//! floor.

use glam::{DMat3, DVec2, DVec3};
use vizflyt_protocol::geometry::Volume;

use super::dimensions::{HALL_MAX_M, HALL_MIN_M, LAMPS_M, TUBE_HALF_M, WINDOWS};
use crate::random::Rng;
use crate::solids::Solids;

/// Light that leaves surfaces in the hall.
#[derive(Debug)]
pub(crate) struct HallLight<'a> {
    solids: &'a Solids,
    casters: Vec<Caster>,
    /// Unit direction towards the sun. [world]
    sun: DVec3,
}

impl<'a> HallLight<'a> {
    /// Prepares the light; `casters` cast shadows.
    pub(crate) fn new(solids: &'a Solids, casters: &[Volume], sun: DVec3) -> Self {
        Self { solids, casters: casters.iter().filter_map(Caster::new).collect(), sun }
    }

    /// Returns the light that leaves a matt surface at a point of the true surface.
    pub(crate) fn matt(&self, p_m: DVec3, normal: DVec3, albedo: DVec3, rng: &mut Rng) -> DVec3 {
        let from_m = p_m + normal * 0.02;
        let mut light = DVec3::ZERO;
        for lamp in LAMPS_M {
            // Two random points of the tube: averaged over many patches, they give a penumbra.
            for _ in 0..2 {
                let along = rng.spread(TUBE_HALF_M);
                let tube_m = DVec3::new(lamp.x + along, lamp.y, HALL_MAX_M.z - 0.1);
                let way = tube_m - from_m;
                let length_m = way.length();
                let toward = way / length_m;
                let facing = normal.dot(toward).max(0.0) * toward.z.max(0.0).sqrt();
                if facing > 0.0 && !self.is_blocked(from_m, toward, length_m) {
                    light += TUBE * (facing / (3.0 + length_m * length_m));
                }
            }
        }
        let facing = normal.dot(self.sun);
        if facing > 0.0 && self.sun_enters(from_m) && !self.is_blocked(from_m, self.sun, 30.0) {
            light += SUN * facing;
        }
        // Ceiling and walls are pale, so that shade is never black; the window side is cooler.
        let up = 0.5 + 0.5 * normal.z;
        let window = 0.5 + 0.5 * normal.y;
        let about = BOUNCE * (0.75 + 0.25 * up) + WINDOW * (0.3 + 0.7 * window);
        albedo * (light + about * self.solids.openness(p_m, normal))
    }

    fn sun_enters(&self, p_m: DVec3) -> bool {
        let t = (HALL_MAX_M.y - p_m.y) / self.sun.y;
        if t <= 0.0 {
            return false;
        }
        let q = p_m + self.sun * t;
        let at = DVec2::new(q.x - HALL_MIN_M.x, q.z);
        WINDOWS.iter().any(|window| window.is_pane(at))
    }

    fn is_blocked(&self, from_m: DVec3, toward: DVec3, length_m: f64) -> bool {
        self.casters.iter().any(|caster| caster.crosses(from_m, toward, length_m))
    }
}

/// Box that casts shadows.
#[derive(Debug)]
struct Caster {
    center_m: DVec3,
    half_m: DVec3,
    axes_from_world: DMat3,
    reach_m: f64,
}

impl Caster {
    /// Returns the caster of a box; `None` for other shapes, which cast no shadows.
    fn new(volume: &Volume) -> Option<Self> {
        let Volume::Cuboid { center_m, half_m, rotation } = *volume else { return None };
        let axes_from_world = DMat3::from_quat(rotation.conjugate());
        Some(Self { center_m, half_m, axes_from_world, reach_m: half_m.length() })
    }

    /// Whether a ray hits the box within a length.
    fn crosses(&self, from_m: DVec3, toward: DVec3, length_m: f64) -> bool {
        let to_center = self.center_m - from_m;
        let along = to_center.dot(toward);
        let off_squared = to_center.length_squared() - along * along;
        if off_squared > self.reach_m * self.reach_m || along < -self.reach_m {
            return false;
        }
        // Slab test in the box's axes (Kay and Kajiya 1986).
        let from = self.axes_from_world * -to_center;
        let step = self.axes_from_world * toward;
        let (mut enter, mut leave) = (0.0, length_m);
        for axis in 0..3 {
            if step[axis].abs() < 1e-12 {
                if from[axis].abs() > self.half_m[axis] {
                    return false;
                }
                continue;
            }
            let a = (-self.half_m[axis] - from[axis]) / step[axis];
            let b = (self.half_m[axis] - from[axis]) / step[axis];
            enter = f64::max(enter, a.min(b));
            leave = f64::min(leave, a.max(b));
        }
        enter < leave
    }
}

const TUBE: DVec3 = DVec3::new(3.7, 3.55, 3.25);
const SUN: DVec3 = DVec3::new(3.0, 2.5, 1.75);
const BOUNCE: DVec3 = DVec3::new(0.36, 0.345, 0.315);
const WINDOW: DVec3 = DVec3::new(0.14, 0.17, 0.21);

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    #[test]
    fn a_ray_hits_only_boxes_on_its_path() {
        let block = Volume::Cuboid {
            center_m: DVec3::new(2.0, 0.0, 0.0),
            half_m: DVec3::new(0.1, 0.5, 0.5),
            rotation: DQuat::from_rotation_z(0.3),
        };
        let caster = Caster::new(&block).unwrap();
        let crosses = |from, toward, length| caster.crosses(from, toward, length);
        assert!(crosses(DVec3::ZERO, DVec3::X, 3.0));
        assert!(!crosses(DVec3::ZERO, DVec3::X, 1.5), "the ray ends before the box");
        assert!(!crosses(DVec3::ZERO, DVec3::NEG_X, 3.0), "the box is behind");
        assert!(!crosses(DVec3::new(0.0, 0.7, 0.0), DVec3::X, 3.0), "the ray misses the box");
    }
}
