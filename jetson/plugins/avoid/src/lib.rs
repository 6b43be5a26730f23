//! Flies to the goal through a forest with a potential field on the depth image.
//!
//! Steps at every image, 45 to 100 times per second:
//! 1. [`scan`]: convert depth pixels to obstacle points in the world frame, without floor and sky;
//! 2. [`memory`]: keep the points of the last seconds, because the camera no longer sees some of them;
//! 3. [`field`]: compute the distance to obstacles and the length of the way to the goal around the vehicle;
//! 4. [`steer`]: choose the velocity with the most progress and enough clearance, at most the speed that [`pace`]
//!    allows;
//! 5. this file: height, heading and arrival; returns the velocity as a [`Setpoint`].
//!
//! The nose points in the direction of flight, so that the camera sees obstacles there. The computation takes about 0.7
//! ms per image.
//!
//! To try an idea, change a constant at the end of a file, or one step, and fly: `cargo run -- demo --plugin PATH`.
//! Each constant has a comment with its reason.

pub mod field;
pub mod memory;
pub mod pace;
pub mod scan;
pub mod steer;

use vizflyt_sdk::glam::{DQuat, DVec2, DVec3};
use vizflyt_sdk::{
    ArenaInfo, Autonomy, Body, CameraImage, Event, EventKind, HostTime, Observation, Pose,
    Setpoint, SetpointKind, Vehicle, World, YawTarget,
};

use field::{Field, Surroundings};
use memory::Memory;
use pace::Pace;
use scan::{Scan, View};
use steer::PlanarState;

/// The plugin.
#[derive(Clone, Debug, Default)]
pub struct Avoid {
    arena: Option<ArenaInfo>,
    scan: Scan,
    memory: Memory,
    field: Field,
    /// Last returned velocity, and its time. [m/s, world]
    setpoint_mps: DVec2,
    last: Option<HostTime>,
    pace: Pace,
    /// Last time at which the image had enough returns.
    seen: Option<HostTime>,
    finished: bool,
}

impl Autonomy for Avoid {
    fn on_start(&mut self, info: &ArenaInfo) {
        *self = Self { arena: Some(info.clone()), ..Self::default() };
    }

    fn on_image(&mut self, obs: &Observation<'_>) -> Option<Setpoint> {
        // Without a pose, return no setpoint: the guard holds, then lands.
        let vehicle = Located::of(&obs.vehicle()?)?;
        let camera = obs.camera("front").or_else(|| obs.cameras().next())?;
        self.decide(&vehicle, &camera)
    }

    fn on_event(&mut self, event: &Event) {
        if matches!(event.kind, EventKind::Finished { .. }) {
            self.finished = true;
        }
    }
}

/// State of a vehicle with a known position.
struct Located {
    stamp: HostTime,
    world_from_body: Pose<World, Body>,
    v_world_mps: DVec3,
    omega_body_radps: DVec3,
}

impl Located {
    fn of(vehicle: &Vehicle) -> Option<Self> {
        Some(Self {
            stamp: vehicle.stamp,
            world_from_body: vehicle.world_from_body?,
            v_world_mps: vehicle.v_world_mps?,
            omega_body_radps: vehicle.omega_body_radps,
        })
    }

    /// Extrapolates the pose to another instant, at most 0.3 s away, with constant velocity and angular velocity.
    fn at(&self, then: HostTime) -> Pose<World, Body> {
        let ahead_s = then.seconds_since(self.stamp).clamp(-BLIND_S, BLIND_S);
        Pose::new(
            self.world_from_body.translation_m + self.v_world_mps * ahead_s,
            self.world_from_body.rotation
                * DQuat::from_scaled_axis(self.omega_body_radps * ahead_s),
        )
    }
}

