//! Obstacles, fixed and moving, each with its own distance field.
//!
//! A field moves with its object: a point of the world is transformed into the object's frame at that instant
//! and looked up there. Between two poses both move, so the sweep is of the body against the object: no points
//! of the two approach each other by more than the body's motion plus the object's, including its turn. Budget:
//! 2 us per moving object and pose, most of it one query in open space.

use std::sync::Arc;

use glam::DVec3;
use vizflyt_protocol::geometry::{Body, Object, Pose, World};

use crate::body::BodyShape;
use crate::collision::{Sweep, advance, least_step_m, sweep};
use crate::distance::DistanceField;
use crate::objects::{MovingObjects, TopSpeed};

/// Obstacles of an arena; shared by the referees of its vehicles.
#[derive(Clone, Debug)]
pub struct Obstacles {
    /// Fixed obstacles.
    pub still: Arc<DistanceField>,
    /// Field of each of `objects`, including fixed ones, in its own frame. [m, object]
    pub moving: Vec<Arc<DistanceField>>,
    /// Poses of the objects over time.
    pub objects: MovingObjects,
}

impl From<Arc<DistanceField>> for Obstacles {
    fn from(still: Arc<DistanceField>) -> Self {
        Self { still, moving: Vec::new(), objects: MovingObjects::default() }
    }
}

impl From<DistanceField> for Obstacles {
    fn from(still: DistanceField) -> Self {
        Arc::new(still).into()
    }
}

/// Pose of a body with its time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimedPose {
    /// Time since the arena's epoch. [ns]
    pub since_epoch_ns: i64,
    pub world_from_body: Pose<World, Body>,
}

/// First obstacle that was touched.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Touched {
    /// A fixed obstacle.
    Still,
    /// The object with this index.
    Object(usize),
}

impl Obstacles {
    /// Combines fields and objects.
    ///
    /// # Panics
    /// If the numbers of fields and objects differ.
    pub fn new(
        still: Arc<DistanceField>,
        moving: Vec<Arc<DistanceField>>,
        objects: MovingObjects,
    ) -> Self {
        assert_eq!(moving.len(), objects.len(), "one field for each object");
        Self { still, moving, objects }
    }

    /// Returns the fixed obstacles and the objects with these indices.
    #[must_use]
    pub fn select(&self, indices: &[usize]) -> Self {
        let fields = indices.iter().map(|&index| self.moving[index].clone()).collect();
        Self::new(self.still.clone(), fields, self.objects.select(indices))
    }

    /// Returns the distance from a point to the nearest obstacle at an instant, without the floor. It exceeds
    /// the true distance at most by the rounding of a field. [m, world; ns]
    pub fn distance_m(&self, since_epoch_ns: i64, p_world_m: DVec3) -> f64 {
        // Not `min`, which would drop a NaN.
        let still_m = self.still.obstacle_distance_m(p_world_m);
        let moving_m = self.moving_distance_m(since_epoch_ns, p_world_m);
        if still_m.is_nan() || still_m < moving_m { still_m } else { moving_m }
    }

    /// Same as [`Self::distance_m`], only for objects; infinite without objects. [m, world; ns]
    pub fn moving_distance_m(&self, since_epoch_ns: i64, p_world_m: DVec3) -> f64 {
        let mut nearest_m = f64::INFINITY;
        for (index, field) in self.moving.iter().enumerate() {
            let placement = self.objects.placement(index, since_epoch_ns);
            let found_m = distance_to_m(field, &placement, p_world_m);
            // Not `min`, which would drop a NaN.
            nearest_m = if nearest_m.is_nan() || nearest_m < found_m { nearest_m } else { found_m };
        }
        nearest_m
    }

    /// Sweeps a body from one timed pose to the next, against all obstacles. Returns the minimum clearance over
    /// all, the first contact, and the obstacle touched.
    pub fn sweep(&self, body: &BodyShape, from: &TimedPose, to: &TimedPose) -> (Sweep, Touched) {
        let mut found = sweep(&self.still, body, &from.world_from_body, &to.world_from_body);
        let mut touched = Touched::Still;
        for (index, field) in self.moving.iter().enumerate() {
            let other = self.sweep_object(index, field, body, from, to);
            found.clearance_m = found.clearance_m.min(other.clearance_m);
            let first = found.contact.map_or(f64::INFINITY, |contact| contact.fraction);
            if let Some(contact) = other.contact.filter(|contact| contact.fraction < first) {
                found.contact = Some(contact);
                touched = Touched::Object(index);
            }
        }
        (found, touched)
    }

