//! Reports of the runtime to the server, the page and the log.

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// Phase of a flight.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FlightPhase {
    /// Waiting for the autopilot, the server or the plugin.
    #[default]
    Connecting,
    /// Setting the origin, waiting for the pre-arm checks.
    Preparing,
    /// Sending mode, arming and take-off commands.
    TakingOff,
    /// The plugin flies.
    Flying,
    /// The guard holds the vehicle in place.
    Holding,
    /// The guard lands the vehicle.
    Landing,
    /// On the ground and disarmed after a flight.
    Landed,
    /// On the ground and ready. Takes off when a person presses start.
    Waiting,
}

/// Outcome of a flight for runtime, grades and leaderboard.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OutcomeKind {
    /// The course was completed.
    Finished,
    /// The body touched an obstacle of the twin, or the floor at too high a speed.
    Collided,
    /// The vehicle left the geofence, or could not have stopped inside it.
    Geofence,
    /// The course's time limit was reached.
    Timeout,
    /// Landed before the end: by the plugin, by a person, or after the flight time set by the user.
    Landed,
    /// The plugin crashed, hung or gave up.
    PluginFailed,
    /// The vehicle never took off, or something else failed: link, localization, server.
    Error,
}

impl OutcomeKind {
    /// Returns the name, as in reports.
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

    /// Whether the flight ended as intended: at the end of the course, or by a deliberate landing.
    pub fn is_good(self) -> bool {
        matches!(self, Self::Finished | Self::Landed)
    }
}

impl core::fmt::Display for OutcomeKind {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.pad(self.name())
    }
}

/// State of the vehicle from the autopilot, in VizFlyt's frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct VehicleState {
    /// Whether the vehicle is armed.
    pub armed: bool,
    /// ArduCopter's mode number (4 is GUIDED, 9 is LAND).
    pub mode: u32,
    /// Position estimated by the autopilot. [m, world]
    pub p_world_m: DVec3,
    /// Velocity. [m/s, world]
    pub v_world_mps: DVec3,
    /// Attitude: body to world.
    pub world_from_body: DQuat,
    /// Angular velocity. [rad/s, body]
    pub omega_body_radps: DVec3,
    /// Battery voltage; 0 if unknown. [V]
    pub battery_v: f32,
    /// Remaining battery charge, 0 to 1; negative if unknown.
    pub battery_fraction: f32,
}

/// Image delivery from pose to plugin, over the last second.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ImageStats {
    /// Images delivered to the plugin since the start.
    pub delivered: u64,
    /// Images that were replaced by a newer one before the plugin could take them.
    pub skipped: u64,
    /// Rate of images delivered to the plugin. [Hz]
    pub rate_hz: f32,
    /// Time from pose stamp to plugin callback, median. [ms]
    pub age_ms_p50: f32,
    /// Time from pose stamp to plugin callback, 99th percentile. [ms]
    pub age_ms_p99: f32,
    /// Time inside the plugin's `on_image`, median. [ms]
    pub plugin_ms_p50: f32,
}

/// Regular report of the runtime, at 10 Hz.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Telemetry {
    /// Phase of the flight.
    pub phase: FlightPhase,
    /// State of the vehicle.
    pub vehicle: VehicleState,
    /// Image delivery.
    pub images: ImageStats,
    /// Last velocity commanded to the autopilot, after the guard. [m/s, world]
    pub v_setpoint_mps: DVec3,
    /// Setpoints sent to the autopilot since the start.
    pub setpoints_sent: u64,
    /// MAVLink packets sent and received since the start.
    pub mavlink_packets: u64,
}
