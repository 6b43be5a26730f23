//! Geofence with stopping distances, from the vehicle's response: maximum speed towards each face, the ceiling
//! (`max_altitude_m`), the floor, and the no-fly boxes.

use glam::DVec3;
use vizflyt_protocol::geometry::Volume;
use vizflyt_protocol::messages::{ArenaInfo, MAX_NO_FLY};

use super::response::{Response, Stopping, largest};

/// Keep-in volume, reduced by the body and a margin, and the no-fly boxes.
#[derive(Clone, Debug)]
pub(super) struct Fence {
    volume: Volume,
    keep_out: heapless::Vec<Volume, MAX_NO_FLY>,
    body_radius_m: f64,
    /// Minimum height of the body's centre while a plugin flies. [m, world]
    floor_m: f64,
    /// Maximum height of the body's centre, if limited. [m, world]
    ceiling_m: Option<f64>,
    /// Maximum rate of change of commands. [m/s^2]
    max_mps2: f64,
}

/// Motion and response of the vehicle.
#[derive(Clone, Copy, Debug)]
pub(super) struct Momentum {
    /// Velocity. [m/s, world]
    pub v_mps: DVec3,
    /// Estimated acceleration. [m/s^2, world]
    pub a_mps2: DVec3,
    pub response: Response,
}

/// Limit that the body's centre must not pass.
#[derive(Clone, Copy, Debug)]
enum Limit {
    Fence,
    Floor,
    Ceiling,
    /// Index in [`Fence::keep_out`].
    Box(usize),
}

impl Limit {
    /// Returns the distance that a stop must leave to the limit: half of the margin. [m]
    fn kept_m(self) -> f64 {
        0.5 * if matches!(self, Self::Floor) { FLOOR_MARGIN_M } else { MARGIN_M }
    }
}

/// Share of acceleration and jerk used for stopping before one face. Three faces at once (a corner) need sqrt(3)/2 =
/// 0.87 of the limit.
const STOPPING_SHARE: f64 = 0.5;
/// Minimum share, if the velocity along the face must change more than the velocity towards it.
const LEAST_SHARE: f64 = 0.1;
/// Share used if the whole stop is simulated, in all directions at once.
const WHOLE_SHARE: f64 = 0.8;
/// Tolerance for rounding errors, so that they do not move a vehicle at rest. [m]
const ROUNDING_M: f64 = 1e-3;
/// Free distance beyond the stopping distance, for localization and tracking errors: after hard braking, an autopilot's
/// integrators carry the vehicle 0.1 m too far. [m]
pub(super) const MARGIN_M: f64 = 0.2;
/// Free distance under the body while a plugin flies; the autopilot does the landing. Smaller than the margin of the
/// fence, because courses contain low flight and a contact with the floor is only a bump. [m]
const FLOOR_MARGIN_M: f64 = 0.05;
/// Maximum iterations over boxes and fence, until corners between them are resolved.
const SETTLING_TURNS: usize = 4;
/// At a curved face, share of the remaining distance that a stopping path must leave.
const KEPT_SHARE: f64 = 0.9;
/// Gain from the violation of the margin to the speed back. [1/s]
const BACK_PER_S: f64 = 2.0;
/// Maximum speed back. [m/s]
const BACK_MPS: f64 = 0.5;

impl Fence {
    pub(super) fn new(arena: &ArenaInfo, max_acceleration_mps2: f64) -> Self {
        Self {
            volume: arena.geofence,
            keep_out: arena.no_fly.clone(),
            floor_m: arena.floor_z_m + arena.body_radius_m + FLOOR_MARGIN_M,
            body_radius_m: arena.body_radius_m,
            ceiling_m: arena.limits.max_altitude_m,
            max_mps2: max_acceleration_mps2,
        }
    }

    /// Whether all faces are flat and there are no no-fly boxes.
    pub(super) fn is_flat(&self) -> bool {
        matches!(self.volume, Volume::Cuboid { .. }) && self.keep_out.is_empty()
    }

    /// Returns the distance of the body's surface outside the fence; negative inside. [m]
    pub(super) fn outside_m(&self, p_m: DVec3) -> f64 {
        self.volume.signed_distance_m(p_m) + self.body_radius_m
    }

    /// Returns the depth of the body's surface in a no-fly box; negative outside all boxes. [m]
    pub(super) fn inside_no_fly_m(&self, p_m: DVec3) -> f64 {
        let depth_m = |volume: &Volume| self.body_radius_m - volume.signed_distance_m(p_m);
        self.keep_out.iter().map(depth_m).fold(f64::NEG_INFINITY, f64::max)
    }

    /// Returns `v_mps` reduced so that the vehicle does not fly from `p_m` over the fence, the ceiling or the floor, or
    /// into a box. Motion along a face is not changed, unless it uses acceleration that stopping before the face needs.
    /// [m/s, world]
    pub(super) fn limit(&self, p_m: DVec3, v_mps: DVec3, vehicle: &Momentum) -> DVec3 {
        self.leave_for_stopping(p_m, self.towards_faces(p_m, v_mps, vehicle), vehicle)
    }

