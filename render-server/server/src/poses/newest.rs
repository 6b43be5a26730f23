//! The newest pose of a vehicle, with its motion.

use vizflyt_arena::config::MAX_VEHICLES;
use vizflyt_arena::pose::Motion;
use vizflyt_protocol::messages::PoseSample;

/// The newest pose of each vehicle, by its index.
pub type NewestPoses = [Option<Localized>; MAX_VEHICLES];

/// Pose and motion of a vehicle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Localized {
    /// The newest accepted pose.
    pub sample: PoseSample,
    /// The motion estimated from all measurements up to then.
    pub motion: Motion,
}

impl Localized {
    /// Creates the state of a vehicle at rest.
    pub fn still(sample: PoseSample) -> Self {
        Self { sample, motion: Motion::at_rest(sample.stamp, sample.world_from_body) }
    }
}
