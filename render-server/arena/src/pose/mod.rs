//! Pose filter: localization measurements in, the pose for all other parts out. It weights measurements by
//! their uncertainty, rejects impossible ones with a reason, estimates the twist, and detects silence. The pose
//! is available for any instant close by.
//!
//! ```text
//! poses, 10 to 500 Hz, of one or several sources --> stamps, repeats -> gate --\
//! the autopilot's IMU, 100 Hz, if there is one --------------------------------> estimate
//!       each put at its stamp, also in the past (history)                     |
//!                                          PoseSample for each accepted pose <--+--> Motion
//! ```
//! Read in this order: [`estimate`](self) is the Kalman filter, over its [`covariance`](self);
//! [`history`](self) lets it fuse late readings; [`filter`](self) compares measurements with the expected pose
//! and with the state of each [`source`](self). The guide is `docs/guides/localization.md`.

mod config;
mod covariance;
mod estimate;
mod filter;
mod history;
mod motion;
mod quality;
mod source;

use glam::DVec3;
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::time::ServerTime;

pub use config::{PoseConfig, Predict};
pub use filter::{PoseChange, PoseFilter};
pub use motion::{MAX_PREDICT_S, Motion};
pub use quality::{PoseQuality, Rejects, SourceQuality};
pub use vizflyt_protocol::messages::ImuReading;

/// Maximum number of sources per vehicle; measurements of further sources count as the last one's.
pub const MAX_SOURCES: usize = 8;

/// Standard deviations of a measured pose per axis, as stated by its source.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseSigma {
    /// Standard deviation of the position, along the world's axes. [m, world]
    pub position_m: DVec3,
    /// Standard deviation of the attitude, about the body's axes. [rad, body]
    pub rotation_rad: DVec3,
}

impl PoseSigma {
    /// Returns the standard deviations for variances multiplied by `factor`.
    fn times(&self, factor: f64) -> Self {
        let root = factor.sqrt();
        Self { position_m: self.position_m * root, rotation_rad: self.rotation_rad * root }
    }
}

/// A pose as delivered by its source.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured {
    /// Index of the source, less than [`MAX_SOURCES`].
    pub source: u8,
    /// Time of the measurement, with the precision of the source.
    pub stamp: ServerTime,
    pub arrival: ServerTime,
    pub world_from_body: Pose<World, Body>,
    /// Standard deviations; `None` uses the configured ones.
    pub sigma: Option<PoseSigma>,
    /// Whether the position is exactly the origin of the source, which many systems send for an object that
    /// they do not see.
    pub is_origin: bool,
    /// Differences up to which two poses of the source are equal.
    pub resolution: Resolution,
}

impl Measured {
    /// Returns a measurement of source 0 that arrives without delay.
    pub fn new(stamp: ServerTime, world_from_body: Pose<World, Body>) -> Self {
        Self {
            source: 0,
            stamp,
            arrival: stamp,
            world_from_body,
            sigma: None,
            is_origin: world_from_body.translation_m == DVec3::ZERO,
            resolution: Resolution::default(),
        }
    }
}

/// Differences up to which two poses of a source are equal; 0 compares bit for bit.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Resolution {
    /// Difference along each axis. [m, world]
    pub position_m: f64,
    /// Angle between the attitudes. [rad]
    pub rotation_rad: f64,
}

/// Reason for rejecting a measurement.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Rejected {
    /// A number that is not finite, or a quaternion that is not of unit length.
    #[error(
        "the pose is invalid: a number is not finite or too large, or the quaternion is not of unit length"
    )]
    Invalid,
    /// Not newer than the last measurement of its source, or too old to be fused.
    #[error("the pose is not newer than the last one")]
    Stale,
    /// Implausible delay from stamp to arrival; negative if it arrived before its stamp. [s]
    #[error(
        "the pose came {0:.2} s after its stamp: the source's clock is not the configured one, or \
         was set"
    )]
    Clock(f64),
    /// The stamps went back by this time while poses kept coming. [s]
    #[error("the stamps of the poses went back by {0:.2} s: the source's clock was set")]
    ClockJump(f64),
    /// Single outlier; later poses that continue from it would be accepted. [standard deviations]
    #[error("the pose is {0:.0} standard deviations from the expected: an outlier")]
    Outlier(f64),
    /// Further from the expected pose than any vehicle flies, or for the second time at one place off it.
    #[error(
        "the pose jumped by {distance_m:.2} m: an outlier, another object, swapped markers, or a \
         moved origin?"
    )]
    Jump {
        /// Distance from the expected position. [m]
        distance_m: f64,
        /// Distance divided by the time since the last accepted pose. [m/s]
        speed_mps: f64,
    },
    /// Attitude turned faster than any vehicle turns. [rad]
    #[error("the attitude turned by {:.0} degrees at once: swapped markers?", .0.to_degrees())]
    Flip(f64),
    /// Bitwise equal poses for this time while the vehicle moved. [s]
    #[error(
        "the poses are the same to the last bit for {0:.2} s although the vehicle moves: the \
         stream is frozen"
    )]
    Frozen(f64),
    /// Equal to the poses before it for this time, in flight: not a measurement. [s]
    #[error(
        "the poses repeat bit for bit, for {0:.2} s: the object is probably not visible to the \
         localization system"
    )]
    Repeated(f64),
    /// Exactly the origin of the source, in flight: not a measurement.
    #[error(
        "the position is exactly 0, 0, 0, which localization systems send for an object that is \
         not visible"
    )]
    NotVisible,
    /// Contradicts another source that is accepted at the same time.
    #[error(
        "the pose is {distance_m:.2} m and {:.0} degrees from that of source {other}, which is \
        accepted: are both in the same frame, and is it the same object?",
        .angle_rad.to_degrees()
    )]
    Disagree {
        /// Index of the other source.
        other: u8,
        /// Distance from the other source's position. [m]
        distance_m: f64,
        /// Angle to the other source's attitude. [rad]
        angle_rad: f64,
    },
}

#[cfg(test)]
mod tests;
