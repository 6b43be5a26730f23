//! Other vehicles in the room: collisions are virtual, so vehicles in two nets can share one arena.
//!
//! Each vehicle is a sphere on a straight line between two instants. The closest approach of two has a closed
//! form, so nothing is tunnelled through.

use glam::DVec3;
use vizflyt_protocol::messages::Name;
use vizflyt_protocol::time::ServerTime;

use crate::collision::{Contact, Sweep};
use crate::pose::Motion;

/// Another vehicle at its newest pose.
#[derive(Clone, Debug, PartialEq)]
pub struct Neighbour {
    pub name: Name,
    pub motion: Motion,
    /// Radius of the sphere that encloses it. [m]
    pub radius_m: f64,
}

/// Position of a sphere's centre at an instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Passage {
    pub stamp: ServerTime,
    pub p_world_m: DVec3,
}

impl Neighbour {
    /// Returns the position at an instant, within the limit of extrapolation. [m, world]
    pub fn position_m(&self, at: ServerTime) -> DVec3 {
        self.motion.at(self.motion.reach(at)).translation_m
    }

    /// Sweeps a sphere of `radius_m` from one position to the next, against the motion of this vehicle.
    ///
    /// NaN in a coordinate counts as a contact: unknown is not safe.
    pub fn sweep(&self, from: Passage, to: Passage, radius_m: f64) -> Sweep {
        let between_m = radius_m + self.radius_m;
        // In the frame of this vehicle.
        let start_m = from.p_world_m - self.position_m(from.stamp);
        let way_m = to.p_world_m - self.position_m(to.stamp) - start_m;
        let squared = way_m.length_squared();
        let nearest =
            if squared > 0.0 { (-start_m.dot(way_m) / squared).clamp(0.0, 1.0) } else { 0.0 };
        let clearance_m = (start_m + way_m * nearest).length() - between_m;
        // Stated positively, so that NaN is a contact.
        if clearance_m > 0.0 && squared.is_finite() {
            return Sweep { clearance_m, contact: None };
        }
        // The first root of |start + s way| = between; 0 if they touch already.
        let half_b = start_m.dot(way_m);
        let c = start_m.length_squared() - between_m * between_m;
        let root = (half_b * half_b - squared * c).max(0.0).sqrt();
        let first = if c <= 0.0 || squared <= 0.0 { 0.0 } else { (-half_b - root) / squared };
        let fraction = if first.is_nan() { 0.0 } else { first.clamp(0.0, 1.0) };
        let p_world_m = from.p_world_m.lerp(to.p_world_m, fraction);
        let clearance_m = ((start_m + way_m * fraction).length() - between_m).min(0.0);
        Sweep { clearance_m, contact: Some(Contact { p_world_m, fraction, clearance_m }) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;
    use vizflyt_protocol::geometry::Pose;
    use vizflyt_protocol::messages::bounded;

    /// A vehicle at rest at (2, 0, 1).
    fn bee() -> Neighbour {
        let pose = Pose::new(DVec3::new(2.0, 0.0, 1.0), DQuat::IDENTITY);
        let motion = Motion::at_rest(ServerTime::from_ns(0), pose);
        Neighbour { name: bounded("bee"), motion, radius_m: 0.1 }
    }

    fn sweep(from: [f64; 3], to: [f64; 3]) -> Sweep {
        let at = |p: [f64; 3], ns| Passage { stamp: ServerTime::from_ns(ns), p_world_m: p.into() };
        bee().sweep(at(from, 0), at(to, 5_000_000), 0.1)
    }

    #[test]
    fn vehicles_collide_at_the_sum_of_their_radii() {
        let contact = sweep([0.0, 0.0, 1.0], [4.0, 0.0, 1.0]).contact.unwrap();
        assert!((contact.p_world_m.x - 1.8).abs() < 1e-9, "{contact:?}");
        let beside = sweep([0.0, 0.3, 1.0], [4.0, 0.3, 1.0]);
        assert!(beside.contact.is_none() && (beside.clearance_m - 0.1).abs() < 1e-9, "{beside:?}");
        let still = sweep([2.0, 0.1, 1.0], [2.0, 0.1, 1.0]);
        assert_eq!(still.contact.unwrap().fraction, 0.0);
        assert!(sweep([0.0, 0.0, 1.0], [1.0, 0.0, 1.0]).contact.is_none(), "it stops before");
        assert!(sweep([0.0, 0.0, 1.0], [f64::NAN, 0.0, 1.0]).contact.is_some());
    }
}
