//! What a plugin asks of the vehicle.

use glam::DVec3;
use serde::{Deserialize, Serialize};

/// The axes in which a velocity or acceleration is given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Axes {
    /// x east, y north, z up.
    #[default]
    World,
    /// x along the nose's heading, y left of it, z up: the body frame levelled, so that "ahead"
    /// never means "into the floor" while the vehicle pitches.
    Heading,
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

/// A continuous target for the vehicle; the newest one holds until the guard's deadline.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
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
}

impl Setpoint {
    /// Returns a velocity setpoint in world axes.
    pub fn velocity(v_world_mps: DVec3, yaw: YawTarget) -> Self {
        Self::Velocity { v_mps: v_world_mps, axes: Axes::World, yaw }
    }

    /// Whether every number in it is finite.
    pub fn is_finite(&self) -> bool {
        let yaw_ok = |yaw: YawTarget| match yaw {
            YawTarget::Keep => true,
            YawTarget::Angle(value) | YawTarget::Rate(value) => value.is_finite(),
        };
        match *self {
            Self::Hold | Self::Land => true,
            Self::Position { p_world_m: v, yaw }
            | Self::Velocity { v_mps: v, yaw, .. }
            | Self::Acceleration { a_mps2: v, yaw, .. } => v.is_finite() && yaw_ok(yaw),
        }
    }
}