    fn sweep_object(
        &self,
        index: usize,
        field: &DistanceField,
        body: &BodyShape,
        from: &TimedPose,
        to: &TimedPose,
    ) -> Sweep {
        let (a, b) = (&from.world_from_body, &to.world_from_body);
        let took_ns = to.since_epoch_ns.saturating_sub(from.since_epoch_ns).max(0);
        let took_s = took_ns as f64 * 1e-9;
        let TopSpeed { linear_mps, angular_radps } = self.objects.top_speed(index);
        let body_m = body.motion_m(a, b);
        let origin_m = self.objects.placement(index, from.since_epoch_ns).translation_m;
        // Maximum distance of any point of the body from the object's origin.
        let reach_m =
            (a.translation_m - origin_m).length() + body.radius_m() + body_m + linear_mps * took_s;
        let motion_m = body_m + (linear_mps + angular_radps * reach_m) * took_s;
        advance(motion_m, least_step_m(field), |fraction, least_m| {
            let at = a.interpolate(b, fraction);
            let ns = from.since_epoch_ns + (took_ns as f64 * fraction) as i64;
            let placement = self.objects.placement(index, ns);
            let distance_m = |p_m: DVec3| distance_to_m(field, &placement, p_m);
            (at.translation_m, body.clearance_m(&at, least_m, distance_m))
        })
    }
}

