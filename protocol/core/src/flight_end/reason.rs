//! Reasons that end a flight, as data. Their sentences are in [`super::sentence`].

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::messages::{InvalidSetpoint, Name, OutcomeKind, Text, bounded};

/// Reason for the end of a flight. Add new reasons at the end. A change raises the protocol version.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EndReason {
    /// The course was completed.
    Finished {
        /// Time since take-off. [s]
        seconds: f64,
    },
    /// The vehicle's body touched an obstacle.
    Collision(Collision),
    /// The vehicle left the permitted space, or could not have stopped inside it.
    Geofence(FenceBreach),
    /// The course's time limit was reached.
    TimeLimit {
        /// Time limit of the course, from take-off. [s]
        limit_s: f64,
    },
    /// No pose arrived for longer than the arena's `land_after_s`.
    PoseLost {
        /// Age of the newest pose. [s]
        age_s: f64,
    },
    /// A person pressed the stop button.
    StopButton,
    /// A person pressed the land button.
    LandButton,
    /// A person or the parent process stopped the runtime.
    Interrupted,
    /// The flight time set by the user is over.
    TimeAsked {
        /// Flight time set by the user. [s]
        seconds: f64,
    },
    /// The plugin returned a setpoint to land.
    PluginLanded,
    /// The plugin failed.
    Plugin(PluginFault),
    /// The plugin received no image.
    NoImage,
    /// The vehicle did not take off in time.
    NotReady {
        /// Time limit for the take-off. [s]
        within_s: f64,
        /// Missing condition for take-off.
        missing: Missing,
    },
    /// The take-off did not reach its target height.
    ClimbFailed {
        /// Height gained. [m]
        risen_m: f64,
        /// Time since the take-off began. [s]
        within_s: f64,
    },
    /// The autopilot refused a command; the text names the command and the autopilot's reason.
    AutopilotRefused(Text),
    /// The autopilot fell silent in flight.
    AutopilotSilent {
        /// Time without a packet from the autopilot. [s]
        silent_s: f64,
    },
    /// The autopilot restarted in flight.
    AutopilotRestarted,
    /// The vehicle disarmed in flight.
    Disarmed,
    /// A pilot or a failsafe of the autopilot changed the mode.
    TakenOver {
        /// `ArduCopter`'s mode number.
        mode: u32,
    },
    /// An earlier runtime left the vehicle in the air.
    LeftInAir,
    /// The server rejected the flight, the connection failed permanently, or the plugin's shared memory cannot be
    /// created; the text gives the reason.
    ServerRefused(Text),
    /// The arena is invalid for a flight; the text names the value and the reason.
    ArenaRefused(Text),
    /// The server reconnected with another arena.
    ArenaChanged {
        /// Name of the new arena.
        name: Name,
    },
    /// The vehicle never took off, for an unknown reason.
    NeverTookOff,
    /// The record ends before the flight.
    RecordEnds,
    /// The plugin's images were too old for too long.
    ImagesOld {
        /// Age of the image that it answered last. [s]
        age_s: f64,
    },
    /// The possible error of the pose exceeded the guard's distance from the fence for longer than the arena's
    /// `land_after_s`.
    PoseUnsure {
        /// Possible error of the pose: three standard deviations along the worst axis. [m]
        off_m: f64,
    },
    /// The guardian process ended or hung.
    GuardianFailed,
}

/// Contact of the vehicle's body with an obstacle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Collision {
    /// Position of the body's centre. [m, world]
    pub p_world_m: DVec3,
    /// Distance from the body's surface to the obstacle; negative for penetration. [m]
    pub clearance_m: f64,
    /// Touched obstacle.
    pub with: Obstacle,
    /// Speed at the contact. [m/s]
    pub speed_mps: f64,
}

/// Kind of obstacle.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Obstacle {
    /// The static scene.
    Scene,
    /// The floor, at a speed too high for a landing.
    Floor,
    /// A moving object, by its name in `arena.toml`.
    Object(Name),
    /// Another vehicle, by its name.
    Vehicle(Name),
    /// Space through which no ray of the capture passed, in an arena that treats it as solid.
    Unseen,
}

