//! What a plugin asks of the vehicle.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::{SetpointKind, SetpointKinds, Trajectory};

/// The axes in which a vector of a setpoint is given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Axes {
    /// x east, y north, z up.
    #[default]
    World,
    /// x along the nose's heading, y left of it, z up: the body frame levelled, so that "ahead"
    /// never means "into the floor" while the vehicle pitches.
    Heading,
    /// x forward, y left, z up of the body as it is tilted at the moment.
    Body,
}

/// Where the nose shall point.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum YawTarget {
    /// Keep the heading of the moment.
    #[default]
    Keep,
    /// This heading: angle from world x, counter-clockwise. [rad, world]
    Angle(f64),
    /// Turn at this rate, counter-clockwise. [rad/s]
    Rate(f64),
}

impl YawTarget {
    /// Whether its number, if it has one, is finite.
    pub fn is_finite(self) -> bool {
        match self {
            Self::Keep => true,
            Self::Angle(value) | Self::Rate(value) => value.is_finite(),
        }
    }
}

/// A continuous target for the vehicle; the newest one holds until the guard's deadline.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(clippy::large_enum_variant)] // Why: there is no heap here to box a trajectory on.
pub enum Setpoint {
    /// Stop and stay.
    #[default]
    Hold,
    /// Come down here and disarm.
    Land,
    /// Fly to a point and stay.
    Position {
        /// Target. [m, world]
        p_world_m: DVec3,
        /// Heading.
        yaw: YawTarget,
    },
    /// Fly at a velocity.
    Velocity {
        /// Target. [m/s, `axes`]
        v_mps: DVec3,
        /// Axes of `v_mps`.
        axes: Axes,
        /// Heading.
        yaw: YawTarget,
    },
    /// Accelerate, gravity already compensated: zero keeps the velocity.
    Acceleration {
        /// Target. [m/s^2, `axes`]
        a_mps2: DVec3,
        /// Axes of `a_mps2`.
        axes: Axes,
        /// Heading.
        yaw: YawTarget,
    },
    /// Fly to a point given from where the vehicle is when the runtime takes this setpoint, and
    /// stay. For plugins that do not know their position.
    Offset {
        /// From the vehicle to the target. [m, `axes`]
        d_m: DVec3,
        /// Axes of `d_m`.
        axes: Axes,
        /// Heading.
        yaw: YawTarget,
    },
    /// Turn at body rates under a thrust. Only where the course allows it
    /// ([`ArenaInfo::setpoints`](super::ArenaInfo::setpoints)).
    ///
    /// The guard flies it: it keeps the attitude that the rates lead to, bounds its tilt, and asks
    /// the autopilot for the motion that this attitude and thrust mean, within the same limits and
    /// fence as any other.
    AttitudeRate {
        /// Angular velocity. [rad/s, body]
        omega_body_radps: DVec3,
        /// Thrust of all motors together over the vehicle's weight: 1 carries it when level.
        thrust: f64,
    },
    /// Go straight up or down to the height at which the plugin took over after take-off. (The
    /// runtime takes off by itself as soon as the plugin answers images.)
    TakeOff,
    /// Follow a path.
    Trajectory(Trajectory),
}

/// Why a setpoint is refused, in words for the plugin's author.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, thiserror::Error)]
#[serde(rename_all = "snake_case")]
pub enum InvalidSetpoint {
    /// A NaN or an infinity.
    #[error("a number in it is not finite")]
    NotFinite,
    /// A trajectory without points.
    #[error("the trajectory is empty; give it a waypoint or a piece")]
    Empty,
    /// A waypoint's speed.
    #[error("a waypoint's speed is {0} m/s; it must be above 0")]
    Speed(f64),
    /// A piece's duration.
    #[error("a trajectory's piece lasts {0} s; it must last longer than 0")]
    Duration(f64),
    /// The course does not allow its kind.
    #[error("this course does not allow {}; it allows {allowed}", asked.name())]
    NotAllowed {
        /// What was asked for.
        asked: SetpointKind,
        /// What may be.
        allowed: SetpointKinds,
    },
    /// It is given in the world's axes, and the course withholds the pose.
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

    /// Whether it counts in the world's axes; a heading does not matter.
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

    /// Checks that every number in it is finite, and that a trajectory can be followed.
    ///
    /// # Errors
    /// The first fault found.
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
