//! The render server: poses in, RGB-D out; referee's events, page, report.
//!
//! ```text
//! poses   drivers -> pose thread (arena: gate, referee)  -> newest pose, events
//! render  render thread (renderer)                       -> newest rendered tick
//! stream  encode (a free slot?) -> subscriptions -> transport (QUIC)
//! web     previews -> page (WebSocket)
//! flights control leases, events, crash cards, leaderboard
//! ```
//! Four threads (poses, render, encode, previews) and a tokio runtime for sockets meet in [`hub::Hub`],
//! which holds a [`flights::vehicle::Vehicle`] each.
//! Everything is latest-wins but events, which are a log. [`serve()`] runs it all.

pub mod args;
pub mod authorization;
pub mod clock;
pub mod flights;
pub mod hub;
pub mod lock;
pub mod mailbox;
pub mod poses;
mod rate_limit;
pub mod render;
pub mod scene;
mod serve;
pub mod stats;
pub mod stop;
pub mod stream;
pub mod web;

pub use args::ServeArgs;
pub use scene::default_arena;
pub use serve::serve;
pub use web::{ViewArgs, view};
