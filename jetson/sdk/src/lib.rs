//! Plugin API: the [`Autonomy`] trait, its input ([`Observation`]), its output ([`Setpoint`]), and the shared-memory
//! transport to the runtime.
//!
//! A plugin is a separate program. `vizflyt fly` starts it as a child process, passes every image through shared
//! memory, and checks each returned setpoint. If the plugin crashes, stalls or loops, the vehicle holds and then lands.
//!
//! ```no_run
//! use vizflyt_sdk::glam::DVec3;
//! use vizflyt_sdk::{Autonomy, Axes, Observation, Setpoint, YawTarget};
//!
//! struct Creep;
//!
//! impl Autonomy for Creep {
//!     fn on_image(&mut self, obs: &Observation<'_>) -> Option<Setpoint> {
//!         let front = obs.camera("front")?;
//!         let ahead_m = front.depth_m(front.width_px / 2, front.height_px / 2).unwrap_or(9.0);
//!         let v_mps = DVec3::X * (0.5 * (ahead_m - 1.0)).clamp(0.0, 1.0) as f64;
//!         Some(Setpoint::Velocity { v_mps, axes: Axes::Heading, yaw: YawTarget::Keep })
//!     }
//! }
//!
//! fn main() -> std::process::ExitCode {
//!     vizflyt_sdk::run(Creep)
//! }
//! ```
//!
//! Reading order: [`autonomy`](Autonomy), [`observation`](Observation), [`run`], [`ipc`].

#![warn(missing_docs)]

mod autonomy;
mod clock;
pub mod ipc;
mod map;
#[cfg(feature = "opencv")]
mod mat;
mod memory;
mod observation;
mod odometry;
mod run;
mod sensor;

pub use glam;
#[cfg(feature = "opencv")]
pub use opencv;
pub use vizflyt_protocol as protocol;

pub use vizflyt_protocol::geometry::{
    Body, Cam, Intrinsics, Odom, Pose, Sensor, Twist, Volume, World,
};
pub use vizflyt_protocol::messages::{
    ArenaInfo, Axes, CameraInfo, Event, EventKind, FlightPhase, Limits, Odometry, Path, PathYaw,
    Piece, Setpoint, SetpointKind, SetpointKinds, Trajectory, Waypoint, YawTarget,
};
pub use vizflyt_protocol::sensor::memory::Records;
pub use vizflyt_protocol::sensor::{
    LidarPoint, RadarDetection, RangeReading, SensorInfo, SensorKind,
};
pub use vizflyt_protocol::time::HostTime;

pub use autonomy::Autonomy;
pub use clock::host_now;
pub use map::{MapError, VARIABLE as MAP_VARIABLE, map, parse_map};
pub use memory::{
    ImageStamps, ObservationBuffer, ObservationTooLarge, ObservationWriter, PlanesMut,
};
pub use observation::{Battery, CameraImage, ImuSample, Observation, Vehicle};
pub use odometry::{OdometryError, publish_odometry, take_odometry};
pub use run::{attach, run};
pub use sensor::{GivenReading, SensorReading};

/// Compiles the plugin in the project's README.
#[cfg(doctest)]
#[doc = include_str!("../../../README.md")]
struct Readme;

/// Compiles the plugin in the guide.
#[cfg(doctest)]
#[doc = include_str!("../../../docs/guides/plugin.md")]
struct Guide;
