//! Setpoints that a plugin returns.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::{SetpointKind, SetpointKinds, Trajectory};

/// Axes of a setpoint's vector.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Axes {
    /// x east, y north, z up.
    #[default]
    World,
    /// x along the vehicle's heading, y to its left, z up: the levelled body frame. While the vehicle pitches, "ahead"
    /// remains horizontal.
    Heading,
    /// Body axes with the current tilt: x forward, y left, z up.
    Body,
}

/// Target of the vehicle's yaw.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum YawTarget {
    /// Keep the current heading.
    #[default]
    Keep,
    /// Heading: angle from world x, counter-clockwise. [rad, world]
    Angle(f64),
    /// Yaw rate, counter-clockwise. [rad/s]
    Rate(f64),
}

impl YawTarget {
    /// Whether its number, if any, is finite.
    pub fn is_finite(self) -> bool {
        match self {
            Self::Keep => true,
            Self::Angle(value) | Self::Rate(value) => value.is_finite(),
        }
    }
}

/// Target for the vehicle. The newest setpoint is valid until the guard's deadline.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(clippy::large_enum_variant)] // Why: there is no heap here to box a trajectory on.
pub enum Setpoint {
    /// Stop and hold the position.
    #[default]
    Hold,
    /// Land here and disarm.
    Land,
    /// Fly to a point and hold there.
    Position {
        /// Target position. [m, world]
        p_world_m: DVec3,
        /// Heading.
        yaw: YawTarget,
    },
    /// Fly at a velocity.
    Velocity {
        /// Target velocity. [m/s, `axes`]
        v_mps: DVec3,
        /// Axes of `v_mps`.
        axes: Axes,
        /// Heading.
        yaw: YawTarget,
    },
    /// Accelerate. Gravity is compensated: zero keeps the velocity.
    Acceleration {
        /// Target acceleration. [m/s^2, `axes`]
        a_mps2: DVec3,
        /// Axes of `a_mps2`.
        axes: Axes,
        /// Heading.
        yaw: YawTarget,
    },
    /// Fly to a point relative to the vehicle, and hold there. The offset counts from the vehicle's pose when the
    /// runtime receives the setpoint. For plugins without a position.
    Offset {
        /// Vector from the vehicle to the target. [m, `axes`]
        d_m: DVec3,
        /// Axes of `d_m`.
        axes: Axes,
        /// Heading.
        yaw: YawTarget,
    },
    /// Fly with body rates and a thrust. Only if the course allows it
    /// ([`ArenaInfo::setpoints`](super::ArenaInfo::setpoints)).
    ///
    /// The guard integrates the rates to an attitude, limits its tilt, and commands the autopilot the motion that
    /// follows from attitude and thrust, within the same limits and fence as for other setpoints.
    AttitudeRate {
        /// Angular velocity. [rad/s, body]
        omega_body_radps: DVec3,
        /// Total thrust relative to the vehicle's weight: 1 carries the vehicle when level.
        thrust: f64,
    },
    /// Climb or descend vertically to the height at which the plugin took control after take-off. The runtime takes off
    /// by itself as soon as the plugin answers images.
    TakeOff,
    /// Follow a trajectory.
    Trajectory(Trajectory),
}

/// Reason for rejecting a setpoint, as a message for the plugin's author.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, thiserror::Error)]
#[serde(rename_all = "snake_case")]
pub enum InvalidSetpoint {
    /// A number is NaN or infinite.
    #[error("a number in it is not finite")]
    NotFinite,
    /// The trajectory has no points.
    #[error("the trajectory is empty; give it a waypoint or a piece")]
    Empty,
    /// The speed of a waypoint is not positive.
    #[error("a waypoint's speed is {0} m/s; it must be above 0")]
    Speed(f64),
    /// The duration of a piece is not positive.
    #[error("a trajectory's piece lasts {0} s; it must last longer than 0")]
    Duration(f64),
    /// The course does not allow this kind of setpoint.
    #[error("this course does not allow {}; it allows {allowed}", asked.name())]
    NotAllowed {
        /// Kind of the setpoint.
        asked: SetpointKind,
        /// Kinds that the course allows.
        allowed: SetpointKinds,
    },
    /// The setpoint is in world axes, but the course withholds the pose.
    #[error(
        "this course withholds the vehicle's pose, so setpoints count from the vehicle; give axes \"heading\" or \
         \"body\""
    )]
    WorldAxes,
}

impl Setpoint {
    /// Returns a velocity setpoint in world axes.
    pub fn velocity(v_world_mps: DVec3, yaw: YawTarget) -> Self {
        Self::Velocity { v_mps: v_world_mps, axes: Axes::World, yaw }
    }

    /// Whether it is in world axes. The heading is not considered.
    pub fn is_in_world_axes(&self) -> bool {
        match self {
            Self::Position { .. } => true,
            Self::Velocity { axes, .. }
            | Self::Acceleration { axes, .. }
            | Self::Offset { axes, .. } => *axes == Axes::World,
            Self::Trajectory(trajectory) => trajectory.axes == Axes::World,
            Self::Hold | Self::Land | Self::TakeOff | Self::AttitudeRate { .. } => false,
        }
    }

    /// Checks that all numbers are finite, and that a trajectory is valid.
    ///
    /// # Errors
    /// Returns the first error found.
    pub fn check(&self) -> Result<(), InvalidSetpoint> {
        let is_finite = match *self {
            Self::Hold | Self::Land | Self::TakeOff => true,
            Self::Position { p_world_m: v, yaw }
            | Self::Velocity { v_mps: v, yaw, .. }
            | Self::Acceleration { a_mps2: v, yaw, .. }
            | Self::Offset { d_m: v, yaw, .. } => v.is_finite() && yaw.is_finite(),
            Self::AttitudeRate { omega_body_radps, thrust } => {
                omega_body_radps.is_finite() && thrust.is_finite()
            }
            Self::Trajectory(ref trajectory) => return trajectory.check(),
        };
        if is_finite { Ok(()) } else { Err(InvalidSetpoint::NotFinite) }
    }
}