    /// Part of [`Self::limit`]: limits the speed towards each face.
    fn towards_faces(&self, p_m: DVec3, v_mps: DVec3, vehicle: &Momentum) -> DVec3 {
        let mut v = self.within(p_m, v_mps, vehicle);
        if self.keep_out.is_empty() {
            return v;
        }
        // Moving away from a box may lead to another box or to the fence: iterate.
        for _ in 0..SETTLING_TURNS {
            let before = v;
            for volume in &self.keep_out {
                let (towards, most) = self.towards(volume, p_m, v, vehicle);
                v += towards * (most - v.dot(towards)).min(0.0);
            }
            if v == before {
                break;
            }
            v = self.within(p_m, v, vehicle);
        }
        // If no direction is free, reduce the speed: fence and boxes are both respected.
        let share = self.keep_out.iter().fold(1.0, |share: f64, volume| {
            let (towards, most) = self.towards(volume, p_m, v, vehicle);
            let speed_mps = v.dot(towards);
            if speed_mps > most.max(0.0) { share.min(most.max(0.0) / speed_mps) } else { share }
        });
        v * share
    }

    /// Returns the direction to a box and the maximum speed in that direction. Boxes are convex, so the vehicle
    /// approaches by at most its motion along the present direction. [m/s]
    fn towards(
        &self,
        volume: &Volume,
        p_m: DVec3,
        v_mps: DVec3,
        vehicle: &Momentum,
    ) -> (DVec3, f64) {
        let free_m = volume.signed_distance_m(p_m) - self.body_radius_m - MARGIN_M;
        let towards = -volume.outward_normal(p_m);
        (towards, self.approach_mps(free_m, towards, v_mps, vehicle))
    }

    /// Returns `v_mps` reduced so that the vehicle does not fly from `p_m` over the fence, the ceiling or the floor.
    /// [m/s, world]
    fn within(&self, p_m: DVec3, v_mps: DVec3, vehicle: &Momentum) -> DVec3 {
        match self.volume {
            // Each face separately, so that the vehicle can slide along two faces into a corner.
            Volume::Cuboid { center_m, half_m, rotation } => {
                let q = rotation.conjugate() * (p_m - center_m);
                let free_m = half_m - DVec3::splat(self.body_radius_m + MARGIN_M);
                let mut v = rotation.conjugate() * v_mps;
                for (axis, face) in [DVec3::X, DVec3::Y, DVec3::Z].into_iter().enumerate() {
                    let out = rotation * face;
                    let most = self.approach_mps(free_m[axis] - q[axis], out, v_mps, vehicle);
                    let least = -self.approach_mps(free_m[axis] + q[axis], -out, v_mps, vehicle);
                    // In a room narrower than its margins, no speed is valid for both faces.
                    v[axis] = if least > most { 0.0 } else { v[axis].clamp(least, most) };
                }
                let v = rotation * v;
                let below = self.between_floor_and_ceiling(p_m, v, vehicle);
                // A smaller climb changes the motion towards the walls only in a tilted room.
                let leans = (rotation * DVec3::Z).z.abs() < 1.0 - 1e-9;
                if leans && below != v { self.shorten(p_m, below, vehicle) } else { below }
            }
            // One face, the nearest. Then the whole stopping path, because faces may be curved.
            volume => {
                let outward = volume.outward_normal(p_m);
                let free_m = -self.outside_m(p_m) - MARGIN_M;
                let most = self.approach_mps(free_m, outward, v_mps, vehicle);
                let v = v_mps + outward * (most - v_mps.dot(outward)).min(0.0);
                self.shorten(p_m, self.between_floor_and_ceiling(p_m, v, vehicle), vehicle)
            }
        }
    }

    /// Returns `v_mps` with the vertical speed limited so that the vehicle stops below the ceiling and above the floor.
    /// [m/s, world]
    fn between_floor_and_ceiling(&self, p_m: DVec3, v_mps: DVec3, vehicle: &Momentum) -> DVec3 {
        let approach = |free_m, out| self.approach_mps(free_m, out, v_mps, vehicle);
        let most = self.ceiling_m.map(|ceiling_m| approach(ceiling_m - MARGIN_M - p_m.z, DVec3::Z));
        let least = -approach(p_m.z - self.floor_m, DVec3::NEG_Z);
        v_mps.with_z(v_mps.z.max(least).min(most.unwrap_or(f64::INFINITY)))
    }

