//! Messages between the runtime and the plugin process. Images are in shared memory.

use serde::{Deserialize, Serialize};

use super::{ArenaInfo, Event, Setpoint, Text};
use crate::geometry::{Body, Odom, Pose};
use crate::time::HostTime;

/// Runtime to plugin. Ordered and reliable.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant)] // Why: `Start` comes once, and there is no heap to box it on.
pub enum ToPlugin {
    /// Description of the arena; sent before the first image.
    Start(ArenaInfo),
    /// Event of the flight.
    Event(Event),
    /// Stop: call `on_stop`, then exit.
    Stop,
}

/// Plugin to runtime. Ordered and reliable.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant)] // Why: there is no heap here to box a trajectory on.
pub enum FromPlugin {
    /// `on_start` has returned. The plugin waits for images.
    Ready {
        /// Name of the plugin for display.
        name: Text,
    },
    /// Reply to one image.
    Reply {
        /// Sequence number of the image.
        seq: u64,
        /// Time at which `on_image` was called.
        entered: HostTime,
        /// Time at which it returned.
        returned: HostTime,
        /// Returned setpoint. `None` keeps the previous setpoint until its deadline.
        setpoint: Option<Setpoint>,
    },
    /// The plugin gives up.
    Failed {
        /// Reason, one sentence.
        reason: Text,
    },
    /// Pose estimated by the plugin. It is logged and evaluated, but not used for flying.
    Odometry(Odometry),
}

/// Pose estimated by a plugin.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Odometry {
    /// Time for which the estimate is valid. For an estimate from an image, the time that the image shows.
    pub stamp: HostTime,
    /// Pose of the vehicle. The frame's z axis is up; the plugin chooses origin and heading.
    pub odom_from_body: Pose<Odom, Body>,
}

/// Maximum number of estimates that a plugin may publish with one reply, for example one per camera.
pub const MAX_ODOMETRY_PER_REPLY: usize = 4;

impl Odometry {
    /// Maximum distance from the origin. [m]
    pub const FARTHEST_M: f64 = 1e5;

    /// Whether all numbers are finite, the quaternion has unit length within 1e-3, and the position is within
    /// [`Self::FARTHEST_M`].
    pub fn is_valid(&self) -> bool {
        let pose = &self.odom_from_body;
        pose.is_valid() && pose.translation_m.abs().max_element() <= Self::FARTHEST_M
    }
}
