//! Steers through one opening: a funnel in front of it, straight through, clear of near surfaces.

use vizflyt_sdk::glam::DVec3;

use crate::planar_obstacle::{Opening, PlanarObstacle, Plane};

/// Distance to an obstacle's plane, and offset from the line through its opening.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Aim {
    /// Distance in front of the plane; negative behind it. [m]
    pub before_m: f64,
    /// Vector from the vehicle to the line through the opening along the direction of passage. [m, home]
    pub off_m: DVec3,
}

impl Aim {
    /// Returns the aim from a position [m, home].
    pub fn from(p_m: DVec3, plane: &Plane, opening: &Opening) -> Self {
        let to_m = opening.center_m - p_m;
        let before_m = plane.normal().dot(to_m);
        Self { before_m, off_m: to_m - plane.normal() * before_m }
    }
}

/// Returns the velocity towards and through an opening. The forward speed decreases with the offset from the line. With
/// `held`, the vehicle waits at a distance. [m/s, home]
pub fn through(aim: &Aim, plane: &Plane, held: bool) -> DVec3 {
    let off_m = aim.off_m.length();
    let sideways_mps = (aim.off_m * OFF_PER_S).clamp_length_max(SIDE_MPS);
    let allowed_m = NECK_M + FUNNEL * (aim.before_m - NEAR_M).max(0.0);
    // Full speed within half of the allowed offset, zero at its limit, backwards beyond.
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

/// Limits the velocity towards solid surfaces of the obstacles, and adds a push away from them. [m/s, home]
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

/// Speed through an opening and between openings. The lag of vehicle and image, 0.3 s, is 0.3 m at this speed. [m/s]
pub const CRUISE_MPS: f64 = 1.0;
/// Distance from the plane at which the vehicle waits for the hand to pass. [m]
pub const WAIT_M: f64 = 0.95;
const WAIT_PER_S: f64 = 1.5;
/// Gain of sideways and vertical motion: the time constant is twice the vehicle's lag.
const OFF_PER_S: f64 = 1.8;
const SIDE_MPS: f64 = 0.9;
/// Allowed offset from the line at the opening, and its increase per metre before it.
const NECK_M: f64 = 0.1;
const FUNNEL: f64 = 0.5;
const NEAR_M: f64 = 0.35;
/// Fraction of the speed for flying backwards if the offset is too large.
const BACK: f64 = 0.4;
/// At a smaller distance, turning back would take longer than passing. [m]
const COMMIT_M: f64 = 0.2;
/// At a larger distance, the vehicle never flies backwards, because there is space to move sideways. [m]
const FAR_M: f64 = 0.7;
/// Solid surfaces nearer than this limit the velocity. [m]
const KEEP_M: f64 = 0.6;
/// Minimum distance from a solid surface to the centre of the vehicle. [m]
const MIN_M: f64 = 0.22;

#[cfg(test)]
mod tests;
