//! Image streaming: rendered ticks in, QUIC streams out.
//!
//! ```text
//! in   rendered ticks, from `render`; reports of runtimes and watchers over QUIC
//! out  images slice by slice, poses and events, to every subscriber; delivery statistics;
//!      to `render`: the demand for images, and the image size that fits the link
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
