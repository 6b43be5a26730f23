//! The arena as far as the autopilot's own fence can express it: FENCE_* for heights and a circle around the start,
//! polygons for the net and for no-fly boxes. A polygon has no height.

use glam::{DVec2, DVec3};
use vizflyt_protocol::geometry::Volume;
use vizflyt_protocol::mavlink::FenceSide;
use vizflyt_protocol::messages::ArenaInfo;

use super::names::{Version, param_spec};
use crate::link::FencePolygon;

/// Cylindrical part of the fence, where it differs from the parameter files.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FenceCylinder {
    /// Maximum height above the take-off point. [m]
    pub ceiling_m: Option<f64>,
    /// Minimum height above the take-off point. [m]
    pub floor_m: Option<f64>,
    /// Maximum distance from the take-off point. [m]
    pub radius_m: Option<f64>,
}

impl FenceCylinder {
    /// Returns the cylinder around the start that contains the arena's fence: the autopilot's own fence acts if the
    /// guard failed, never before the guard. `None` if the fence is not an upright box. `start_m` is in world
    /// coordinates.
    pub fn of(arena: &ArenaInfo, start_m: DVec3) -> Option<Self> {
        let plan = Footprint::of(&arena.geofence)?;
        let from_start_m = |corner_m: DVec2| (corner_m - start_m.truncate()).length();
        let radius_m = plan.corners_m(0.0).into_iter().map(from_start_m).fold(0.0, f64::max);
        Some(Self {
            ceiling_m: Some(below_ceiling_m(arena, plan.top_m) - start_m.z),
            floor_m: Some(arena.floor_z_m + arena.body_radius_m - start_m.z),
            radius_m: Some(radius_m),
        })
    }

    /// Returns this cylinder's value of a parameter; `right`, the value of the file, if it has none.
    pub(super) fn fit(self, version: Version, name: &str, right: f64) -> f64 {
        let measure = match name {
            "FENCE_ALT_MAX" => self.ceiling_m,
            "FENCE_ALT_MIN" => self.floor_m,
            "FENCE_RADIUS" => self.radius_m,
            _ => None,
        };
        let fitted = measure.zip(param_spec(version, name));
        fitted.map_or(right, |(newest, spec)| spec.value_in(version, newest))
    }
}

/// Part of an arena that polygons can express.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AutopilotFence {
    /// The net, and each no-fly box that reaches from the floor to the ceiling; for the body's centre.
    pub polygons: Vec<FencePolygon>,
    /// Indices of no-fly boxes that a vehicle may fly over or under. They are omitted, because a polygon would forbid
    /// that.
    pub omitted: Vec<usize>,
}

impl AutopilotFence {
    /// Returns the polygons of `arena`.
    pub fn of(arena: &ArenaInfo) -> Self {
        let radius_m = arena.body_radius_m;
        let mut fence = Self::default();
        let net = Footprint::of(&arena.geofence).filter(|net| net.half_m.min_element() > radius_m);
        let (mut low_m, mut high_m) = (arena.floor_z_m + radius_m, f64::INFINITY);
        if let Some(net) = &net {
            low_m = low_m.max(net.bottom_m + radius_m);
            high_m = net.top_m - radius_m;
            let corners_m = net.corners_m(-radius_m);
            fence.polygons.push(FencePolygon { side: FenceSide::Inside, corners_m });
        }
        high_m = below_ceiling_m(arena, high_m);
        for (index, volume) in arena.no_fly.iter().enumerate() {
            // The height of the body's centre may be from `low_m` to `high_m`.
            let spans = |plan: &Footprint| {
                plan.bottom_m - radius_m <= low_m && plan.top_m + radius_m >= high_m
            };
            match Footprint::of(volume).filter(spans) {
                Some(plan) => {
                    let corners_m = plan.corners_m(radius_m);
                    fence.polygons.push(FencePolygon { side: FenceSide::Outside, corners_m });
                }
                None => fence.omitted.push(index),
            }
        }
        fence
    }

    /// Returns a warning about the omitted boxes, if there are any.
    pub fn warning(&self, arena: &ArenaInfo) -> Option<String> {
        if self.omitted.is_empty() {
            return None;
        }
        let place = |&index: &usize| {
            let place_m = arena.no_fly.get(index).map_or(DVec2::ZERO, place_m);
            format!("({:.1}, {:.1})", place_m.x, place_m.y)
        };
        let places: Vec<_> = self.omitted.iter().map(place).collect();
        Some(format!(
            "the autopilot's own fence does not contain the no-fly boxes at {}: one can fly over or under \
             them, and its polygons have no height; guard and referee check them",
            places.join(", ")
        ))
    }
}

/// Footprint of an upright box.
struct Footprint {
    center_m: DVec2,
    /// Half lengths of the sides along `axis` and across it. [m]
    half_m: DVec2,
    axis: DVec2,
    bottom_m: f64,
    top_m: f64,
}

impl Footprint {
    fn of(volume: &Volume) -> Option<Self> {
        let Volume::Cuboid { center_m, half_m, rotation } = *volume else { return None };
        let is_upright = (rotation * DVec3::Z).z.abs() > 1.0 - UPRIGHT;
        let axis = (rotation * DVec3::X).truncate().try_normalize()?;
        is_upright.then(|| Self {
            center_m: center_m.truncate(),
            half_m: half_m.truncate(),
            axis,
            bottom_m: center_m.z - half_m.z,
            top_m: center_m.z + half_m.z,
        })
    }

