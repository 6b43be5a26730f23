//! Flies the plugin through solids and measures the result with the true state.

use std::collections::VecDeque;

use vizflyt_avoid::Avoid;
use vizflyt_sdk::glam::{DMat3, DQuat, DVec3};
use vizflyt_sdk::protocol::geometry::{body_from_forward_cam, wrap_pi};
use vizflyt_sdk::protocol::messages::bounded;
use vizflyt_sdk::{
    ArenaInfo, Autonomy, CameraInfo, HostTime, ImageStamps, Intrinsics, Limits, ObservationBuffer,
    Pose, Setpoint, Vehicle, Volume, World, YawTarget,
};

use super::camera::{self, Faults};
use super::{GOAL_M, Random};

/// Behaviour of vehicle, camera and links.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Conditions {
    /// First-order lag of velocity. [s]
    pub(crate) lag_s: f64,
    /// Maximum horizontal acceleration. [m/s^2]
    pub max_acceleration_mps2: f64,
    /// Maximum rate of turn. [rad/s]
    pub(crate) max_yaw_rate_radps: f64,
    /// Age of an image when the plugin receives it. [s]
    pub(crate) image_age_s: f64,
    /// Age of the vehicle's state when the plugin receives it. [s]
    pub(crate) state_age_s: f64,
    /// Delay until a setpoint takes effect. [s]
    pub(crate) setpoint_delay_s: f64,
    /// Interval between images. [s]
    pub(crate) image_period_s: f64,
    /// Faults of the depth camera.
    pub(crate) faults: Faults,
}

/// A quadrotor with an autopilot that tracks velocities; 50 images per second, 40 ms old.
pub(crate) const TYPICAL: Conditions = Conditions {
    lag_s: 0.25,
    max_acceleration_mps2: 7.0,
    max_yaw_rate_radps: 2.0,
    image_age_s: 0.04,
    state_age_s: 0.015,
    setpoint_delay_s: 0.02,
    image_period_s: 0.02,
    faults: Faults { noise: 0.01, holes: 0.02, blurred_edges: true, sky_mm: 0 },
};

/// A heavy vehicle on a slow link, with a poor camera: half of the agility, twice the delays.
pub(crate) const SLUGGISH: Conditions = Conditions {
    lag_s: 0.4,
    max_acceleration_mps2: 3.5,
    max_yaw_rate_radps: 1.2,
    image_age_s: 0.08,
    state_age_s: 0.04,
    setpoint_delay_s: 0.05,
    image_period_s: 0.04,
    faults: Faults { noise: 0.02, holes: 0.1, blurred_edges: true, sky_mm: 60000 },
};

/// A server with a fifth of its processor: images and poses arrive every 0.13 s.
pub(crate) const STARVED: Conditions = Conditions { image_period_s: 0.13, ..TYPICAL };

/// Result of a flight, from the true state.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Outcome {
    pub(crate) finished: bool,
    pub(crate) collided: bool,
    pub(crate) seconds: f64,
    /// Straight distance from start to goal, divided by the time, so that detours do not count. [m/s]
    pub(crate) mean_speed_mps: f64,
    pub(crate) max_speed_mps: f64,
    /// Smallest distance from the body's surface to a solid other than the floor. [m]
    pub(crate) min_clearance_m: f64,
    /// Smallest distance from the body's surface to the geofence. [m]
    pub(crate) min_fence_m: f64,
    pub(crate) end_m: DVec3,
}

/// The demo's camera with a ninth of its pixels, for speed.
pub(crate) fn small_camera() -> CameraInfo {
    CameraInfo {
        name: bounded("front"),
        intrinsics: Intrinsics::from_horizontal_fov(104, 78, 90_f64.to_radians()),
        body_from_cam: body_from_forward_cam(DVec3::new(0.06, 0.0, 0.02), 0.0),
    }
}

/// The arena of the forest, with the small camera.
pub(crate) fn arena() -> ArenaInfo {
    let geofence = Volume::Cuboid {
        center_m: DVec3::new(20.5, 0.0, 1.75),
        half_m: DVec3::new(21.5, 7.0, 2.25),
        rotation: DQuat::IDENTITY,
    };
    ArenaInfo {
        body_radius_m: 0.12,
        takeoff_height_m: 1.2,
        goal_m: Some(GOAL_M),
        time_limit_s: 60.0,
        cameras: [small_camera()].into_iter().collect(),
        ..ArenaInfo::new("forest", geofence, Limits::new(6.0, 8.0))
    }
}

