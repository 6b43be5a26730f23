//! Collision check between one pose and the next.
//!
//! Conservative advancement: from a pose with clearance c, the body can move by less than c without a contact.
//! So a sweep takes few queries in open space and short steps near obstacles, and no speed, turn or rate
//! tunnels through an obstacle. Budget: 10 us per tick.

use glam::DVec3;
use vizflyt_protocol::geometry::{Body, Pose, World};

use crate::body::BodyShape;
use crate::distance::DistanceField;

/// Result of a sweep.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sweep {
    /// Minimum distance from the body's surface to an obstacle, up to the contact; negative is penetration. [m]
    pub clearance_m: f64,
    /// First contact of the body.
    pub contact: Option<Contact>,
}

/// First contact of a sweep.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// Position of the body's origin. [m, world]
    pub p_world_m: DVec3,
    /// Fraction of the motion, 0 to 1.
    pub fraction: f64,
    /// Distance from the body's surface to the obstacle; zero or negative. [m]
    pub clearance_m: f64,
}

/// Sweeps a body from one pose to another, along the straight line and the shortest turn; equal poses are one
/// check. The floor does not count as an obstacle here.
///
/// NaN counts as a contact: unknown is not safe.
pub fn sweep(
    field: &DistanceField,
    body: &BodyShape,
    from: &Pose<World, Body>,
    to: &Pose<World, Body>,
) -> Sweep {
    let motion_m = body.motion_m(from, to);
    advance(motion_m, least_step_m(field), |fraction, least_m| {
        let at = from.interpolate(to, fraction);
        let clearance_m = body.clearance_m(&at, least_m, |p_m| field.obstacle_distance_m(p_m));
        (at.translation_m, clearance_m)
    })
}

/// Returns the minimum step in a field; it is also the maximum depth of a first contact. [m]
pub fn least_step_m(field: &DistanceField) -> f64 {
    MIN_STEP_VOXELS * field.grid().voxel_m
}

/// Advances along a motion in which no point of the body moves by more than `motion_m` relative to the
/// obstacles. `clearance_m` receives the fraction of the motion, 0 to 1, and the minimum clearance up to this
/// point. It returns the position of the body's origin [m, world] and its clearance [m]. If that exceeds the
/// minimum, any smaller value above the minimum is sufficient.
pub fn advance(
    motion_m: f64,
    least_step_m: f64,
    mut clearance_m: impl FnMut(f64, f64) -> (DVec3, f64),
) -> Sweep {
    let mut least_m = f64::INFINITY;
    let mut done_m = 0.0;
    loop {
        let fraction = if motion_m > 0.0 { (done_m / motion_m).min(1.0) } else { 1.0 };
        let (p_world_m, clearance_m) = clearance_m(fraction, least_m);
        least_m = least_m.min(clearance_m);
        // Stated positively, so that NaN is a contact.
        if !(clearance_m > 0.0 && motion_m.is_finite()) {
            let contact = Contact { p_world_m, fraction, clearance_m };
            return Sweep { clearance_m: least_m, contact: Some(contact) };
        }
        if done_m >= motion_m {
            return Sweep { clearance_m: least_m, contact: None };
        }
        done_m = (done_m + (clearance_m * TRUST).max(least_step_m)).min(motion_m);
    }
}

