//! Converts a setpoint into a velocity before the limits: positions by a braking profile, accelerations by integration,
//! attitude rates by the acceleration of the attitude, trajectories by a moving point. Also the heading to send with
//! it.

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{wrap_pi, yaw_of};
use vizflyt_protocol::messages::{Axes, Setpoint, YawTarget};

use super::limits::GRAVITY_MPS2;
use super::slip::Slip;
use super::{Guard, HoldReason, STOPPED_MPS, VehicleMotion};
use crate::trajectory::{Follower, Start};

/// Maximum yaw rate that is passed on: a racing turn of 180 degrees a second. ArduCopter's default limit is 202
/// (`ATC_RATE_Y_MAX`, `ATC_SLEW_YAW`). [rad/s]
pub(super) const MAX_YAW_RATE_RADPS: f64 = std::f64::consts::PI;
/// Gain from distance to speed when flying to a point. Lower than that of ArduCopter's position loop (`PSC_NE_POS_P` =
/// 1), so that the two loops do not oscillate. [1/s]
const POSITION_GAIN_PER_S: f64 = 0.8;
/// Speed at which a held vehicle returns to its point. [m/s]
const RETURN_MPS: f64 = 0.5;
/// Maximum magnitude of attitude rates: two turns a second. [rad/s]
const MAX_RATE_RADPS: f64 = 4.0 * std::f64::consts::PI;
/// Maximum tilt from attitude rates: slightly beyond it, the thrust that carries the vehicle is twice its weight. [rad]
const MAX_TILT_RAD: f64 = 1.0;
/// Maximum ratio of thrust to weight; small quadrotors have 2 to 5.
const MAX_THRUST: f64 = 4.0;

/// Setpoint resolved relative to the vehicle's motion at its first tick, or continued from the setpoint before.
#[derive(Clone, Debug, Default)]
pub(super) enum Resolved {
    /// Not resolved yet, or nothing to resolve.
    #[default]
    Nothing,
    /// A position to fly to. [m, world]
    Point(DVec3),
    /// A path being followed.
    Path(Box<Follower>),
    /// Attitude after integrating the rates: body to world.
    Attitude(DQuat),
}

impl Guard {
    /// Returns the velocity that stops the vehicle and keeps it where it stopped. [m/s, world]
    pub(super) fn hold_velocity(&mut self, vehicle: &VehicleMotion, reason: HoldReason) -> DVec3 {
        self.set_heading(vehicle, YawTarget::Keep);
        if reason == HoldReason::PoseStale {
            // The pose is stale: the autopilot holds zero velocity by its estimate.
            self.command.hold_point_m = None;
            return DVec3::ZERO;
        }
        let stopped = self.command.v_world_mps.length() < STOPPED_MPS
            && vehicle.v_world_mps.length() < STOPPED_MPS;
        if self.command.hold_point_m.is_none() && stopped {
            self.command.hold_point_m = Some(vehicle.p_world_m);
        }
        match self.command.hold_point_m {
            Some(p_m) => {
                (POSITION_GAIN_PER_S * (p_m - vehicle.p_world_m)).clamp_length_max(RETURN_MPS)
            }
            None => DVec3::ZERO,
        }
    }

    /// Returns the velocity of the plugin's setpoint before the limits, and sets the heading. [m/s, world]
    pub(super) fn setpoint_velocity(&mut self, vehicle: &VehicleMotion, dt_s: f64) -> DVec3 {
        let in_world = |v: DVec3, axes: Axes| match axes {
            Axes::World => v,
            Axes::Heading => DQuat::from_rotation_z(vehicle.yaw_rad()) * v,
            Axes::Body => vehicle.rotation * v,
        };
        let (v_target, yaw) = match self.request.setpoint.as_ref() {
            None | Some(Setpoint::Hold | Setpoint::Land) => (DVec3::ZERO, YawTarget::Keep),
            Some(&Setpoint::Velocity { v_mps, axes, yaw }) => (in_world(v_mps, axes), yaw),
            Some(&Setpoint::Position { p_world_m, yaw }) => {
                (self.velocity_towards(vehicle, p_world_m), yaw)
            }
            Some(&Setpoint::Acceleration { a_mps2, axes, yaw }) => {
                (self.velocity_by_acceleration(in_world(a_mps2, axes), dt_s), yaw)
            }
            Some(&Setpoint::Offset { d_m, axes, yaw }) => {
                let p_m = self.resolved_point(vehicle.p_world_m + in_world(d_m, axes));
                (self.velocity_towards(vehicle, p_m + self.slip_m()), yaw)
            }
            Some(&Setpoint::TakeOff) => {
                let p_m = self.resolved_point(vehicle.p_world_m.with_z(self.rules.take_off_z_m));
                (self.velocity_towards(vehicle, p_m), YawTarget::Keep)
            }
            Some(&Setpoint::AttitudeRate { omega_body_radps, thrust }) => {
                self.velocity_by_rates(vehicle, omega_body_radps, thrust, dt_s)
            }
            Some(Setpoint::Trajectory(trajectory)) => {
                if !matches!(self.request.resolved, Resolved::Path(_)) {
                    let start = Start { p_world_m: vehicle.p_world_m, rotation: vehicle.rotation };
                    let follower = Follower::new(trajectory.clone(), &start);
                    self.request.resolved = Resolved::Path(Box::new(follower));
                }
                self.follow_path(vehicle, dt_s)
            }
        };
        self.set_heading(vehicle, yaw);
        v_target
    }

