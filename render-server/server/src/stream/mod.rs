//! Images on their way: rendered ticks in, QUIC streams out.
//!
//! ```text
//! in   rendered ticks, from `render`; what runtimes and watchers report over QUIC
//! out  images slice by slice, poses and events, to every subscriber; delivery statistics;
//!      to `render`: the demand for images, and the size that the link carries
//!      to `flights`: the runtimes' reports and events; to `poses`: IMU readings
//! ```
//! Imports `render`, `poses` and `flights`.

pub mod connection;
pub mod delivery;
pub mod encode;
mod in_flight;
pub mod rate_control;
mod state;
pub mod subscriptions;
pub mod transport;
pub mod vehicle;

pub use self::state::{Rooms, Streaming};
