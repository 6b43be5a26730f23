//! From localization measurements to the pose that everything else uses: measurements are weighted
//! by how far they may be off, what cannot be is turned away and named, the twist is estimated, and
//! silence is noticed. The pose can be had for any moment close by.
//!
//! ```text
//! poses, 30 to 500 Hz, of one or several sources --> stamps, frozen? -> gate -\
//! the autopilot's IMU, 100 Hz, if there is one --------------------------------> estimate
//!       each put at its stamp, also in the past (history)                     |
//!                                          PoseSample for each accepted pose <--+--> Motion
//! ```
//! Read in this order: [`estimate`](self) is the Kalman filter, over its [`covariance`](self), [`history`](self) lets it take
//! readings late, [`filter`](self) judges measurements by what the filter expects, with what it
//! remembers of each [`source`](self). The guide is `docs/guides/localization.md`.

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

/// Most sources of one vehicle's poses; the measurements of others are taken for the last's.
pub const MAX_SOURCES: usize = 8;

/// Standard deviations of a measured pose, one an axis, as its source states them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseSigma {
    /// Of the position, along the world's axes. [m, world]
    pub position_m: DVec3,
    /// Of the attitude, about the body's axes. [rad, body]
    pub rotation_rad: DVec3,
}

impl PoseSigma {
    /// Returns the same with its variances multiplied.
    fn times(&self, factor: f64) -> Self {
        let root = factor.sqrt();
        Self { position_m: self.position_m * root, rotation_rad: self.rotation_rad * root }
    }
}

/// A pose as its source gave it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured {
    /// Index of the source, less than [`MAX_SOURCES`].
    pub source: u8,
    /// When the pose was true, as precisely as the source states it.
    pub stamp: ServerTime,
    /// When it arrived.
    pub arrival: ServerTime,
    /// Where the vehicle was.
    pub world_from_body: Pose<World, Body>,
    /// How far that may be off; `None` is as configured.
    pub sigma: Option<PoseSigma>,
}

impl Measured {
    /// Makes the measurement of the only source there is, which arrives at once.
    pub fn new(stamp: ServerTime, world_from_body: Pose<World, Body>) -> Self {
        Self { source: 0, stamp, arrival: stamp, world_from_body, sigma: None }
    }
}

/// Why a measurement is rejected.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Rejected {
    /// A number that is not finite, or a quaternion that is not of unit length.
    #[error("the pose holds numbers that are no pose")]
    Invalid,
    /// Not newer than the last one of its source, or older than what can still be fused.
    #[error("the pose is not newer than the last one")]
    Stale,
    /// It came so long after its stamp; before it, if negative. [s]
    #[error(
        "the pose came {0:.2} s after its stamp, which cannot be: the source's clock is not the one \
         it is taken for, or was set"
    )]
    Clock(f64),
    /// The stamps went back by so much while poses kept coming. [s]
    #[error("the stamps of the poses went back by {0:.2} s: the source's clock was set")]
    ClockJump(f64),
    /// Off by itself; others that go on from it would be accepted. [standard deviations]
    #[error("the pose is {0:.0} standard deviations from the expected: an outlier")]
    Outlier(f64),
    /// Further from the expected than any vehicle flies, or for the second time at one place off it.
    #[error(
        "the pose jumped by {distance_m:.2} m: an outlier, another object, swapped markers, or a \
         moved origin?"
    )]
    Jump {
        /// From where it was expected. [m]
        distance_m: f64,
        /// By the time since the last accepted pose. [m/s]
        speed_mps: f64,
    },
    /// Turned further at once than any vehicle turns. [rad]
    #[error("the attitude turned by {:.0} degrees at once: swapped markers?", .0.to_degrees())]
    Flip(f64),
    /// The same numbers, to the last bit, for so long while the vehicle moved. [s]
    #[error(
        "the poses are the same to the last bit for {0:.2} s although the vehicle moves: the \
         stream is frozen"
    )]
    Frozen(f64),
    /// Against another source that is accepted at this time.
    #[error(
        "the pose is {distance_m:.2} m and {:.0} degrees from that of source {other}, which is \
        accepted: are both in the same frame, and is it the same object?",
        .angle_rad.to_degrees()
    )]
    Disagree {
        /// Index of the other source.
        other: u8,
        /// From where that one has it. [m]
        distance_m: f64,
        /// From how that one has it turned. [rad]
        angle_rad: f64,
    },
}

#[cfg(test)]
mod tests;
