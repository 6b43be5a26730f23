//! A quadrotor with an autopilot that tracks velocities.

use vizflyt_sdk::glam::{DMat3, DQuat, DVec3};
use vizflyt_sdk::protocol::geometry::wrap_pi;
use vizflyt_sdk::{Axes, Body, HostTime, Pose, Setpoint, Vehicle, World, YawTarget};

pub(crate) const DT_S: f64 = 0.0025;
const GRAVITY_MPS2: f64 = 9.81;
/// Lag of the attitude behind the acceleration setpoint. [s]
const TILT_LAG_S: f64 = 0.06;
/// First-order lag of velocity. [s]
const LAG_S: f64 = 0.25;
const MAX_ACCELERATION_MPS2: f64 = 6.0;
const MAX_YAW_RATE_RADPS: f64 = 1.6;

/// True state of the vehicle.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Quadrotor {
    pub(crate) stamp: HostTime,
    pub(crate) p_m: DVec3,
    pub(crate) v_mps: DVec3,
    a_mps2: DVec3,
    yaw_rad: f64,
    omega_body_radps: DVec3,
}

impl Quadrotor {
    pub(crate) fn at_rest(p_m: DVec3) -> Self {
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

    /// Returns the attitude with an autopilot's error: half a degree, slowly varying.
    pub(crate) fn estimated_attitude(&self, now_s: f64) -> DQuat {
        let error_rad = DVec3::new((now_s * 0.4).sin(), (now_s * 0.3).cos(), (now_s * 0.2).sin());
        self.attitude() * DQuat::from_scaled_axis(error_rad * 0.006)
    }

    pub(crate) fn world_from_body(&self) -> Pose<World, Body> {
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

    pub(crate) fn advance(&mut self, setpoint: &Setpoint, tick: u64) {
        let (wanted_mps, yaw) = match *setpoint {
            Setpoint::Velocity { v_mps, axes: Axes::Heading, yaw } => {
                (DQuat::from_rotation_z(self.yaw_rad) * v_mps, yaw)
            }
            Setpoint::Velocity { v_mps, axes: Axes::World, yaw } => (v_mps, yaw),
            _ => (DVec3::ZERO, YawTarget::Keep),
        };
        let before = self.attitude();
        let wanted_mps2 =
            ((wanted_mps - self.v_mps) / LAG_S).clamp_length_max(MAX_ACCELERATION_MPS2);
        self.a_mps2 += (wanted_mps2 - self.a_mps2) * (DT_S / TILT_LAG_S);
        self.v_mps += self.a_mps2 * DT_S;
        self.p_m += self.v_mps * DT_S;
        let rate_radps = match yaw {
            YawTarget::Keep => 0.0,
            YawTarget::Rate(rate_radps) => rate_radps,
            YawTarget::Angle(angle_rad) => 3.0 * wrap_pi(angle_rad - self.yaw_rad),
        };
        let limit = MAX_YAW_RATE_RADPS;
        self.yaw_rad = wrap_pi(self.yaw_rad + rate_radps.clamp(-limit, limit) * DT_S);
        let turned = (before.conjugate() * self.attitude()).normalize();
        self.omega_body_radps = turned.to_scaled_axis() / DT_S;
        self.stamp = HostTime::from_ns(1_000_000_000 + ((tick + 1) as f64 * DT_S * 1e9) as u64);
    }
}
