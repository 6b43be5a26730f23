//! What the runtime reports to the server, the page and the log.

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// Where a flight stands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FlightPhase {
    /// Waiting for the autopilot, the server or the plugin.
    #[default]
    Connecting,
    /// Setting the origin, waiting for the pre-arm checks.
    Preparing,
    /// Mode, arming and take-off commands under way.
    TakingOff,
    /// The plugin flies.
    Flying,
    /// The guard holds the vehicle in place.
    Holding,
    /// The guard lands the vehicle.
    Landing,
    /// On the ground and disarmed after a flight.
    Landed,
    /// On the ground, everything ready; takes off when a person presses start.
    Waiting,
}

/// How a flight ended, for runtime, grades and leaderboard.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OutcomeKind {
    /// The course was flown to its end.
    Finished,
    /// The body touched an obstacle of the twin, or the floor too fast.
    Collided,
    /// It left the geofence, or could not have stopped inside.
    Geofence,
    /// The course's time was over.
    Timeout,
    /// It was landed before the end: by the plugin, by a person, or as the time that a person asked
    /// for was over.
    Landed,
    /// The plugin crashed, hung or gave up.
    PluginFailed,
    /// It never took off, or something else failed: link, localization, server.
    Error,
}

impl OutcomeKind {
    /// Returns the name as it stands in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Finished => "finished",
            Self::Collided => "collided",
            Self::Geofence => "geofence",
            Self::Timeout => "timeout",
            Self::Landed => "landed",
            Self::PluginFailed => "plugin_failed",
            Self::Error => "error",
        }
    }

    /// Whether the flight ended as wished: at the end of the course, or landed on purpose.
    pub fn is_good(self) -> bool {
        matches!(self, Self::Finished | Self::Landed)
    }
}

impl core::fmt::Display for OutcomeKind {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.pad(self.name())
    }
}

/// The autopilot's state of the vehicle, in our frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct VehicleState {
    /// Motors may turn.
    pub armed: bool,
    /// ArduCopter's mode number (4 is GUIDED, 9 is LAND).
    pub mode: u32,
    /// Position by the autopilot's estimator. [m, world]
    pub p_world_m: DVec3,
    /// Velocity. [m/s, world]
    pub v_world_mps: DVec3,
    /// Attitude: body to world.
    pub world_from_body: DQuat,
    /// Angular velocity. [rad/s, body]
    pub omega_body_radps: DVec3,
    /// Battery voltage; 0 if unknown. [V]
    pub battery_v: f32,
    /// Battery left, 0 to 1; negative if unknown.
    pub battery_fraction: f32,
}

/// Delivery of images between the pose and the plugin, over the last second.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ImageStats {
    /// Images handed to the plugin since the start.
    pub delivered: u64,
    /// Images that came but were replaced by a newer one before the plugin asked.
    pub skipped: u64,
    /// Images handed to the plugin. [Hz]
    pub rate_hz: f32,
    /// Pose stamp to plugin callback, median. [ms]
    pub age_ms_p50: f32,
    /// Pose stamp to plugin callback, 99th percentile. [ms]
    pub age_ms_p99: f32,
    /// Time inside the plugin's `on_image`, median. [ms]
    pub plugin_ms_p50: f32,
}

/// The runtime's regular report. 10 Hz.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Telemetry {
    /// Phase of flight.
    pub phase: FlightPhase,
    /// The vehicle.
    pub vehicle: VehicleState,
    /// The images.
    pub images: ImageStats,
    /// What was asked of the autopilot last, after the guard. [m/s, world]
    pub v_setpoint_mps: DVec3,
    /// Setpoints sent to the autopilot since the start.
    pub setpoints_sent: u64,
    /// MAVLink packets sent and received since the start.
    pub mavlink_packets: u64,
}
