//! Events for the guard, the plugin, the page and the log.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::{Name, Text, displayed};
use crate::flight_end::{Collision, EndReason, FenceBreach};
use crate::time::ServerTime;

/// Event. Events arrive in order and are never lost.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Event {
    /// Time on the server's clock; zero if the runtime created it before the clocks were synchronized.
    pub stamp: ServerTime,
    /// Kind, with its data.
    pub kind: EventKind,
    /// Sentence for a person.
    pub text: Text,
}

impl Event {
    /// Returns an event that ends a flight, with the sentence for its reason.
    pub fn ending(stamp: ServerTime, kind: EventKind) -> Self {
        let text = kind.end_reason().as_ref().map(displayed).unwrap_or_default();
        Self { stamp, kind, text }
    }
}

/// Kind of an [`Event`]. Add new kinds at the end. A change raises the protocol version.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(clippy::large_enum_variant)] // Why: there is no heap to box a reason on.
pub enum EventKind {
    /// The vehicle's body touched an obstacle of the twin. The guard lands.
    Collision(Collision),
    /// The vehicle left the geofence, or can no longer stop inside. The guard lands.
    Geofence(FenceBreach),
    /// A stage of the course was passed.
    Stage {
        /// Index in the course, from 0.
        index: u8,
        /// Name of the stage in `arena.toml`.
        name: Name,
    },
    /// The vehicle reached the goal.
    Finished {
        /// Time since take-off. [s]
        seconds: f64,
    },
    /// The course's time limit was reached.
    TimeLimit {
        /// Time limit of the course, from take-off. [s]
        limit_s: f64,
    },
    /// No pose arrived for longer than the arena's `hold_after_s`: the guard holds. The flight continues if a pose
    /// arrives before `land_after_s`.
    PoseLost {
        /// Age of the newest pose. [s]
        age_s: f64,
    },
    /// Poses arrive again.
    PoseRegained,
    /// A person pressed the stop button. The guard lands.
    EmergencyStop,
    /// The vehicle's phase of flight changed.
    Phase(super::FlightPhase),
    /// Another reason ended the flight: plugin, autopilot, localization, or limits of the runtime.
    Ended(EndReason),
    /// Line printed by the plugin.
    PluginOutput,
    /// Any other note for the user.
    Note,
    /// A person starts a waiting vehicle ([`super::FlightPhase::Waiting`]).
    Start,
    /// A person ends the flight: the vehicle brakes, then lands.
    Land,
}

impl EventKind {
    /// Returns the reason if this event ends a flight.
    pub fn end_reason(&self) -> Option<EndReason> {
        Some(match self {
            Self::Collision(collision) => EndReason::Collision(collision.clone()),
            Self::Geofence(breach) => EndReason::Geofence(breach.clone()),
            Self::Finished { seconds } => EndReason::Finished { seconds: *seconds },
            Self::TimeLimit { limit_s } => EndReason::TimeLimit { limit_s: *limit_s },
            Self::EmergencyStop => EndReason::StopButton,
            Self::Land => EndReason::LandButton,
            Self::Ended(reason) => reason.clone(),
            _ => return None,
        })
    }

    /// Returns the vehicle's position, if the event contains one. [m, world]
    pub fn place_mut(&mut self) -> Option<&mut DVec3> {
        match self {
            Self::Collision(collision) | Self::Ended(EndReason::Collision(collision)) => {
                Some(&mut collision.p_world_m)
            }
            Self::Geofence(breach) | Self::Ended(EndReason::Geofence(breach)) => {
                Some(&mut breach.p_world_m)
            }
            _ => None,
        }
    }
}
