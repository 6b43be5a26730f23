//! What happened, for the guard, the plugin, the page and the log.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::{Name, Text};
use crate::time::ServerTime;

/// One occurrence. Events travel in order and are never lost.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Event {
    /// When, on the server's clock; zero if the runtime made it before it knew that clock.
    pub stamp: ServerTime,
    /// What.
    pub kind: EventKind,
    /// One sentence for a person.
    pub text: Text,
}

/// The kinds of [`Event`]. New kinds go at the end; a change raises the protocol version.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    /// The vehicle's body touched an obstacle of the twin. The guard lands.
    Collision {
        /// Where the body's centre was. [m, world]
        p_world_m: DVec3,
        /// Distance from the body's surface to the obstacle; negative is penetration. [m]
        clearance_m: f64,
    },
    /// The vehicle left the geofence, or can no longer stop inside. The guard lands.
    Geofence {
        /// Where. [m, world]
        p_world_m: DVec3,
        /// Distance left to the fence; negative is outside. [m]
        margin_m: f64,
    },
    /// A stage of the course was passed.
    Stage {
        /// Index in the course, from 0.
        index: u8,
        /// Its name in `arena.toml`.
        name: Name,
    },
    /// The vehicle reached the goal.
    Finished {
        /// Since take-off. [s]
        seconds: f64,
    },
    /// The course's time is up.
    TimeLimit,
    /// No pose has come for longer than allowed.
    PoseLost {
        /// Age of the newest pose. [s]
        age_s: f64,
    },
    /// Poses have come back.
    PoseRegained,
    /// A person pressed the stop button. The guard lands.
    EmergencyStop,
    /// The vehicle's phase of flight changed.
    Phase(super::FlightPhase),
    /// The plugin ended, crashed or hung.
    PluginFailed,
    /// A line the plugin printed.
    PluginOutput,
    /// Anything else worth a person's attention.
    Note,
    /// A person lets a vehicle take off that waits for it ([`super::FlightPhase::Waiting`]).
    Start,
    /// A person ends the flight: it brakes, then lands.
    Land,
}
