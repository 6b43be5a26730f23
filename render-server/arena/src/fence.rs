//! Geofence, ceiling and no-fly boxes, checked with the present velocity: a vehicle that cannot stop before a
//! boundary counts as beyond it.

use glam::DVec3;
use vizflyt_protocol::flight_end::Boundary;
use vizflyt_protocol::geometry::Volume;
use vizflyt_protocol::messages::{Limits, bounded};

use crate::config::ArenaConfig;

/// Result of checking a position and velocity against a boundary.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum FenceVerdict {
    /// The vehicle can stop before the boundary with enough margin.
    Inside,
    /// The vehicle can stop before the boundary with little margin.
    Near,
    /// The vehicle is beyond the boundary, or cannot stop before it.
    Breach,
}

/// Result for the worst boundary, with its margins.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FenceCheck<'a> {
    pub boundary: &'a Boundary,
    pub verdict: FenceVerdict,
    /// Distance from the body's surface to the boundary; negative is beyond. [m]
    pub margin_m: f64,
    /// Distance from the body's surface to the boundary at the stopping position after braking over `v^2 / 2a`,
    /// or at the nearest point on the way there; negative is beyond. [m]
    pub margin_at_rest_m: f64,
}

/// All boundaries of an arena.
#[derive(Clone, Debug, PartialEq)]
pub struct Boundaries {
    all: Vec<(Boundary, Rule)>,
    radius_m: f64,
    limits: Limits,
}

/// Rule of a boundary.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Rule {
    /// The body's surface stays inside: net, walls.
    KeepIn(Volume),
    /// The body's surface stays outside.
    KeepOut(Volume),
    /// The body's centre stays below. [m, world]
    Ceiling(f64),
}

/// Margin, now or at the stopping position, below which people are warned. [m]
const NEAR_M: f64 = 0.3;
/// Tolerance of the referee compared with the guard: the guard brakes with its own margin, and poses have
/// millimetres of noise. The referee only reports what the guard fails to prevent. [m]
const TOLERANCE_M: f64 = 0.1;

impl Boundaries {
    /// Returns the boundaries of an arena.
    pub fn of(config: &ArenaConfig) -> Self {
        let mut all = vec![(Boundary::Geofence, Rule::KeepIn(config.geofence()))];
        let ceiling = |z_m| (Boundary::Ceiling, Rule::Ceiling(z_m));
        all.extend(config.limits.max_altitude_m.map(ceiling));
        all.extend(config.no_fly.iter().map(|keep_out| {
            (Boundary::NoFly(bounded(&keep_out.name)), Rule::KeepOut(keep_out.volume()))
        }));
        Self { all, radius_m: config.body_radius_m, limits: config.limits }
    }

    /// Checks the path from one position to the next [m, world], and the velocity at its end [m/s, world];
    /// returns the worst boundary. Downward speed does not count for the geofence: vehicles land on its floor.
    pub fn check(&self, from_m: DVec3, to_m: DVec3, v_world_mps: DVec3) -> FenceCheck<'_> {
        let least_m = |check: &FenceCheck<'_>| check.margin_m.min(check.margin_at_rest_m);
        let check = |(boundary, rule)| self.check_one(boundary, rule, from_m, to_m, v_world_mps);
        let (first, others) = self.all.split_first().expect("there is a geofence");
        let mut worst = check((&first.0, &first.1));
        for (boundary, rule) in others {
            let other = check((boundary, rule));
            let nearer = other.verdict == worst.verdict && least_m(&other) < least_m(&worst);
            if other.verdict > worst.verdict || nearer {
                worst = other;
            }
        }
        worst
    }

    fn check_one<'a>(
        &self,
        boundary: &'a Boundary,
        rule: &Rule,
        from_m: DVec3,
        to_m: DVec3,
        v_world_mps: DVec3,
    ) -> FenceCheck<'a> {
        // Uses the stopping position, not the nearest side: low above the floor, the floor is always nearest,
        // even if the vehicle flies fast at a wall.
        let rest_m = |v_mps: DVec3| {
            to_m + v_mps * (v_mps.length() / (2.0 * self.limits.max_acceleration_mps2))
        };
        let level_mps = v_world_mps.with_z(v_world_mps.z.max(0.0));
        let (margin_m, margin_at_rest_m) = match rule {
            Rule::KeepIn(volume) => {
                let margin_at = |p_m| -volume.signed_distance_m(p_m) - self.radius_m;
                (margin_at(to_m), margin_at(rest_m(level_mps)))
            }
            Rule::Ceiling(z_m) => (z_m - to_m.z, z_m - rest_m(level_mps).z),
            // A box may be between two poses, or between here and the stopping position.
            Rule::KeepOut(volume) => {
                let nearest = |a, b| least_distance_m(volume, a, b) - self.radius_m;
                (nearest(from_m, to_m), nearest(to_m, rest_m(v_world_mps)))
            }
        };
        // NaN counts as a breach; the distance to a volume may drop a NaN.
        let known = to_m.is_finite() && v_world_mps.is_finite();
        let verdict = if !(known && margin_m >= 0.0 && margin_at_rest_m + TOLERANCE_M >= 0.0) {
            FenceVerdict::Breach
        } else if margin_m.min(margin_at_rest_m) < NEAR_M {
            FenceVerdict::Near
        } else {
            FenceVerdict::Inside
        };
        FenceCheck { boundary, verdict, margin_m, margin_at_rest_m }
    }
}

