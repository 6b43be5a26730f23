//! The contract of VizFlyt: what the render server, the runtime on the Jetson, a plugin, the
//! simulated lab and the bridge agree on. `no_std`, no allocation, imports nothing of ours.
//!
//! Read in this order:
//! - [`geometry`]: frames as types, [`geometry::Pose`], [`geometry::Intrinsics`], and
//!   [`geometry::Volume`], the solids that geofence, truth and tests are made of;
//! - [`time`]: one stamp type per clock, and the filter that relates two clocks;
//! - [`histogram`]: durations counted, the same way at both ends;
//! - [`flight_end`]: how a flight ended, and why: reasons as data, and the one rule that decides;
//! - [`failsafe`]: who is silent in flight, since when, and what follows; guardian and bridge run the same;
//! - [`messages`]: what travels on the ordered QUIC stream and to the plugin, in postcard;
//! - [`packet`]: zerocopy headers: version preamble, image on the wire, observation in shared
//!   memory, framing of messages on a stream;
//! - [`random`]: random numbers that follow from a seed;
//! - [`sensor`]: sensors beside the cameras, by kind; their readings on the wire and in shared memory;
//! - [`mavlink`]: setpoints and telemetry to and from MAVLink; the only NED/FRD code there is. It and [`failsafe`] are the
//!   feature `mavlink`: a plugin needs neither, and its dialect takes as long to compile as all the rest.
//!
//! Absent on purpose: sockets, clocks, threads, files.

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
/// Raise it with any change that an older peer would misread. Peers compare it first
/// ([`packet::Preamble`]) and refuse a mismatch by name.
pub const PROTOCOL_VERSION: u16 = 13;
