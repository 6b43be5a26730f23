//! Follows a plugin's trajectory: computes position and velocity of a reference point from the vehicle's
//! position and `dt`, at the guard's rate (50 to 200 Hz). The guard steers towards the reference and applies
//! all limits.
//!
//! The reference slows down with increasing distance to the vehicle. A vehicle that the guard slows down, or
//! that starts away from the path, therefore still flies the complete path.

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::yaw_of;
use vizflyt_protocol::messages::{Axes, Path, PathYaw, Trajectory, YawTarget};

/// Desired position, velocity and heading.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reference {
    /// Position. [m, world]
    pub p_world_m: DVec3,
    /// Velocity. [m/s, world]
    pub v_world_mps: DVec3,
    /// Desired heading.
    pub yaw: YawTarget,
}

/// Pose of the vehicle at the start of a path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Start {
    /// Position. [m, world]
    pub p_world_m: DVec3,
    /// Attitude: body to world.
    pub rotation: DQuat,
}

/// Distance to the vehicle up to which the reference keeps its speed: the usual lag at 3 m/s. [m]
const FREE_LAG_M: f64 = 0.5;
/// Distance to the vehicle at which the reference stops. [m]
const MAX_LAG_M: f64 = 1.5;
/// Share of the acceleration limit used for waypoints; the rest is for corrections.
const SHARE: f64 = 0.5;
/// Duration of a turn at a corner: limits the change of velocity to this time at that acceleration. [s]
const CORNER_S: f64 = 0.25;
/// Length below which a leg has no direction. [m]
const MIN_M: f64 = 1e-6;
/// Horizontal speed below which the direction of travel is undefined. [m/s]
const MIN_MPS: f64 = 0.05;

/// Follows one trajectory. See the module.
#[derive(Clone, Debug)]
pub struct Follower {
    trajectory: Trajectory,
    origin_m: DVec3,
    world_from_axes: DQuat,
    progress: Progress,
    /// Last direction of travel, for the heading.
    ahead: YawTarget,
    is_over: bool,
}

#[derive(Clone, Debug)]
enum Progress {
    /// Legs between waypoints, index of the present leg, distance on it, and speed.
    Legs { legs: Vec<Leg>, at: usize, way_m: f64, speed_mps: f64 },
    /// Index of the present piece of the polynomial, and time in it.
    Piece { at: usize, t_s: f64 },
}

/// A straight line. [m, world]
#[derive(Clone, Copy, Debug)]
struct Leg {
    from_m: DVec3,
    direction: DVec3,
    length_m: f64,
    speed_mps: f64,
}

impl Follower {
    /// Starts to follow `trajectory` from the vehicle's pose.
    pub fn new(trajectory: Trajectory, start: &Start) -> Self {
        let (origin_m, world_from_axes) = match trajectory.axes {
            Axes::World => (DVec3::ZERO, DQuat::IDENTITY),
            Axes::Heading => (start.p_world_m, DQuat::from_rotation_z(yaw_of(start.rotation))),
            Axes::Body => (start.p_world_m, start.rotation),
        };
        let progress = match &trajectory.path {
            Path::Waypoints(points) => {
                let mut from_m = start.p_world_m;
                let legs = points.iter().filter_map(|point| {
                    let to_m = origin_m + world_from_axes * point.p_m;
                    let way_m = to_m - from_m;
                    let length_m = way_m.length();
                    (length_m > MIN_M).then(|| {
                        let direction = way_m / length_m;
                        let leg = Leg { from_m, direction, length_m, speed_mps: point.speed_mps };
                        from_m = to_m;
                        leg
                    })
                });
                Progress::Legs { legs: legs.collect(), at: 0, way_m: 0.0, speed_mps: 0.0 }
            }
            Path::Polynomial(_) => Progress::Piece { at: 0, t_s: 0.0 },
        };
        let ahead = YawTarget::Keep;
        Self { trajectory, origin_m, world_from_axes, progress, ahead, is_over: false }
    }

    pub fn trajectory(&self) -> &Trajectory {
        &self.trajectory
    }

    /// Whether the reference has reached the end of the path.
    pub fn is_over(&self) -> bool {
        self.is_over
    }