/// Boundary that was left, or before which the vehicle can no longer stop.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FenceBreach {
    /// Position of the body's centre. [m, world]
    pub p_world_m: DVec3,
    /// Distance from the body's surface to the boundary; negative beyond it. [m]
    pub margin_m: f64,
    /// Boundary that was crossed or cannot be kept.
    pub boundary: Boundary,
    /// Speed at that time. [m/s]
    pub speed_mps: f64,
    /// Distance beyond the boundary at which the vehicle would stop. [m]
    pub overshoot_m: f64,
}

/// Boundary of the permitted space.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Boundary {
    /// The geofence.
    Geofence,
    /// The maximum altitude.
    Ceiling,
    /// A no-fly box, by its name in `arena.toml`; empty if the name is unknown.
    NoFly(Name),
}

/// Reason why a plugin failed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PluginFault {
    /// The plugin ended or gave up; with its own message or that of its supervisor.
    Ended(Text),
    /// The plugin was restarted and did not become ready.
    NotBack {
        /// Timeout for the restart. [s]
        within_s: f64,
        /// Reason for the restart.
        why: Text,
    },
    /// The plugin does not answer images.
    NoAnswer {
        /// Oldest image without an answer.
        image: u64,
        /// Time without an answer. [s]
        silent_s: f64,
    },
    /// The plugin answers images without a setpoint.
    NoSetpoint,
    /// The guard rejects all of its setpoints.
    Refused(InvalidSetpoint),
}

impl PluginFault {
    /// Returns the fault of a plugin that ended or gave up, described by `sentence`.
    pub fn ended(sentence: &str) -> Self {
        Self::Ended(bounded(sentence))
    }
}

/// Missing condition for a take-off.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Missing {
    /// Reply of the server.
    Server,
    /// Return of the plugin's `on_start`.
    Plugin,
    /// Heartbeat of the autopilot.
    Heartbeat,
    /// Disarmed vehicle before the start.
    Disarmed,
    /// Pose of the vehicle.
    Pose,
    /// First answer of the plugin.
    Answer,
    /// Pre-arm checks of the autopilot; with the missing condition, in words.
    PreArm(Text),
    /// Connection to the server; with the last error.
    Connection(Text),
    /// Sufficiently frequent and fresh images; with the details.
    Images(Text),
    /// Vehicle at rest in the start box; with the details.
    Start(Text),
}

impl EndReason {
    /// Returns the outcome of a flight with this reason.
    pub fn outcome(&self) -> OutcomeKind {
        match self {
            Self::Finished { .. } => OutcomeKind::Finished,
            Self::Collision(_) => OutcomeKind::Collided,
            Self::Geofence(_) => OutcomeKind::Geofence,
            Self::TimeLimit { .. } => OutcomeKind::Timeout,
            Self::StopButton
            | Self::LandButton
            | Self::Interrupted
            | Self::TimeAsked { .. }
            | Self::PluginLanded => OutcomeKind::Landed,
            Self::Plugin(_) => OutcomeKind::PluginFailed,
            _ => OutcomeKind::Error,
        }
    }

    /// Whether the end gets a crash card: every end except a finish and a regular landing.
    pub fn is_failure(&self) -> bool {
        match self.outcome() {
            OutcomeKind::Finished => false,
            OutcomeKind::Landed => *self == Self::StopButton,
            _ => true,
        }
    }

    /// Whether a person ended the flight.
    pub fn is_by_person(&self) -> bool {
        matches!(self, Self::StopButton | Self::LandButton | Self::Interrupted)
    }

    /// Whether the vehicle brakes before LAND; otherwise LAND is sent at once.
    pub fn brakes_first(&self) -> bool {
        matches!(
            self,
            Self::Finished { .. }
                | Self::TimeLimit { .. }
                | Self::LandButton
                | Self::TimeAsked { .. }
                | Self::Plugin(_)
        )
    }

    /// Whether the reason can only end a flight that has taken off: poses of a vehicle that a person carries do not
    /// count.
    pub fn needs_take_off(&self) -> bool {
        matches!(
            self,
            Self::Finished { .. }
                | Self::Collision(_)
                | Self::Geofence(_)
                | Self::TimeLimit { .. }
                | Self::PoseLost { .. }
        )
    }
}
