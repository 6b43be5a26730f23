//! Between the runtime and the plugin process, beside the images.

use serde::{Deserialize, Serialize};

use super::{ArenaInfo, Event, Setpoint, Text};
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
}