    /// Advances the reference by `dt_s`, for a vehicle at `p_world_m` with these limits of speed and
    /// acceleration; returns it.
    pub fn advance(
        &mut self,
        p_world_m: DVec3,
        (max_speed_mps, max_acceleration_mps2): (f64, f64),
        dt_s: f64,
    ) -> Reference {
        let lag_m = (self.place().0 - p_world_m).length();
        let pace = ((MAX_LAG_M - lag_m) / (MAX_LAG_M - FREE_LAG_M)).clamp(0.0, 1.0);
        match &mut self.progress {
            Progress::Legs { legs, at, way_m, speed_mps } => {
                let acceleration_mps2 = SHARE * max_acceleration_mps2;
                let wanted_mps = most_mps(&legs[*at..], *way_m, max_speed_mps, acceleration_mps2);
                *speed_mps = wanted_mps.min(*speed_mps + acceleration_mps2 * dt_s);
                *way_m += *speed_mps * pace * dt_s;
                while let Some(leg) = legs.get(*at)
                    && *way_m >= leg.length_m - MIN_M
                {
                    (*way_m, *at) = ((*way_m - leg.length_m).max(0.0), *at + 1);
                }
                self.is_over = *at >= legs.len();
            }
            Progress::Piece { at, t_s } => {
                let Path::Polynomial(pieces) = &self.trajectory.path else { unreachable!() };
                *t_s += pace * dt_s;
                while let Some(piece) = pieces.get(*at)
                    && *t_s >= piece.seconds
                {
                    (*t_s, *at) = (*t_s - piece.seconds, *at + 1);
                }
                self.is_over = *at >= pieces.len();
            }
        }
        let (p_world_m, v_world_mps) = self.place();
        if v_world_mps.truncate().length() > MIN_MPS {
            self.ahead = YawTarget::Angle(v_world_mps.y.atan2(v_world_mps.x));
        }
        let yaw = match self.trajectory.yaw {
            PathYaw::Ahead => self.ahead,
            PathYaw::Target(yaw) => yaw,
        };
        Reference { p_world_m, v_world_mps: v_world_mps * pace, yaw }
    }

    /// Returns position and velocity of the reference without slowdown. [m, m/s, world]
    fn place(&self) -> (DVec3, DVec3) {
        match &self.progress {
            Progress::Legs { legs, at, way_m, speed_mps } => match (legs.get(*at), legs.last()) {
                (Some(leg), _) => (leg.from_m + leg.direction * *way_m, leg.direction * *speed_mps),
                (None, Some(last)) => (last.from_m + last.direction * last.length_m, DVec3::ZERO),
                // All waypoints are at the start position.
                (None, None) => (self.only_point_m(), DVec3::ZERO),
            },
            Progress::Piece { at, t_s } => {
                let Path::Polynomial(pieces) = &self.trajectory.path else { unreachable!() };
                let (p_m, v_mps) = match (pieces.get(*at), pieces.last()) {
                    (Some(piece), _) => (piece.position_m(*t_s), piece.velocity_mps(*t_s)),
                    (None, Some(last)) => (last.position_m(last.seconds), DVec3::ZERO),
                    (None, None) => (DVec3::ZERO, DVec3::ZERO),
                };
                (self.origin_m + self.world_from_axes * p_m, self.world_from_axes * v_mps)
            }
        }
    }

    fn only_point_m(&self) -> DVec3 {
        let Path::Waypoints(points) = &self.trajectory.path else { return self.origin_m };
        let p_m = points.last().map_or(DVec3::ZERO, |point| point.p_m);
        self.origin_m + self.world_from_axes * p_m
    }
}

/// Returns the maximum speed at the distance `way_m` on the first leg that still allows all later corners and
/// the stop at the end. [m/s]
fn most_mps(legs: &[Leg], way_m: f64, max_speed_mps: f64, acceleration_mps2: f64) -> f64 {
    let Some(first) = legs.first() else { return 0.0 };
    let mut most_mps = first.speed_mps.min(max_speed_mps);
    let mut to_corner_m = -way_m;
    for (index, leg) in legs.iter().enumerate() {
        to_corner_m += leg.length_m;
        let corner_mps = legs.get(index + 1).map_or(0.0, |next| {
            // Turning v by an angle changes it by 2 v sin(angle / 2) = v |d1 - d2|.
            let turn = (next.direction - leg.direction).length();
            next.speed_mps.min(acceleration_mps2 * CORNER_S / turn.max(MIN_M))
        });
        let braking_mps =
            (corner_mps * corner_mps + 2.0 * acceleration_mps2 * to_corner_m.max(0.0)).sqrt();
        most_mps = most_mps.min(braking_mps);
    }
    most_mps
}

#[cfg(test)]
mod tests;