/// Share of the clearance that a step uses: interpolation between quantised voxels may rise slightly faster
/// than the true distance.
const TRUST: f64 = 0.8;
/// See [`least_step_m`]. Obstacles are at least one voxel thick. [voxels]
const MIN_STEP_VOXELS: f64 = 0.25;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::BodyPart;
    use crate::grid::Grid;
    use crate::occupancy::occupancy_of;
    use glam::DQuat;
    use proptest::prelude::*;
    use vizflyt_protocol::geometry::Volume;

    const TRUNK: Volume = Volume::Capsule {
        a_m: DVec3::new(2.0, 1.0, -1.0),
        b_m: DVec3::new(2.0, 1.0, 4.0),
        radius_m: 0.12,
    };

    fn field() -> DistanceField {
        let grid = Grid::covering(DVec3::ZERO, DVec3::new(4.0, 2.0, 2.0), 0.05);
        DistanceField::of(occupancy_of(grid, 0.0, |p| TRUNK.signed_distance_m(p) < 0.0))
    }

    fn sweep(field: &DistanceField, from_m: DVec3, to_m: DVec3, radius_m: f64) -> Sweep {
        let at = |p_m| Pose::new(p_m, DQuat::IDENTITY);
        super::sweep(field, &BodyShape::sphere(radius_m), &at(from_m), &at(to_m))
    }

    /// Arms of 0.4 m along y, and a hub.
    fn arms() -> BodyShape {
        let arm = BodyPart { from_m: DVec3::Y * -0.2, to_m: Some(DVec3::Y * 0.2), radius_m: 0.02 };
        BodyShape::of_parts(&[arm, BodyPart { from_m: DVec3::ZERO, to_m: None, radius_m: 0.05 }])
    }

    #[test]
    fn turning_in_place_detects_contact_of_an_arm() {
        let field = field();
        // 0.25 m from the trunk's face: arms along y pass it, and reach it halfway through the turn.
        let p_m = DVec3::new(1.65, 1.0, 1.0);
        let at = |yaw: f64| Pose::new(p_m, DQuat::from_rotation_z(yaw));
        let near = DVec3::new(1.72, 1.0, 1.0);
        let near_at = |yaw: f64| Pose::new(near, DQuat::from_rotation_z(yaw));
        assert_eq!(super::sweep(&field, &arms(), &at(0.0), &at(3.0)).contact, None);
        assert_eq!(super::sweep(&field, &arms(), &near_at(0.0), &near_at(0.1)).contact, None);
        let found = super::sweep(&field, &arms(), &near_at(0.0), &near_at(3.0));
        let contact = found.contact.unwrap();
        assert!((0.2..0.5).contains(&contact.fraction), "{contact:?}");
        let lost = Pose::new(p_m, DQuat::from_xyzw(f64::NAN, 0.0, 0.0, 1.0));
        assert!(super::sweep(&field, &arms(), &at(0.0), &lost).contact.is_some());
    }

    #[test]
    fn fast_small_body_does_not_tunnel() {
        let field = field();
        let (from, to) = (DVec3::new(0.1, 1.0, 1.0), DVec3::new(3.9, 1.0, 1.0));
        // A body smaller than half a voxel moves 3.8 m in one tick through a thin trunk.
        let contact = sweep(&field, from, to, 0.01).contact.unwrap();
        assert!((contact.p_world_m.x - (2.0 - 0.12 - 0.01)).abs() < 0.05, "{contact:?}");
        assert!(sweep(&field, to, from, 0.01).contact.unwrap().p_world_m.x > 2.0);
        let beside = DVec3::Y * 0.4;
        let pass = sweep(&field, from + beside, to + beside, 0.12);
        assert_eq!(pass.contact, None);
        assert!((pass.clearance_m - 0.16).abs() < 0.05, "{pass:?}");
    }

    #[test]
    fn checks_a_body_at_rest_and_treats_nan_as_contact() {
        let field = field();
        let open = DVec3::new(1.0, 1.0, 1.0);
        assert_eq!(sweep(&field, open, open, 0.12).contact, None);
        assert!(sweep(&field, DVec3::new(2.0, 1.0, 1.0), open, 0.12).contact.is_some());
        assert!(sweep(&field, open, DVec3::NAN, 0.12).contact.is_some());
    }

    proptest! {
        /// A sweep agrees with dense sampling of the truth, within a voxel.
        #[test]
        fn sweeps_agree_with_dense_truth(
            a in (0.2..3.8f64, 0.2..1.8f64, 0.2..1.8f64), b in (0.2..3.8f64, 0.2..1.8f64, 0.2..1.8f64),
        ) {
            let (from, to) = (DVec3::from(a), DVec3::from(b));
            let truth = (0..=1000)
                .map(|n| TRUNK.signed_distance_m(from.lerp(to, f64::from(n) / 1000.0)) - 0.12)
                .fold(f64::INFINITY, f64::min);
            let found = sweep(&field(), from, to, 0.12);
            prop_assert!(truth > -0.05 || found.contact.is_some());
            prop_assert!(truth < 0.05 || found.contact.is_none());
        }

        /// Same for a body that turns during the motion.
        #[test]
        fn turning_sweeps_agree_with_dense_truth(
            a in (0.3..3.7f64, 0.3..1.7f64, 0.3..1.7f64), b in (0.3..3.7f64, 0.3..1.7f64, 0.3..1.7f64),
            turns in prop::array::uniform2(prop::array::uniform3(-2.0..2.0f64)),
        ) {
            let pose = |p, turn| Pose::new(DVec3::from(p), DQuat::from_scaled_axis(DVec3::from(turn)));
            let (from, to) = (pose(a, turns[0]), pose(b, turns[1]));
            let body = arms();
            let distance_m = |p_m| TRUNK.signed_distance_m(p_m);
            let truth = (0..=1000)
                .map(|n| from.interpolate(&to, f64::from(n) / 1000.0))
                .map(|at| body.clearance_m(&at, f64::INFINITY, distance_m))
                .fold(f64::INFINITY, f64::min);
            let found = super::sweep(&field(), &body, &from, &to);
            prop_assert!(truth > -0.05 || found.contact.is_some());
            prop_assert!(truth < 0.05 || found.contact.is_none());
        }
    }
}
