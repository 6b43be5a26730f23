//! The way through one opening: a funnel before it, straight through, clear of what is near.

use vizflyt_sdk::glam::DVec3;

use crate::planar_obstacle::{Opening, PlanarObstacle, Plane};

/// How far it is to an obstacle and how far off the line through its opening.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Aim {
    /// Before the plane; negative is behind it. [m]
    pub before_m: f64,
    /// From the vehicle to the line through the opening along the passage. [m, home]
    pub off_m: DVec3,
}

impl Aim {
    /// Returns the aim from a place [m, home].
    pub fn from(p_m: DVec3, plane: &Plane, opening: &Opening) -> Self {
        let to_m = opening.center_m - p_m;
        let before_m = plane.normal().dot(to_m);
        Self { before_m, off_m: to_m - plane.normal() * before_m }
    }
}

/// Returns the velocity towards and through an opening: the farther off the line, the slower
/// ahead. While `held`, it waits at a distance. [m/s, home]
pub fn through(aim: &Aim, plane: &Plane, held: bool) -> DVec3 {
    let off_m = aim.off_m.length();
    let sideways_mps = (aim.off_m * OFF_PER_S).clamp_length_max(SIDE_MPS);
    let allowed_m = NECK_M + FUNNEL * (aim.before_m - NEAR_M).max(0.0);
    // Full speed within half of what is allowed, none at its edge, back beyond.
    let share = (2.0 * (1.0 - off_m / allowed_m)).clamp(-BACK, 1.0);
    let ahead_mps = if held {
        ((aim.before_m - WAIT_M) * WAIT_PER_S).clamp(-0.4, CRUISE_MPS) * share.max(0.0)
            + if aim.before_m < WAIT_M { (aim.before_m - WAIT_M) * WAIT_PER_S } else { 0.0 }
    } else if aim.before_m < COMMIT_M && off_m < 0.2 {
        CRUISE_MPS
    } else if aim.before_m > FAR_M {
        CRUISE_MPS * share.max(0.0)
    } else {
        CRUISE_MPS * share
    };
    plane.normal() * ahead_mps + sideways_mps
}

/// Returns `v_mps` without what would bring the vehicle near to anything solid of the obstacles, and
/// with a push away from it. [m/s, home]
pub fn clear_of<'a>(
    v_mps: DVec3,
    p_m: DVec3,
    obstacles: impl Iterator<Item = &'a PlanarObstacle>,
) -> DVec3 {
    let mut v_mps = v_mps;
    for obstacle in obstacles {
        let Some(solid_m) = obstacle.nearest_solid_m(p_m, KEEP_M) else { continue };
        let apart_m = p_m.distance(solid_m);
        let Some(away) = (p_m - solid_m).try_normalize() else { continue };
        let allowed_mps = (apart_m - MIN_M) * OFF_PER_S;
        let towards_mps = -v_mps.dot(away);
        if towards_mps > allowed_mps {
            v_mps += away * (towards_mps - allowed_mps);
        }
    }
    v_mps
}

/// Through an opening and between two of them. A metre at this speed is left behind in the lag of
/// the vehicle and of its image, 0.3 s, by 0.3 m. [m/s]
pub const CRUISE_MPS: f64 = 1.0;
/// Where a vehicle waits for the hand to pass, from the plane. [m]
pub const WAIT_M: f64 = 0.95;
const WAIT_PER_S: f64 = 1.5;
/// Sideways and up: the time constant is twice the vehicle's lag.
const OFF_PER_S: f64 = 1.8;
const SIDE_MPS: f64 = 0.9;
/// Allowed off the line at the opening, and more for each metre before it.
const NECK_M: f64 = 0.1;
const FUNNEL: f64 = 0.5;
const NEAR_M: f64 = 0.35;
/// Back out, at this share of the speed, where the line is too far off.
const BACK: f64 = 0.4;
/// From here on turning back would take longer than going through. [m]
const COMMIT_M: f64 = 0.2;
/// Nobody backs out from here: there is room to move sideways. [m]
const FAR_M: f64 = 0.7;
/// Solid things nearer than this push. [m]
const KEEP_M: f64 = 0.6;
/// Nothing solid comes nearer than this to the middle of the vehicle. [m]
const MIN_M: f64 = 0.22;

#[cfg(test)]
mod tests;
