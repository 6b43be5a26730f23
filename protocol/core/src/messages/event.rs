//! What happened, for the guard, the plugin, the page and the log.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::{Name, Text, displayed};
use crate::flight_end::{Collision, EndReason, FenceBreach};
use crate::time::ServerTime;

/// One occurrence. Events travel in order and are never lost.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Event {
    /// When, on the server's clock; zero if the runtime made it before it knew that clock.
    pub stamp: ServerTime,
    /// The kind.
    pub kind: EventKind,
    /// One sentence for a person.
    pub text: Text,
}

impl Event {
    /// Makes an event that ends a flight, with the sentence for its reason.
    pub fn ending(stamp: ServerTime, kind: EventKind) -> Self {
        let text = kind.end_reason().as_ref().map(displayed).unwrap_or_default();
        Self { stamp, kind, text }
    }
}

/// The kinds of [`Event`]. New kinds go at the end; a change raises the protocol version.
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
        /// Its name in `arena.toml`.
        name: Name,
    },
    /// The vehicle reached the goal.
    Finished {
        /// Since take-off. [s]
        seconds: f64,
    },
    /// The course's time is up.
    TimeLimit {
        /// What the course allows from take-off. [s]
        limit_s: f64,
    },
    /// No pose has come for longer than the arena's `hold_after_s`: the guard holds. The flight goes on
    /// if one comes before `land_after_s`.
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
    /// Something else ended the flight: plugin, autopilot, localization, the runtime's own limits.
    Ended(EndReason),
    /// A line the plugin printed.
    PluginOutput,
    /// Anything else worth a person's attention.
    Note,
    /// A person lets a vehicle take off that waits for it ([`super::FlightPhase::Waiting`]).
    Start,
    /// A person ends the flight: it brakes, then lands.
    Land,
}

impl EventKind {
    /// Returns why a flight ends with this; `None` if it does not.
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

    /// Returns the vehicle's place, where the event has one. [m, world]
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
