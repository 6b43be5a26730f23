//! The geofence, looked at with the velocity of the moment: a vehicle that can no longer stop
//! inside is as good as outside.

use glam::DVec3;
use vizflyt_protocol::geometry::Volume;
use vizflyt_protocol::messages::Limits;

/// What the fence says to a position and velocity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FenceVerdict {
    /// The vehicle stops inside with room to spare.
    Inside,
    /// It stops inside, but only just.
    Near,
    /// It is outside, or cannot stop inside.
    Breach,
}

/// The verdict with its numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FenceCheck {
    /// What to think of it.
    pub verdict: FenceVerdict,
    /// From the body's surface to the fence; negative is outside. [m]
    pub margin_m: f64,
    /// From the body's surface to the fence where the vehicle would come to rest, braking along
    /// its way over `v^2 / 2a`; negative is outside. [m]
    pub margin_at_rest_m: f64,
}

/// Room, now or at rest, below which a person should be told. [m]
const NEAR_M: f64 = 0.3;
/// The referee's tolerance over the guard's: the guard brakes with its own margin, and poses carry
/// millimetres of noise. Only what it fails to hold is judged. [m]
const TOLERANCE_M: f64 = 0.1;

/// Judges a position [m, world] and velocity [m/s, world] of a body of `radius_m`.
pub fn check(
    fence: &Volume,
    limits: &Limits,
    radius_m: f64,
    p_world_m: DVec3,
    v_world_mps: DVec3,
) -> FenceCheck {
    let margin_at = |p_m: DVec3| -fence.signed_distance_m(p_m) - radius_m;
    let margin_m = margin_at(p_world_m);
    // The place of rest, not the nearest side: low over the floor, the floor is always nearest,
    // however fast the vehicle flies at the wall ahead.
    let way_m = v_world_mps * (v_world_mps.length() / (2.0 * limits.max_acceleration_mps2));
    let margin_at_rest_m = margin_at(p_world_m + way_m);
    // A number that is none counts as a breach; a volume's distance may lose it on the way.
    let known = p_world_m.is_finite() && v_world_mps.is_finite();
    let verdict = if !(known && margin_m >= 0.0 && margin_at_rest_m + TOLERANCE_M >= 0.0) {
        FenceVerdict::Breach
    } else if margin_m.min(margin_at_rest_m) < NEAR_M {
        FenceVerdict::Near
    } else {
        FenceVerdict::Inside
    };
    FenceCheck { verdict, margin_m, margin_at_rest_m }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn verdict(p: [f64; 3], v: [f64; 3]) -> FenceVerdict {
        let room = Volume::aabb(DVec3::ZERO, DVec3::new(10.0, 4.0, 3.0));
        let limits = Limits::new(6.0, 8.0);
        check(&room, &limits, 0.1, p.into(), v.into()).verdict
    }

    #[test]
    fn speed_toward_the_fence_counts() {
        // 1.1 m to the side x = 10, 0.1 m of body: 1 m left; 4 m/s needs 1 m, 4.5 m/s 1.27 m.
        assert_eq!(verdict([8.9, 2.0, 1.5], [0.0, 0.0, 0.0]), FenceVerdict::Inside);
        assert_eq!(verdict([8.9, 2.0, 1.5], [4.0, 0.0, 0.0]), FenceVerdict::Near);
        assert_eq!(verdict([8.9, 2.0, 1.5], [4.5, 0.0, 0.0]), FenceVerdict::Breach);
        assert_eq!(verdict([8.9, 2.0, 1.5], [-6.0, 0.0, 0.0]), FenceVerdict::Inside);
        // The floor is nearer than the wall, and parallel to the way.
        assert_eq!(verdict([8.9, 2.0, 0.6], [4.5, 0.0, 0.0]), FenceVerdict::Breach);
        assert_eq!(verdict([8.9, 2.0, 0.6], [0.0, 4.5, 0.0]), FenceVerdict::Inside);
        assert_eq!(verdict([8.9, 2.0, 1.5], [f64::NAN, 0.0, 0.0]), FenceVerdict::Breach);
        assert_eq!(verdict([9.95, 2.0, 1.5], [0.0, 0.0, 0.0]), FenceVerdict::Breach);
        assert_eq!(verdict([f64::NAN, 2.0, 1.5], [0.0, 0.0, 0.0]), FenceVerdict::Breach);
    }
}
