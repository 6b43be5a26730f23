//! Does the body's sphere touch an obstacle between one pose and the next?
//!
//! Conservative advancement: from a point whose clearance is c the sphere can move by c and touch
//! nothing, so the walk takes few queries in the open and short ones near obstacles, and no speed
//! or rate tunnels through anything. Budget: 10 us a tick.

use glam::DVec3;

use crate::distance::DistanceField;

/// What a sweep found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sweep {
    /// Least distance from the body's surface to an obstacle on the way, up to the contact;
    /// negative is penetration. [m]
    pub clearance_m: f64,
    /// Where the body first touched.
    pub contact: Option<Contact>,
}

/// The first touch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// Where the body's centre was. [m, world]
    pub p_world_m: DVec3,
    /// Part of the way, 0 to 1.
    pub fraction: f64,
    /// Distance from the body's surface to the obstacle; zero or negative. [m]
    pub clearance_m: f64,
}

/// Sweeps a sphere of `radius_m` from one point to another [m, world]; equal points are one check.
/// The floor is no obstacle here.
///
/// A coordinate that is not a number is a contact: unknown is not safe.
pub fn sweep(field: &DistanceField, from_m: DVec3, to_m: DVec3, radius_m: f64) -> Sweep {
    let way_m = to_m - from_m;
    let length_m = way_m.length();
    let least_step_m = LEAST_STEP_VOXELS * field.grid().voxel_m;
    let mut least_m = f64::INFINITY;
    let mut done_m = 0.0;
    loop {
        let fraction = if length_m > 0.0 { (done_m / length_m).min(1.0) } else { 1.0 };
        let p_world_m = from_m + way_m * fraction;
        let clearance_m = field.obstacle_distance_m(p_world_m) - radius_m;
        least_m = least_m.min(clearance_m);
        // Positively stated, so that NaN is a contact.
        if !(clearance_m > 0.0) {
            let contact = Contact { p_world_m, fraction, clearance_m };
            return Sweep { clearance_m: least_m, contact: Some(contact) };
        }
        if done_m >= length_m {
            return Sweep { clearance_m: least_m, contact: None };
        }
        done_m = (done_m + (clearance_m * TRUST).max(least_step_m)).min(length_m);
    }
}

/// Part of the clearance that a step takes: interpolation between quantised voxels may rise a
/// little faster than true distance.
const TRUST: f64 = 0.8;
/// Shortest step; also how deep a first contact may lie. Obstacles are a voxel thick at least.
/// [voxels]
const LEAST_STEP_VOXELS: f64 = 0.25;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::Grid;
    use crate::occupancy::occupancy_of;
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

    #[test]
    fn a_bullet_does_not_tunnel() {
        let field = field();
        let (from, to) = (DVec3::new(0.1, 1.0, 1.0), DVec3::new(3.9, 1.0, 1.0));
        // A body smaller than half a voxel, 3.8 m in one tick, through a thin trunk.
        let contact = sweep(&field, from, to, 0.01).contact.unwrap();
        assert!((contact.p_world_m.x - (2.0 - 0.12 - 0.01)).abs() < 0.05, "{contact:?}");
        assert!(sweep(&field, to, from, 0.01).contact.unwrap().p_world_m.x > 2.0);
        let beside = DVec3::Y * 0.4;
        let pass = sweep(&field, from + beside, to + beside, 0.12);
        assert_eq!(pass.contact, None);
        assert!((pass.clearance_m - 0.16).abs() < 0.05, "{pass:?}");
    }

    #[test]
    fn standing_still_is_one_check_and_nan_is_a_contact() {
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
    }
}
