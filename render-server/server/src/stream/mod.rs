//! Images on their way: rendered ticks in, QUIC streams out.
//!
//! ```text
//! in   rendered ticks, from the render thread; what runtimes and watchers report over QUIC
//! out  images slice by slice, poses and events, to every subscriber; delivery statistics;
//!      the quality and size that the link carries, to the encoder and the render thread
//! ```

pub mod delivery;
pub mod encode;
mod in_flight;
pub mod rate_control;
pub mod subscriptions;
pub mod transport;
