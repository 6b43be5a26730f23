//! What can end a flight, as data; the sentences for people are in [`super::sentence`].

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::messages::{InvalidSetpoint, Name, OutcomeKind, Text, bounded};

/// Why a flight ended. New reasons go at the end; a change raises the protocol version.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EndReason {
    /// The course was flown to its end.
    Finished {
        /// Since take-off. [s]
        seconds: f64,
    },
    /// The body touched something.
    Collision(Collision),
    /// The vehicle left the space that it may be in, or could not have stopped inside.
    Geofence(FenceBreach),
    /// The course's time is over.
    TimeLimit {
        /// What the course allows from take-off. [s]
        limit_s: f64,
    },
    /// No pose came for longer than the arena's `land_after_s`.
    PoseLost {
        /// Age of the newest pose. [s]
        age_s: f64,
    },
    /// A person pressed the stop button.
    StopButton,
    /// A person pressed the land button.
    LandButton,
    /// A person or the parent process ended the runtime.
    Interrupted,
    /// The time that a person asked for is over.
    TimeAsked {
        /// What was asked for. [s]
        seconds: f64,
    },
    /// The plugin asked to land.
    PluginLanded,
    /// The plugin failed.
    Plugin(PluginFault),
    /// The plugin had no image to answer.
    NoImage,
    /// The vehicle was not in the air in time.
    NotReady {
        /// How long it could take. [s]
        within_s: f64,
        /// What it waited for.
        missing: Missing,
    },
    /// The take-off did not reach its height.
    ClimbFailed {
        /// Height gained. [m]
        risen_m: f64,
        /// In so long. [s]
        within_s: f64,
    },
    /// The autopilot refused a command; which, and its own words.
    AutopilotRefused(Text),
    /// The autopilot fell silent in flight.
    AutopilotSilent {
        /// For so long. [s]
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
    /// A former runtime left the vehicle in the air.
    LeftInAir,
    /// The server, or what stands between it and the plugin, refused; its own words.
    ServerRefused(Text),
    /// The arena cannot be flown in; which value, and why.
    ArenaRefused(Text),
    /// The server came back with another arena.
    ArenaChanged {
        /// Its name.
        name: Name,
    },
    /// Nothing is known but that the vehicle never took off.
    NeverTookOff,
    /// The record stops before the flight does.
    RecordEnds,
    /// What the plugin saw was too old for too long.
    ImagesOld {
        /// Age of what it answered last. [s]
        age_s: f64,
    },
    /// The pose may have been off by more than the guard keeps from the fence, for longer than the arena's
    /// `land_after_s`.
    PoseUnsure {
        /// How far it may have been off: three standard deviations along the worst axis. [m]
        off_m: f64,
    },
}

/// A contact of the vehicle's body.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Collision {
    /// Where the body's centre was. [m, world]
    pub p_world_m: DVec3,
    /// Distance from the body's surface to the obstacle; negative is penetration. [m]
    pub clearance_m: f64,
    /// What it touched.
    pub with: Obstacle,
    /// How fast it was. [m/s]
    pub speed_mps: f64,
}

/// What a body can touch.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Obstacle {
    /// The scene.
    Scene,
    /// The floor, too fast for a landing.
    Floor,
    /// An object that moves, by its name in `arena.toml`.
    Object(Name),
    /// Another vehicle, by its name.
    Vehicle(Name),
    /// Space that no ray of the scene's capture has passed, which its arena takes for solid.
    Unseen,
}

/// A boundary left, or one before which the vehicle can no longer stop.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FenceBreach {
    /// Where the body's centre was. [m, world]
    pub p_world_m: DVec3,
    /// From the body's surface to the boundary; negative is beyond. [m]
    pub margin_m: f64,
    /// Which boundary.
    pub boundary: Boundary,
    /// How fast it was. [m/s]
    pub speed_mps: f64,
    /// How far beyond the boundary it would come to rest. [m]
    pub overshoot_m: f64,
}

/// What bounds the space that a vehicle may be in.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Boundary {
    /// The geofence.
    Geofence,
    /// The greatest height.
    Ceiling,
    /// A no-fly box, by its name in `arena.toml`; empty where that is not known.
    NoFly(Name),
}

/// How a plugin failed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PluginFault {
    /// It ended or gave up: in its own words, or those of its supervisor.
    Ended(Text),
    /// It was started again and did not come back.
    NotBack {
        /// How long it was waited for. [s]
        within_s: f64,
        /// Why it was started again.
        why: Text,
    },
    /// It does not answer.
    NoAnswer {
        /// The oldest image without an answer.
        image: u64,
        /// For so long. [s]
        silent_s: f64,
    },
    /// It answers images, but without a setpoint.
    NoSetpoint,
    /// The guard refuses all of its setpoints.
    Refused(InvalidSetpoint),
}

impl PluginFault {
    /// Makes the fault of a plugin that ended or gave up, by a sentence that describes it.
    pub fn ended(sentence: &str) -> Self {
        Self::Ended(bounded(sentence))
    }
}

/// What a flight waits for before its take-off.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Missing {
    /// The server's answer.
    Server,
    /// The plugin's `on_start`.
    Plugin,
    /// The autopilot's heartbeat.
    Heartbeat,
    /// The vehicle to be disarmed first.
    Disarmed,
    /// A pose of the vehicle.
    Pose,
    /// The plugin's first answer.
    Answer,
    /// The autopilot's pre-arm checks; in words.
    PreArm(Text),
    /// A connection to the server, which failed; the last failure in words.
    Connection(Text),
    /// Images often and fresh enough; in words.
    Images(Text),
    /// The vehicle to stand still in the start box; in words.
    Start(Text),
}

impl EndReason {
    /// Returns the outcome of a flight that ends for this reason.
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

    /// Whether the end is worth a crash card: every one but a finish and a landing in order.
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

    /// Whether it can only end a flight that has taken off: the poses of a vehicle that someone
    /// carries does not count.
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
