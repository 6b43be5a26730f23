//! Localization: drivers of localization systems, and the thread that fuses and judges poses.
//!
//! ```text
//! in   packets of Vicon, NatNet, JSON, MAVLink, VRPN; IMU readings of the autopilots
//! out  each vehicle's newest pose, its quality, the drivers' counters;
//!      to `flights`: the referee's events, track and samples
//!      to `render`: a signal for each new pose
//! ```
//! Imports `flights`, and `scene` for the file that contains the sources.

pub mod drivers;
pub mod hand_check;
mod margin;
pub mod newest;
pub mod settings;
pub mod thread;
mod vehicle;

use std::sync::Mutex;

pub use self::vehicle::VehiclePose;
use crate::mailbox::Mailbox;
use crate::poses::drivers::SourceCounters;
use crate::poses::newest::NewestPoses;
use crate::timing::StageDurations;

/// Poses and sources of all vehicles.
#[derive(Debug)]
pub struct Localization {
    /// Poses by index of the vehicle.
    pub vehicles: Vec<VehiclePose>,
    /// Names of the pose sources, by index.
    pub source_names: Vec<String>,
    /// Counters of the sources, summed over all vehicles.
    pub counters: Mutex<SourceCounters>,
    /// Filled with each new pose; wakes the render thread.
    pub accepted: Mailbox<()>,
    /// Time from the arrival of a pose to the end of filter and referee.
    pub durations: StageDurations,
}

impl Localization {
    /// Creates the state of vehicles without a pose.
    pub fn new(vehicles: usize, source_names: Vec<String>) -> Self {
        Self {
            vehicles: (0..vehicles).map(|_| VehiclePose::default()).collect(),
            source_names,
            counters: Mutex::default(),
            accepted: Mailbox::default(),
            durations: StageDurations::default(),
        }
    }

    /// Returns the newest pose of each vehicle.
    pub fn newest(&self) -> NewestPoses {
        let mut newest = NewestPoses::default();
        for (newest, vehicle) in newest.iter_mut().zip(&self.vehicles) {
            *newest = *vehicle.newest.borrow();
        }
        newest
    }
}
