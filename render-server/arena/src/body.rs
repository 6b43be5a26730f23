//! Vehicle body as balls in the body frame: one sphere, or a set of spheres and capsules.
//!
//! A capsule becomes balls along its axis, half a radius apart and slightly larger, so that they cover it:
//! distances are at most 3 % of its radius too short, and never too long.

use glam::DVec3;
use vizflyt_protocol::geometry::{Body, Pose, World};

use crate::config::{ArenaConfig, BodyPart};

/// Shape of the vehicle for collision checks.
#[derive(Clone, Debug, PartialEq)]
pub struct BodyShape {
    balls: Vec<Ball>,
    /// Maximum distance of a ball's centre from the body's origin. [m]
    reach_m: f64,
    /// Radius of the sphere around the body's origin that contains all balls. [m]
    radius_m: f64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Ball {
    /// Centre of the ball. [m, body]
    center_m: DVec3,
    radius_m: f64,
}

impl BodyShape {
    /// Returns one sphere about the body's origin.
    pub fn sphere(radius_m: f64) -> Self {
        Self::of_parts(&[BodyPart { from_m: DVec3::ZERO, to_m: None, radius_m }])
    }

    /// Returns the body of an arena's vehicle: its parts, or the sphere of `body_radius_m`.
    pub fn of(config: &ArenaConfig) -> Self {
        if config.body.is_empty() {
            Self::sphere(config.body_radius_m)
        } else {
            Self::of_parts(&config.body)
        }
    }

    /// Returns a body that covers spheres and capsules; `parts` must not be empty.
    pub fn of_parts(parts: &[BodyPart]) -> Self {
        let balls: Vec<_> = parts.iter().flat_map(cover).collect();
        let most = |of: fn(&Ball) -> f64| balls.iter().map(of).fold(0.0, f64::max);
        let reach_m = most(|ball| ball.center_m.length());
        let radius_m = most(|ball| ball.center_m.length() + ball.radius_m);
        Self { balls, reach_m, radius_m }
    }

    /// Returns the radius of the sphere around the body's origin that contains the whole body. [m]
    pub fn radius_m(&self) -> f64 {
        self.radius_m
    }

    /// Returns an upper bound of the motion of every ball's centre between two poses, along the straight line
    /// and the shortest turn. [m]
    pub fn motion_m(&self, from: &Pose<World, Body>, to: &Pose<World, Body>) -> f64 {
        let turn = from.rotation.conjugate() * to.rotation;
        let turn_rad = 2.0 * turn.xyz().length().atan2(turn.w.abs());
        (to.translation_m - from.translation_m).length() + turn_rad * self.reach_m
    }

    /// Returns the distance from the body's surface to the nearest obstacle; `distance_m` is that of a point;
    /// negative is penetration. If the distance of the enclosing sphere exceeds `least_m`, returns that smaller
    /// distance instead: one query in open space. [m]
    ///
    /// Returns NaN if a distance is NaN.
    pub fn clearance_m(
        &self,
        world_from_body: &Pose<World, Body>,
        least_m: f64,
        distance_m: impl Fn(DVec3) -> f64,
    ) -> f64 {
        let around_m = distance_m(world_from_body.translation_m) - self.radius_m;
        if around_m >= least_m || self.is_one_sphere() {
            return around_m;
        }
        let of = |ball: &Ball| {
            distance_m(world_from_body.transform_point(ball.center_m)) - ball.radius_m
        };
        // Not `min`, which would drop a NaN.
        let nearer = |least: f64, new: f64| if least.is_nan() || least < new { least } else { new };
        self.balls.iter().map(of).fold(f64::INFINITY, nearer)
    }