    /// Returns the corners after growing each side by `grown_m`. [m, world]
    fn corners_m(&self, grown_m: f64) -> Vec<DVec2> {
        let half_m = self.half_m + grown_m;
        let (along, across) = (self.axis * half_m.x, self.axis.perp() * half_m.y);
        let corners_m = [-along - across, along - across, along + across, across - along];
        corners_m.map(|corner_m| self.center_m + corner_m).to_vec()
    }
}

/// Maximum tilt of an upright box, as 1 - cos: 0.1 degrees.
const UPRIGHT: f64 = 1.5e-6;

/// Returns the lower of `top_m` and the arena's ceiling. [m, world]
fn below_ceiling_m(arena: &ArenaInfo, top_m: f64) -> f64 {
    arena.limits.max_altitude_m.map_or(top_m, |max_m| max_m.min(top_m))
}

/// Returns the floor position that a message gives for a volume. [m, world]
fn place_m(volume: &Volume) -> DVec2 {
    match *volume {
        Volume::Sphere { center_m, .. } | Volume::Cuboid { center_m, .. } => center_m.truncate(),
        Volume::Capsule { a_m, b_m, .. } => a_m.midpoint(b_m).truncate(),
        Volume::HalfSpace { normal, offset_m } => (normal * offset_m).truncate(),
    }
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;

    fn arena() -> ArenaInfo {
        let mut arena = crate::flight::tests::arena();
        arena.geofence = Volume::aabb(DVec3::new(0.0, -3.0, -0.5), DVec3::new(5.0, 2.0, 3.6));
        arena.limits.max_altitude_m = Some(2.6);
        arena
    }

    fn with_box(min_m: DVec3, max_m: DVec3) -> ArenaInfo {
        let mut arena = arena();
        arena.no_fly.push(Volume::aabb(min_m, max_m)).unwrap();
        arena
    }

    #[test]
    fn cylinder_contains_the_arenas_fence() {
        // The furthest corner is 4 m east and 3 m south.
        let cylinder = FenceCylinder::of(&arena(), DVec3::new(1.0, 0.0, 0.1)).unwrap();
        let close = |value: Option<f64>, right: f64| (value.unwrap() - right).abs() < 1e-9;
        assert!(close(cylinder.ceiling_m, 2.5) && close(cylinder.radius_m, 5.0), "{cylinder:?}");
        assert!(close(cylinder.floor_m, 0.0), "{cylinder:?}");
    }

    #[test]
    fn net_becomes_a_polygon_for_the_bodys_centre() {
        let fence = AutopilotFence::of(&arena());
        let corners_m = [(0.1, -2.9), (4.9, -2.9), (4.9, 1.9), (0.1, 1.9)];
        let [net] = &fence.polygons[..] else { panic!("{fence:?}") };
        assert_eq!(net.side, FenceSide::Inside);
        for (corner_m, right) in net.corners_m.iter().zip(corners_m) {
            assert!((*corner_m - DVec2::from(right)).length() < 1e-9, "{corner_m}");
        }
        assert_eq!(fence.warning(&arena()), None);
    }

    #[test]
    fn omits_boxes_that_a_vehicle_can_fly_over_or_under() {
        let check = |bottom_m: f64, top_m: f64, sent: bool| {
            let (min_m, max_m) = (DVec3::new(2.0, -1.0, bottom_m), DVec3::new(3.0, 1.0, top_m));
            let arena = with_box(min_m, max_m);
            let fence = AutopilotFence::of(&arena);
            assert_eq!(fence.omitted.is_empty(), sent, "{bottom_m} to {top_m}");
            assert_eq!(fence.polygons.len(), 1 + usize::from(sent));
            assert_eq!(fence.warning(&arena).is_none(), sent);
        };
        // The height of the body's centre may be from 0.1 m to 2.6 m; its radius is 0.1 m.
        check(0.0, 3.6, true);
        check(0.0, 2.55, true);
        check(0.19, 3.6, true);
        check(0.0, 0.9, false);
        check(1.5, 3.6, false);
        let table = with_box(DVec3::new(4.0, 1.0, 0.0), DVec3::new(4.6, 1.6, 0.9));
        let text = AutopilotFence::of(&table).warning(&table).unwrap();
        assert!(text.contains("at (4.3, 1.3)"), "{text}");
    }

    #[test]
    fn rotated_boxes_must_be_upright() {
        let turned = |rotation| {
            let mut arena = arena();
            let (center_m, half_m) = (DVec3::new(2.0, 0.0, 1.5), DVec3::new(1.0, 0.2, 2.5));
            arena.no_fly.push(Volume::Cuboid { center_m, half_m, rotation }).unwrap();
            AutopilotFence::of(&arena)
        };
        let fence = turned(DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2));
        let first_m = fence.polygons[1].corners_m[0];
        assert!((first_m - DVec2::new(2.3, -1.1)).length() < 1e-9, "{first_m}");
        assert_eq!(turned(DQuat::from_rotation_x(0.1)).omitted, [0]);
        let mut arena = arena();
        arena.geofence = Volume::Sphere { center_m: DVec3::ZERO, radius_m: 3.0 };
        assert_eq!(AutopilotFence::of(&arena), AutopilotFence::default());
    }
}