    /// Returns the resolved point of the setpoint in force; `p_m` at its first tick. [m, world]
    fn resolved_point(&mut self, p_m: DVec3) -> DVec3 {
        if let Resolved::Point(resolved_m) = self.request.resolved {
            return resolved_m;
        }
        self.request.resolved = Resolved::Point(p_m);
        p_m
    }

    /// Returns the simulated drift that is added to the plugin's position; zero if the course has none. [m, world]
    fn slip_m(&self) -> DVec3 {
        self.request.slip.as_ref().map_or(DVec3::ZERO, Slip::slip_m)
    }

    /// Returns the velocity after an acceleration of `a_mps2` for `dt_s`. [m/s, world]
    fn velocity_by_acceleration(&self, a_mps2: DVec3, dt_s: f64) -> DVec3 {
        self.command.v_world_mps + a_mps2.clamp_length_max(self.rules.max_acceleration_mps2) * dt_s
    }

    /// Rotates the resolved attitude by the rates, at most [`MAX_TILT_RAD`] from level. Returns the velocity that
    /// results from attitude and thrust, and the heading. [m/s, world]
    fn velocity_by_rates(
        &mut self,
        vehicle: &VehicleMotion,
        omega_body_radps: DVec3,
        thrust: f64,
        dt_s: f64,
    ) -> (DVec3, YawTarget) {
        let attitude = match self.request.resolved {
            Resolved::Attitude(attitude) => attitude,
            _ => vehicle.rotation,
        };
        let turn = omega_body_radps.clamp_length_max(MAX_RATE_RADPS) * dt_s;
        let turned = (attitude * DQuat::from_scaled_axis(turn)).normalize();
        let up = turned * DVec3::Z;
        let excess_rad = up.angle_between(DVec3::Z) - MAX_TILT_RAD;
        let back = up.cross(DVec3::Z).try_normalize();
        let attitude = match back {
            Some(axis) if excess_rad > 0.0 => DQuat::from_axis_angle(axis, excess_rad) * turned,
            _ => turned,
        };
        self.request.resolved = Resolved::Attitude(attitude);
        let lift_mps2 = thrust.clamp(0.0, MAX_THRUST) * GRAVITY_MPS2;
        let a_mps2 = attitude * DVec3::Z * lift_mps2 - DVec3::Z * GRAVITY_MPS2;
        (self.velocity_by_acceleration(a_mps2, dt_s), YawTarget::Angle(yaw_of(attitude)))
    }

    /// Returns the velocity that follows the path, and the heading on it. [m/s, world]
    fn follow_path(&mut self, vehicle: &VehicleMotion, dt_s: f64) -> (DVec3, YawTarget) {
        let limits = (self.sight.speed_limit_mps, self.rules.max_acceleration_mps2);
        let slip_m = self.slip_m();
        let (reference, is_over) = match &mut self.request.resolved {
            Resolved::Path(follower) => {
                (follower.advance(vehicle.p_world_m - slip_m, limits, dt_s), follower.is_over())
            }
            _ => return (DVec3::ZERO, YawTarget::Keep),
        };
        let p_world_m = reference.p_world_m + slip_m;
        let v_mps = reference.v_world_mps + self.velocity_towards(vehicle, p_world_m);
        (v_mps, if is_over { YawTarget::Keep } else { reference.yaw })
    }

    /// Sets the heading to send. It is always set, because ArduCopter would otherwise turn the nose into the direction
    /// of travel.
    fn set_heading(&mut self, vehicle: &VehicleMotion, yaw: YawTarget) {
        let kept_yaw_rad = self.command.kept_yaw_rad.take();
        self.command.yaw = match yaw {
            YawTarget::Angle(yaw_rad) => YawTarget::Angle(wrap_pi(yaw_rad)),
            YawTarget::Rate(rate_radps) => {
                YawTarget::Rate(rate_radps.clamp(-MAX_YAW_RATE_RADPS, MAX_YAW_RATE_RADPS))
            }
            YawTarget::Keep => {
                let yaw_rad = kept_yaw_rad.unwrap_or(vehicle.yaw_rad());
                self.command.kept_yaw_rad = Some(yaw_rad);
                YawTarget::Angle(yaw_rad)
            }
        };
    }

    /// Returns the velocity towards a point, slow enough to stop there with half the
    /// acceleration. [m/s, world]
    fn velocity_towards(&self, vehicle: &VehicleMotion, p_world_m: DVec3) -> DVec3 {
        let way_m = p_world_m - vehicle.p_world_m;
        let distance_m = way_m.length();
        if !(distance_m > 1e-6) {
            return DVec3::ZERO;
        }
        let braking_mps = (self.rules.max_acceleration_mps2 * distance_m).sqrt();
        way_m / distance_m * braking_mps.min(POSITION_GAIN_PER_S * distance_m)
    }
}