/// Flies from start to goal. Ends at the goal, at the first collision, or after `limit_s`.
pub(crate) fn fly(
    volumes: &[Volume],
    arena: &ArenaInfo,
    start_m: DVec3,
    conditions: Conditions,
    seed: u64,
    limit_s: f64,
) -> Outcome {
    let mut random = Random::new(seed ^ 0xcafe);
    let mut plugin = Avoid::default();
    plugin.on_start(arena);
    let mut buffer = ObservationBuffer::new(&arena.cameras);
    let mut body = Body::at_rest(start_m);
    let goal_m = arena.goal_m.expect("these arenas have a goal");
    let mut history: VecDeque<Body> = VecDeque::new();
    let mut pending: VecDeque<(f64, Setpoint)> = VecDeque::new();
    let mut setpoint = Setpoint::Hold;
    let mut outcome = Outcome {
        finished: false,
        collided: false,
        seconds: 0.0,
        mean_speed_mps: 0.0,
        max_speed_mps: 0.0,
        min_clearance_m: f64::INFINITY,
        min_fence_m: f64::INFINITY,
        end_m: start_m,
    };
    let per_image = (conditions.image_period_s / DT_S).round() as u64;
    for tick in 0..(limit_s / DT_S) as u64 {
        let now_s = tick as f64 * DT_S;
        history.push_front(body);
        history.truncate(200);
        let ago = |age_s: f64| history[((age_s / DT_S) as usize).min(history.len() - 1)];
        if tick % per_image == 0 {
            let pictured = ago(conditions.image_age_s);
            let known = ago(conditions.state_age_s);
            buffer.clear(tick / per_image);
            buffer.set_vehicle(&known.vehicle());
            let stamps =
                ImageStamps { seq: tick, pose: pictured.stamp, ready: body.stamp, ahead_ns: 0 };
            let front = &arena.cameras[0];
            buffer.set_image(0, stamps, |planes| {
                let world_from_cam = pictured.world_from_body() * front.body_from_cam;
                camera::render(
                    volumes,
                    &front.intrinsics,
                    &world_from_cam,
                    conditions.faults,
                    &mut random,
                    planes.depth_mm,
                );
            });
            if let Some(answer) = plugin.on_image(&buffer.observation()) {
                assert_eq!(answer.check(), Ok(()), "{answer:?}");
                pending.push_back((now_s + conditions.setpoint_delay_s, answer));
            }
        }
        while pending.front().is_some_and(|&(at_s, _)| at_s <= now_s) {
            setpoint = pending.pop_front().unwrap().1;
        }
        body.advance(&setpoint, conditions, tick);

        outcome.seconds = now_s;
        outcome.end_m = body.p_m;
        outcome.max_speed_mps = outcome.max_speed_mps.max(body.v_mps.length());
        for volume in volumes {
            let clearance_m = volume.signed_distance_m(body.p_m) - arena.body_radius_m;
            outcome.collided |= clearance_m < 0.0;
            if !matches!(volume, Volume::HalfSpace { .. }) {
                outcome.min_clearance_m = outcome.min_clearance_m.min(clearance_m);
            }
        }
        let fence_m = -arena.geofence.signed_distance_m(body.p_m) - arena.body_radius_m;
        outcome.min_fence_m = outcome.min_fence_m.min(fence_m);
        outcome.finished = body.p_m.distance(goal_m) < arena.goal_radius_m;
        if outcome.finished || outcome.collided {
            break;
        }
    }
    outcome.mean_speed_mps = start_m.distance(goal_m) / outcome.seconds.max(DT_S);
    outcome
}

const DT_S: f64 = 0.0025;
const GRAVITY_MPS2: f64 = 9.81;
/// Lag of the attitude behind the acceleration setpoint. [s]
const TILT_LAG_S: f64 = 0.06;

/// True state of the vehicle.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Body {
    pub(crate) stamp: HostTime,
    pub(crate) p_m: DVec3,
    pub(crate) v_mps: DVec3,
    pub a_mps2: DVec3,
    pub(crate) yaw_rad: f64,
    pub(crate) omega_body_radps: DVec3,
}

impl Body {
    fn at_rest(p_m: DVec3) -> Self {
        Self {
            stamp: HostTime::from_ns(1_000_000_000),
            p_m,
            v_mps: DVec3::ZERO,
            a_mps2: DVec3::ZERO,
            yaw_rad: 0.0,
            omega_body_radps: DVec3::ZERO,
        }
    }

    /// The thrust points along the gravity-compensated acceleration, the nose along the yaw.
    fn attitude(&self) -> DQuat {
        let up = (self.a_mps2 + DVec3::Z * GRAVITY_MPS2).normalize();
        let left = up.cross(DQuat::from_rotation_z(self.yaw_rad) * DVec3::X).normalize();
        DQuat::from_mat3(&DMat3::from_cols(left.cross(up), left, up))
    }

    fn world_from_body(&self) -> Pose<World, vizflyt_sdk::Body> {
        Pose::new(self.p_m, self.attitude())
    }

    pub(crate) fn vehicle(&self) -> Vehicle {
        Vehicle {
            stamp: self.stamp,
            attitude: self.attitude(),
            omega_body_radps: self.omega_body_radps,
            world_from_body: Some(self.world_from_body()),
            v_world_mps: Some(self.v_mps),
        }
    }

    fn advance(&mut self, setpoint: &Setpoint, conditions: Conditions, tick: u64) {
        let (wanted_mps, yaw) = match *setpoint {
            Setpoint::Velocity { v_mps, yaw, .. } => (v_mps, yaw),
            Setpoint::Position { p_world_m, yaw } => ((p_world_m - self.p_m) * 1.0, yaw),
            _ => (DVec3::ZERO, YawTarget::Keep),
        };
        let before = self.attitude();
        let wanted_mps2 = ((wanted_mps - self.v_mps) / conditions.lag_s)
            .clamp_length_max(conditions.max_acceleration_mps2);
        self.a_mps2 += (wanted_mps2 - self.a_mps2) * (DT_S / TILT_LAG_S);
        self.v_mps += self.a_mps2 * DT_S;
        self.p_m += self.v_mps * DT_S;
        let rate_radps = match yaw {
            YawTarget::Keep => 0.0,
            YawTarget::Rate(rate_radps) => rate_radps,
            YawTarget::Angle(angle_rad) => 4.0 * wrap_pi(angle_rad - self.yaw_rad),
        };
        let limit = conditions.max_yaw_rate_radps;
        self.yaw_rad = wrap_pi(self.yaw_rad + rate_radps.clamp(-limit, limit) * DT_S);
        let turned = (before.conjugate() * self.attitude()).normalize();
        self.omega_body_radps = turned.to_scaled_axis() / DT_S;
        self.stamp = HostTime::from_ns(1_000_000_000 + ((tick + 1) as f64 * DT_S * 1e9) as u64);
    }
}