    fn is_one_sphere(&self) -> bool {
        self.balls.len() == 1 && self.reach_m == 0.0
    }
}

/// Returns balls that cover a part.
fn cover(part: &BodyPart) -> impl Iterator<Item = Ball> {
    let &BodyPart { from_m, radius_m, .. } = part;
    let to_m = part.to_m.unwrap_or(from_m);
    let length_m = (to_m - from_m).length();
    let gaps = (length_m / (SPACING * radius_m)).ceil().min(MAX_GAPS) as u32;
    // With this radius, balls at this distance cover the side of the capsule between them.
    let half_gap_m = 0.5 * length_m / f64::from(gaps.max(1));
    (0..=gaps).map(move |n| Ball {
        center_m: from_m.lerp(to_m, f64::from(n) / f64::from(gaps.max(1))),
        radius_m: radius_m.hypot(half_gap_m),
    })
}

/// Maximum distance between balls of a capsule. [radii]
const SPACING: f64 = 0.5;
/// Limit for the time per tick: a wire of 1 mm and 1 m is covered by fewer, larger balls.
const MAX_GAPS: f64 = 64.0;

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;
    use proptest::prelude::*;
    use vizflyt_protocol::geometry::Volume;

    /// An arm of 0.3 m along y and a ball below it.
    fn cross() -> Vec<BodyPart> {
        let arm =
            BodyPart { from_m: DVec3::Y * -0.15, to_m: Some(DVec3::Y * 0.15), radius_m: 0.03 };
        vec![arm, BodyPart { from_m: DVec3::Z * -0.06, to_m: None, radius_m: 0.05 }]
    }

    #[test]
    fn clearance_of_spheres_and_arms_is_exact() {
        let ball = BodyShape::sphere(0.12);
        let at = Pose::new(DVec3::Z, DQuat::from_rotation_x(1.0));
        assert_eq!(ball.clearance_m(&at, f64::INFINITY, |p| p.z), 0.88);
        let body = BodyShape::of_parts(&cross());
        assert!((body.radius_m() - 0.18).abs() < 2e-3, "{}", body.radius_m());
        // A wall 0.2 m to the east; the arm is along y, then turned towards it.
        let wall = |p: DVec3| 0.2 - p.x;
        let clearance_m = |yaw: f64| {
            let at = Pose::new(DVec3::ZERO, DQuat::from_rotation_z(yaw));
            body.clearance_m(&at, f64::INFINITY, wall)
        };
        assert!((clearance_m(0.0) - 0.15).abs() < 1e-9);
        assert!((clearance_m(std::f64::consts::FRAC_PI_2) - 0.02).abs() < 2e-3);
        assert!(body.clearance_m(&at, f64::INFINITY, |_| f64::NAN).is_nan());
    }

    proptest! {
        /// Balls contain every point of the parts, and protrude only a little.
        #[test]
        fn balls_cover_parts(along in 0.0..1.0f64, turn in -3.0..3.0f64, off in 0.0..0.4f64) {
            for part in cross() {
                let to_m = part.to_m.unwrap_or(part.from_m);
                let solid = Volume::Capsule { a_m: part.from_m, b_m: to_m, radius_m: part.radius_m };
                let balls: Vec<_> = cover(&part).collect();
                let p = part.from_m.lerp(to_m, along)
                    + DVec3::new(turn.cos(), 0.0, turn.sin()) * off;
                let truth = solid.signed_distance_m(p);
                let found = balls
                    .iter()
                    .map(|ball| (p - ball.center_m).length() - ball.radius_m)
                    .fold(f64::INFINITY, f64::min);
                // Inside, the distance to a union of balls is smaller than the solid's.
                prop_assert!(found <= truth.max(0.0) + 1e-12, "{found} {truth}");
                prop_assert!(truth < 0.0 || found > truth - 0.04 * part.radius_m, "{found} {truth}");
            }
        }

        /// No centre of a ball moves further than the bound.
        #[test]
        fn motion_bounds_every_ball(
            d in prop::array::uniform3(-1.0..1.0f64), turn in prop::array::uniform3(-2.0..2.0f64),
            t in 0.0..1.0f64,
        ) {
            let body = BodyShape::of_parts(&cross());
            let from = Pose::IDENTITY;
            let to = Pose::new(DVec3::from(d), DQuat::from_scaled_axis(DVec3::from(turn)));
            let motion_m = body.motion_m(&from, &to);
            for ball in &body.balls {
                let p = from.interpolate(&to, t).transform_point(ball.center_m);
                prop_assert!((p - ball.center_m).length() <= motion_m * t + 1e-9);
            }
        }
    }
}