/// Returns the minimum signed distance to a volume on the line from `a_m` to `b_m`: volumes are convex, so the
/// distance falls, then rises. [m, world]
fn least_distance_m(volume: &Volume, a_m: DVec3, b_m: DVec3) -> f64 {
    let at = |t: f64| volume.signed_distance_m(a_m.lerp(b_m, t));
    let (mut low, mut high) = (0.0, 1.0);
    // (2/3)^30 of the line is micrometres.
    for _ in 0..30 {
        let (third, two_thirds) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
        if at(third) < at(two_thirds) {
            high = two_thirds;
        } else {
            low = third;
        }
    }
    // Not `min`, which would drop a NaN.
    [at(0.0), at(0.5 * (low + high)), at(1.0)]
        .into_iter()
        .fold(f64::INFINITY, |least, new| if least < new || least.is_nan() { least } else { new })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn boundaries() -> Boundaries {
        let room = Volume::aabb(DVec3::ZERO, DVec3::new(10.0, 4.0, 3.0));
        let table = Volume::aabb(DVec3::new(4.0, 1.0, 0.0), DVec3::new(4.1, 3.0, 1.0));
        let all = vec![
            (Boundary::Geofence, Rule::KeepIn(room)),
            (Boundary::Ceiling, Rule::Ceiling(2.5)),
            (Boundary::NoFly(bounded("shelf")), Rule::KeepOut(table)),
        ];
        Boundaries { all, radius_m: 0.1, limits: Limits::new(6.0, 8.0) }
    }

    fn check(p: [f64; 3], v: [f64; 3], boundary: &str, expected: FenceVerdict) {
        let boundaries = boundaries();
        let found = boundaries.check(p.into(), p.into(), v.into());
        assert_eq!(found.verdict, expected, "{found:?}");
        if expected != FenceVerdict::Inside {
            assert_eq!(found.boundary.to_string(), boundary, "{found:?}");
        }
    }

    #[test]
    fn stopping_distance_counts_towards_the_fence() {
        use FenceVerdict::{Breach, Inside, Near};
        let fence = "the geofence";
        // 1.1 m from the side x = 10, 0.1 m of body: 1 m left; 4 m/s needs 1 m to stop, 4.5 m/s 1.27 m.
        check([8.9, 2.0, 1.5], [0.0, 0.0, 0.0], fence, Inside);
        check([8.9, 2.0, 1.5], [4.0, 0.0, 0.0], fence, Near);
        check([8.9, 2.0, 1.5], [4.5, 0.0, 0.0], fence, Breach);
        check([8.9, 2.0, 1.5], [-6.0, 0.0, 0.0], fence, Inside);
        // The floor is nearer than the wall, and parallel to the motion.
        check([8.9, 2.0, 0.6], [4.5, 0.0, 0.0], fence, Breach);
        check([8.9, 2.0, 0.6], [0.0, 4.5, 0.0], fence, Inside);
        check([8.9, 2.0, 1.5], [f64::NAN, 0.0, 0.0], fence, Breach);
        check([9.95, 2.0, 1.5], [0.0, 0.0, 0.0], fence, Breach);
        check([f64::NAN, 2.0, 1.5], [0.0, 0.0, 0.0], fence, Breach);
        // Landing is not a breach.
        check([8.9, 2.0, 0.45], [0.0, 0.0, -2.5], fence, Inside);
    }

    #[test]
    fn ceiling_applies_to_the_body_centre() {
        let ceiling = "the ceiling";
        check([8.0, 2.0, 2.0], [0.0, 0.0, 0.0], ceiling, FenceVerdict::Inside);
        check([8.0, 2.0, 2.3], [0.0, 0.0, 0.0], ceiling, FenceVerdict::Near);
        check([8.0, 2.0, 2.0], [0.0, 0.0, 3.5], ceiling, FenceVerdict::Breach);
        check([8.0, 2.0, 2.51], [0.0, 0.0, 0.0], ceiling, FenceVerdict::Breach);
    }

    #[test]
    fn thin_box_between_poses_is_detected() {
        let shelf = "the no-fly box shelf";
        check([3.0, 2.0, 0.5], [0.0, 0.0, 0.0], shelf, FenceVerdict::Inside);
        check([3.0, 2.0, 0.5], [4.5, 0.0, 0.0], shelf, FenceVerdict::Breach);
        // The stopping position is behind the box.
        check([3.3, 2.0, 0.5], [5.5, 0.0, 0.0], shelf, FenceVerdict::Breach);
        check([3.3, 2.0, 1.5], [5.5, 0.0, 0.0], shelf, FenceVerdict::Inside);
        // Down onto the box, and next to it.
        check([4.05, 2.0, 1.2], [0.0, 0.0, -2.0], shelf, FenceVerdict::Breach);
        check([4.05, 2.0, 1.05], [0.0, 0.0, 0.0], shelf, FenceVerdict::Breach);
        let boundaries = boundaries();
        let jump = boundaries.check([3.5, 2.0, 0.5].into(), [4.5, 2.0, 0.5].into(), DVec3::ZERO);
        assert_eq!(jump.boundary.to_string(), shelf, "{jump:?}");
        assert_eq!(jump.verdict, FenceVerdict::Breach, "{jump:?}");
    }
}