    /// Returns the maximum speed towards a face at a distance of `free_m`, at most that of `v_mps`, from which the
    /// vehicle stops before the face. Negative (back) if the distance is negative. [m/s]
    fn approach_mps(&self, free_m: f64, out: DVec3, v_mps: DVec3, vehicle: &Momentum) -> f64 {
        if !(free_m > 0.0) {
            return (BACK_PER_S * free_m).max(-BACK_MPS);
        }
        let wanted_mps = v_mps.dot(out);
        if !(wanted_mps > 0.0) {
            return 0.0;
        }
        let (flown_mps, a_mps2) = (vehicle.v_mps.dot(out), vehicle.a_mps2.dot(out));
        // Velocity changes along the face leave less acceleration for stopping before it.
        let along_mps = wanted_mps.max(flown_mps);
        let aside_mps = |v_mps: DVec3| (v_mps - vehicle.v_mps).reject_from_normalized(out).length();
        // The next command may be a complete stop.
        let aside_mps = aside_mps(v_mps).max(aside_mps(DVec3::ZERO));
        let share = along_mps / along_mps.hypot(aside_mps).max(f64::MIN_POSITIVE);
        let share = share.clamp(LEAST_SHARE, STOPPING_SHARE);
        let stopping = Stopping::new(vehicle.response, self.max_mps2, share);
        stopping.most_mps(wanted_mps, free_m, flown_mps, a_mps2)
    }

    /// Returns `v_mps`, slowed until the vehicle can stop before all limits. The component away from the nearest limit
    /// is kept; one factor reduces the rest. [m/s, world]
    ///
    /// [`Self::towards_faces`] treats each face separately. Acceleration along a face is not available for the stop
    /// before it, and a plugin may request more of it after the stop command. Therefore this function simulates the
    /// whole stop with the vehicle's full acceleration. Half of the margin is left for the errors of this model.
    fn leave_for_stopping(&self, p_m: DVec3, v_mps: DVec3, vehicle: &Momentum) -> DVec3 {
        let stopping = Stopping::new(vehicle.response, self.max_mps2, WHOLE_SHARE);
        let (flown_mps, a_mps2) = (vehicle.v_mps.length(), vehicle.a_mps2.length());
        let reach_m = stopping.bound_m(v_mps.length(), flown_mps, a_mps2);
        // Ignore limits that are out of reach.
        let mut near: heapless::Vec<(Limit, f64), { MAX_NO_FLY + 3 }> = heapless::Vec::new();
        let mut nearest = (f64::INFINITY, DVec3::ZERO);
        for limit in self.limits() {
            let (room_m, kept_m) = (self.room_m(limit, p_m), limit.kept_m());
            if room_m < kept_m + reach_m {
                // If the vehicle is nearer than the kept distance, or beyond the limit, a stop must not increase the
                // violation.
                let near_m = if room_m > 0.0 { KEPT_SHARE * room_m } else { room_m };
                let _ = near.push((limit, kept_m.min(near_m) - ROUNDING_M));
            }
            if room_m < nearest.0 {
                nearest = (room_m, self.direction_to(limit, p_m));
            }
        }
        if near.is_empty() {
            return v_mps;
        }
        let stays = |way_m: DVec3| {
            near.iter().all(|&(limit, least_m)| self.room_m(limit, p_m + way_m) >= least_m)
        };
        let back = nearest.1 * v_mps.dot(nearest.1).min(0.0);
        let rest = v_mps - back;
        let share = largest(1.0, |share| {
            stopping.stays(back + rest * share, vehicle.v_mps, vehicle.a_mps2, stays)
        });
        back + rest * share
    }

    /// Returns the limits that exist in this arena.
    fn limits(&self) -> impl Iterator<Item = Limit> {
        let ceiling = self.ceiling_m.map(|_| Limit::Ceiling);
        let boxes = (0..self.keep_out.len()).map(Limit::Box);
        [Limit::Fence, Limit::Floor].into_iter().chain(ceiling).chain(boxes)
    }

    /// Returns the room left at `p_m` before a limit; negative beyond it. [m]
    fn room_m(&self, limit: Limit, p_m: DVec3) -> f64 {
        match limit {
            Limit::Fence => -self.outside_m(p_m),
            Limit::Floor => p_m.z - self.floor_m + FLOOR_MARGIN_M,
            Limit::Ceiling => self.ceiling_m.map_or(f64::INFINITY, |ceiling_m| ceiling_m - p_m.z),
            Limit::Box(index) => self.keep_out[index].signed_distance_m(p_m) - self.body_radius_m,
        }
    }

    /// Returns the direction from `p_m` to a limit.
    fn direction_to(&self, limit: Limit, p_m: DVec3) -> DVec3 {
        match limit {
            Limit::Fence => self.volume.outward_normal(p_m),
            Limit::Floor => DVec3::NEG_Z,
            Limit::Ceiling => DVec3::Z,
            Limit::Box(index) => -self.keep_out[index].outward_normal(p_m),
        }
    }

    /// Scales `v_mps` until the stopping path is inside. Nearer than the margin, the path must not approach further.
    fn shorten(&self, p_m: DVec3, v_mps: DVec3, vehicle: &Momentum) -> DVec3 {
        let keep_m = (-KEPT_SHARE * self.outside_m(p_m)).clamp(0.0, MARGIN_M);
        let stopping = Stopping::new(vehicle.response, self.max_mps2, STOPPING_SHARE);
        let inside = |way_m: DVec3| self.outside_m(p_m + way_m) + keep_m <= 0.0;
        v_mps
            * largest(1.0, |scale| {
                stopping.stays(v_mps * scale, vehicle.v_mps, vehicle.a_mps2, inside)
            })
    }
}
