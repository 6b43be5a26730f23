//! Protocol of VizFlyt: types shared by the render server, the runtime on the Jetson, plugins, the simulated lab and
//! the bridge. `no_std`, no allocation, no dependency on other VizFlyt crates.
//!
//! Recommended reading order:
//! - [`geometry`]: frames as types, [`geometry::Pose`], [`geometry::Intrinsics`], and [`geometry::Volume`], the solids
//!   for geofence, ground truth and tests;
//! - [`time`]: one stamp type per clock, and estimation of the offset between two clocks;
//! - [`histogram`]: histogram of durations, used at both ends of the wire;
//! - [`flight_end`]: how and why a flight ended: reasons as data, and the one rule that decides;
//! - [`failsafe`]: reaction to a silent companion in flight, shared by guardian and bridge;
//! - [`messages`]: postcard messages of the ordered QUIC stream and of the plugin;
//! - [`packet`]: zerocopy headers: version preamble, image on the wire, observation in shared memory, framing of
//!   messages on a stream;
//! - [`random`]: random numbers from a seed;
//! - [`sensor`]: sensors other than cameras, by kind; their readings on the wire and in shared memory;
//! - [`mavlink`]: setpoints and telemetry to and from MAVLink, with the only NED/FRD code in the project. This module
//!   and [`failsafe`] need the feature `mavlink`: plugins do not use them, and the MAVLink dialect takes as long to
//!   compile as the rest of the crate.
//!
//! Excluded on purpose: sockets, clocks, threads, files.

#![no_std]
#![warn(missing_docs)]

mod copter_mode;
#[cfg(feature = "mavlink")]
pub mod failsafe;
pub mod flight_end;
pub mod geometry;
pub mod histogram;
#[cfg(feature = "mavlink")]
pub mod mavlink;
pub mod messages;
pub mod packet;
pub mod random;
pub mod sensor;
pub mod time;

pub use copter_mode::CopterMode;

/// Version of everything in this crate that crosses a wire or shared memory.
///
/// Raise it with any change that an older peer would misread. Peers compare it first ([`packet::Preamble`]), and reject
/// a mismatch with a message that names both versions.
pub const PROTOCOL_VERSION: u16 = 14;
