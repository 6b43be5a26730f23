//! Between the runtime and the plugin process, beside the images.

use serde::{Deserialize, Serialize};

use super::{ArenaInfo, Event, Setpoint, Text};
use crate::geometry::{Body, Odom, Pose};
use crate::time::HostTime;

/// Runtime to plugin. Ordered, never lost.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant)] // Why: `Start` comes once, and there is no heap to box it on.
pub enum ToPlugin {
    /// What the plugin flies in; comes before the first image.
    Start(ArenaInfo),
    /// Something happened.
    Event(Event),
    /// End now: `on_stop`, then exit.
    Stop,
}

/// Plugin to runtime. Ordered, never lost.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant)] // Why: there is no heap here to box a trajectory on.
pub enum FromPlugin {
    /// `on_start` returned; the plugin waits for images.
    Ready {
        /// The plugin's name for people.
        name: Text,
    },
    /// The reply to one image.
    Reply {
        /// The image's sequence number.
        seq: u64,
        /// When `on_image` was entered.
        entered: HostTime,
        /// When it returned.
        returned: HostTime,
        /// What it returned; `None` leaves the former setpoint in force until its deadline.
        setpoint: Option<Setpoint>,
    },
    /// The plugin gives up; why.
    Failed {
        /// One sentence.
        reason: Text,
    },
    /// Where the plugin thinks it is. It is logged and evaluated; nothing is flown by it.
    Odometry(Odometry),
}

/// A pose that a plugin has estimated by itself.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Odometry {
    /// The instant that it is of: of an estimate from an image, the one that the image shows.
    pub stamp: HostTime,
    /// Where the vehicle was. z of the frame is up; origin and heading are the plugin's choice.
    pub odom_from_body: Pose<Odom, Body>,
}

/// Estimates that a plugin may publish with one reply: of each of a few cameras, say.
pub const MAX_ODOMETRY_PER_REPLY: usize = 4;

impl Odometry {
    /// No estimate is farther from its origin. [m]
    pub const FARTHEST_M: f64 = 1e5;

    /// Whether every number is finite, the quaternion of unit length within 1e-3, and the place within
    /// [`Self::FARTHEST_M`].
    pub fn is_valid(&self) -> bool {
        let pose = &self.odom_from_body;
        pose.is_valid() && pose.translation_m.abs().max_element() <= Self::FARTHEST_M
    }
}