/// Returns the distance from a point to an object at a pose.
fn distance_to_m(field: &DistanceField, placement: &Pose<World, Object>, p_world_m: DVec3) -> f64 {
    let p_m = placement.inverse().transform_point(p_world_m);
    let grid = field.grid();
    let margin_m = DVec3::splat(grid.voxel_m / 2.0);
    let nearest_m = p_m.clamp(grid.min_m + margin_m, grid.max_m() - margin_m);
    let outside_m = (p_m - nearest_m).length();
    let inside_m = field.obstacle_distance_m(nearest_m);
    // The object is inside the box, which is convex: seen from the nearest point of the box, the angle between
    // it and the point is a right angle or more. Stated positively, so that NaN is kept.
    if outside_m == 0.0 { inside_m } else { outside_m.hypot(inside_m.max(0.0)) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{MotionConfig, ObjectConfig};
    use crate::grid::Grid;
    use crate::occupancy::occupancy_of;
    use glam::DQuat;
    use proptest::prelude::*;
    use vizflyt_protocol::geometry::Volume;

    /// A bar of 1 m from the origin up, 8 cm thick.
    const HAND: Volume = Volume::Capsule {
        a_m: DVec3::new(0.0, 0.0, 0.0),
        b_m: DVec3::new(0.0, 0.0, 1.0),
        radius_m: 0.04,
    };
    const VOXEL_M: f64 = 0.02;
    const BODY_M: f64 = 0.12;

    fn hand_field() -> Arc<DistanceField> {
        let grid = Grid::covering(DVec3::new(-0.2, -0.2, -0.2), DVec3::new(0.2, 0.2, 1.2), VOXEL_M);
        let floor_z_m = -1e3;
        DistanceField::of(occupancy_of(grid, floor_z_m, |p| HAND.signed_distance_m(p) < 0.0)).into()
    }

    fn nothing() -> Arc<DistanceField> {
        let grid = Grid::covering(DVec3::splat(-3.0), DVec3::splat(3.0), 0.1);
        DistanceField::of(occupancy_of(grid, -1e3, |_| false)).into()
    }

    /// Returns the hand at the origin, turning about x.
    fn clock(period_s: f64, phase_s: f64) -> Obstacles {
        let hand = ObjectConfig {
            name: "hand".into(),
            scene: "hand.ply".into(),
            position_m: DVec3::ZERO,
            yaw_deg: 0.0,
            phase_s: Some(phase_s),
            motion: Some(MotionConfig::Rotation { axis: DVec3::X, period_s }),
        };
        Obstacles::new(nothing(), vec![hand_field()], MovingObjects::of(&[hand], 0))
    }

    fn timed_pose(ns: i64, p_m: DVec3) -> TimedPose {
        TimedPose { since_epoch_ns: ns, world_from_body: Pose::new(p_m, DQuat::IDENTITY) }
    }

    #[test]
    fn field_moves_with_the_object() {
        let clock = clock(4.0, 0.0);
        // 0.5 m up, next to the hand: at once, and after one turn.
        let p_m = DVec3::new(0.0, 0.15, 0.5);
        for ns in [0, 4_000_000_000, 4_000_000_000 * 100_000] {
            let found_m = clock.distance_m(ns, p_m);
            assert!((found_m - 0.11).abs() < VOXEL_M, "{found_m}");
        }
        // After a quarter turn it is along -y; along y there is nothing.
        assert!(clock.distance_m(1_000_000_000, DVec3::new(0.0, -0.5, 0.0)) < 0.0);
        // Outside of the grid, the result is a lower bound.
        let p_m = DVec3::new(0.0, 0.3, 0.5);
        let far_m = clock.distance_m(1_000_000_000, p_m);
        assert!((0.3..p_m.length() - 0.04 + VOXEL_M).contains(&far_m), "{far_m}");
        assert!(clock.distance_m(0, DVec3::NAN).is_nan());
    }

    #[test]
    fn moving_object_collides_only_at_the_right_time() {
        let clock = clock(4.0, 0.0);
        let body = BodyShape::sphere(BODY_M);
        // Waits on the left, where the hand passes after three quarters of a turn.
        let p_m = DVec3::new(0.0, 0.6, 0.0);
        let (found, touched) =
            clock.sweep(&body, &timed_pose(0, p_m), &timed_pose(4_000_000_000, p_m));
        let contact = found.contact.unwrap();
        assert_eq!(touched, Touched::Object(0));
        // The side of the hand, 4 cm from its centre line, meets the body's surface asin(0.16 / 0.6) earlier.
        let expected = (270.0 - (0.16f64 / 0.6).asin().to_degrees()) / 360.0;
        assert!((contact.fraction - expected).abs() < 0.01, "{contact:?}");
        // Passes through the plane in a tenth of a second, while the hand points the other way.
        let through = |at_s: f64| {
            let ns = (at_s * 1e9) as i64;
            let (from_m, to_m) = (p_m - DVec3::X, p_m + DVec3::X);
            clock.sweep(&body, &timed_pose(ns, from_m), &timed_pose(ns + 100_000_000, to_m)).0
        };
        assert_eq!(through(1.0).contact, None);
        assert!(through(2.95).contact.is_some());
    }

    #[test]
    fn fast_object_does_not_tunnel() {
        // Twenty turns per second, sampled ten times per second: two turns between samples.
        let clock = clock(0.05, 0.01);
        let body = BodyShape::sphere(BODY_M);
        let p_m = DVec3::new(0.0, 0.7, 0.0);
        let (found, _) = clock.sweep(&body, &timed_pose(0, p_m), &timed_pose(100_000_000, p_m));
        assert!(found.contact.is_some());
        assert!(
            clock.sweep(&body, &timed_pose(0, DVec3::NAN), &timed_pose(1, p_m)).0.contact.is_some()
        );
    }

    proptest! {
        /// A sweep against the turning hand agrees with dense sampling of the truth.
        #[test]
        fn sweeps_agree_with_dense_truth(
            a in (-0.6..0.6f64, -1.4..1.4f64, -1.4..1.4f64),
            b in (-0.6..0.6f64, -1.4..1.4f64, -1.4..1.4f64),
            period_s in 0.3..8.0f64, phase_s in 0.0..8.0f64, took_ms in 1..400i64,
        ) {
            let clock = clock(period_s, phase_s);
            let (from_m, to_m) = (DVec3::from(a), DVec3::from(b));
            let took_ns = took_ms * 1_000_000;
            let truth_m = (0..=2000)
                .map(|n| {
                    let share = f64::from(n) / 2000.0;
                    let placement = clock.objects.placement(0, (took_ns as f64 * share) as i64);
                    let p_m = placement.inverse().transform_point(from_m.lerp(to_m, share));
                    HAND.signed_distance_m(p_m) - BODY_M
                })
                .fold(f64::INFINITY, f64::min);
            let body = BodyShape::sphere(BODY_M);
            let (found, _) = clock.sweep(&body, &timed_pose(0, from_m), &timed_pose(took_ns, to_m));
            prop_assert!(truth_m > -VOXEL_M || found.contact.is_some(), "missed {}", truth_m);
            prop_assert!(truth_m < VOXEL_M || found.contact.is_none(), "false {}", truth_m);
        }
    }
}