impl Avoid {
    fn decide(&mut self, vehicle: &Located, camera: &CameraImage<'_>) -> Option<Setpoint> {
        let arena = self.arena.as_ref()?;
        let Some(goal_m) = arena.goal_m.filter(|_| !self.finished) else {
            return Some(Setpoint::Hold);
        };
        if !(vehicle.world_from_body.is_valid() && vehicle.v_world_mps.is_finite()) {
            return None;
        }
        let now = vehicle.stamp;
        let gap_s = self.last.map_or(0.0, |last| now.seconds_since(last));
        self.pace.add(gap_s);
        let dt_s = gap_s.clamp(0.0, MAX_DT_S);
        self.last = Some(now);

        // 1. Update the map.
        let p_m = vehicle.world_from_body.translation_m;
        let view = view_of(vehicle, camera);
        self.scan.update(&view, p_m.z);
        if !self.scan.is_blind() {
            self.seen = Some(now);
        }
        let now_s = now.as_ns() as f64 * 1e-9;
        self.memory.update(now_s, &view, &self.scan.points_m);

        // 2. Compute the field.
        let around = Surroundings {
            p_m,
            goal_m: goal_m.truncate(),
            geofence: &arena.geofence,
            body_radius_m: arena.body_radius_m,
        };
        self.field.update(&around, self.memory.points_m());

        // 3. Choose a velocity.
        let to_goal_m = (goal_m - p_m).truncate();
        if to_goal_m.length() < ARRIVED * arena.goal_radius_m {
            self.setpoint_mps = vehicle.v_world_mps.truncate();
            return Some(Setpoint::Position { p_world_m: goal_m, yaw: YawTarget::Keep });
        }
        let nose = vehicle.world_from_body.rotate(DVec3::X).truncate();
        let v_mps = vehicle.v_world_mps.truncate();
        let motion = PlanarState {
            p_m: p_m.truncate(),
            v_mps,
            // Before take-off the vehicle does not follow the setpoint, so limit their difference.
            setpoint_mps: v_mps + (self.setpoint_mps - v_mps).clamp_length_max(MAX_LEAD_MPS),
            heading_rad: nose.to_angle(),
            late_s: self.pace.late_s(),
        };
        let sighted = self.seen.is_some_and(|seen| now.seconds_since(seen) < BLIND_S);
        let wanted_mps = if sighted {
            let cruise_mps = CRUISE_MPS
                .min(CRUISE_SHARE * arena.limits.max_speed_mps)
                .min(self.pace.limit_mps());
            let stop_mps = (2.0 * BRAKE_MPS2 * to_goal_m.length()).sqrt();
            steer::choose_velocity(&self.field, &motion, cruise_mps.min(stop_mps))
        } else {
            DVec2::ZERO
        };
        self.setpoint_mps = steer::slew(motion.setpoint_mps, wanted_mps, dt_s);

        let climb_mps = (CLIMB_PER_S * (goal_m.z - p_m.z)).clamp(-CLIMB_MPS, CLIMB_MPS);
        let look = if wanted_mps.length() > LOOK_MPS { wanted_mps } else { to_goal_m };
        let v_mps = self.setpoint_mps.extend(climb_mps);
        let yaw = YawTarget::Angle(look.to_angle());
        if arena.setpoints.contains(SetpointKind::Velocity) {
            return Some(Setpoint::velocity(v_mps, yaw));
        }
        // The course allows only positions: fly to the point at which the guard flies at this speed.
        Some(Setpoint::Position { p_world_m: p_m + v_mps / POINT_PER_S, yaw })
    }
}

/// Returns the image with the pose from which it was rendered. The server predicts that pose. If images are late, the
/// vehicle's state at the same instant may differ by decimetres at the obstacles.
fn view_of<'a>(vehicle: &Located, camera: &CameraImage<'a>) -> View<'a> {
    let world_from_body = camera.pose_at_image.unwrap_or_else(|| vehicle.at(camera.shown));
    View {
        depth_mm: camera.depth_mm,
        intrinsics: camera.intrinsics,
        world_from_cam: world_from_body * camera.body_from_cam,
    }
}

/// Fast enough for 37 m in 11 s, slow enough to stop (2.9 m) within half of the field (8 m). With 4.2 m/s, and 5 m/s^2
/// of slew, agile vehicles crossed every forest, but sluggish ones hit a tree in 1 of 20. [m/s]
const CRUISE_MPS: f64 = 3.6;
/// Fraction of the arena's maximum speed; the rest is a reserve for overshoot.
const CRUISE_SHARE: f64 = 0.7;
/// Deceleration at the goal. [m/s^2]
const BRAKE_MPS2: f64 = 2.5;
/// Within this fraction of the goal's radius, the setpoint is the goal.
const ARRIVED: f64 = 0.5;
/// Maximum difference of setpoint and velocity: slew times lag is 1.2 m/s, plus a reserve. [m/s]
const MAX_LEAD_MPS: f64 = 1.6;
/// Maximum time step; a longer one counts as a gap between images. [s]
const MAX_DT_S: f64 = 0.1;
/// Stop if no image had enough returns for this long. [s]
const BLIND_S: f64 = 0.3;
/// Height control: time constant of 0.7 s, at most 1 m/s.
const CLIMB_PER_S: f64 = 1.5;
const CLIMB_MPS: f64 = 1.0;
/// The guard's speed towards a point is at most the distance times this. [1/s]
const POINT_PER_S: f64 = 0.8;
/// Below this speed the direction of travel is meaningless, and the nose points at the goal. [m/s]
const LOOK_MPS: f64 = 0.3;

#[cfg(test)]
mod tests;
