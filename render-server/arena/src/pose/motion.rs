//! Extrapolation of a pose to another time.

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::ServerTime;

use super::estimate::{ACCELERATION_LASTS_S, Estimate};

/// Maximum extrapolation; the motion model is meaningless beyond it. [s]
pub const MAX_PREDICT_S: f64 = 0.2;

/// Motion of the vehicle: sufficient to predict its pose at a time close by.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Time of this state: the newest reading of any sensor. [server]
    pub stamp: ServerTime,
    pub world_from_body: Pose<World, Body>,
    /// Velocity. [m/s, world]
    pub v_world_mps: DVec3,
    /// Acceleration. [m/s^2, world]
    pub a_world_mps2: DVec3,
    /// Angular velocity. [rad/s, body]
    pub omega_body_radps: DVec3,
}

impl Motion {
    pub(super) fn of(stamp: ServerTime, estimate: &Estimate) -> Self {
        Self {
            stamp,
            world_from_body: estimate.pose(),
            v_world_mps: estimate.v_world_mps,
            a_world_mps2: estimate.a_world_mps2,
            omega_body_radps: estimate.omega_body_radps,
        }
    }

    /// Returns the motion of a vehicle at rest.
    pub fn at_rest(stamp: ServerTime, world_from_body: Pose<World, Body>) -> Self {
        Self {
            stamp,
            world_from_body,
            v_world_mps: DVec3::ZERO,
            a_world_mps2: DVec3::ZERO,
            omega_body_radps: DVec3::ZERO,
        }
    }

    /// Returns the time closest to `time` for which the pose can be predicted.
    pub fn reach(&self, time: ServerTime) -> ServerTime {
        let dt_s = time.seconds_since(self.stamp);
        if dt_s.abs() <= MAX_PREDICT_S {
            return time;
        }
        self.stamp.plus_seconds(dt_s.clamp(-MAX_PREDICT_S, MAX_PREDICT_S))
    }

    /// Returns the pose at a time up to 0.2 s before or after; for other times, the pose at that limit.
    pub fn at(&self, time: ServerTime) -> Pose<World, Body> {
        let dt_s = time.seconds_since(self.stamp).clamp(-MAX_PREDICT_S, MAX_PREDICT_S);
        let decay = Decay::after(dt_s);
        Pose::new(
            self.world_from_body.translation_m
                + self.v_world_mps * dt_s
                + self.a_world_mps2 * decay.twice_s2,
            (self.world_from_body.rotation * DQuat::from_scaled_axis(self.omega_body_radps * dt_s))
                .normalize(),
        )
    }
}

/// Effect of a decaying acceleration over a time.
pub(super) struct Decay {
    /// Remaining share of the acceleration.
    pub share: f64,
    /// Integrated once. [s]
    pub once_s: f64,
    /// Integrated twice. [s^2]
    pub twice_s2: f64,
}

impl Decay {
    pub(super) fn after(dt_s: f64) -> Self {
        let share = (-dt_s / ACCELERATION_LASTS_S).exp();
        let once_s = ACCELERATION_LASTS_S * (1.0 - share);
        Self { share, once_s, twice_s2: ACCELERATION_LASTS_S * (dt_s - once_s) }
    }
}
