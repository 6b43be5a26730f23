//! The render server: poses in, RGB-D out; referee's events, page, report.
//!
//! ```text
//! drivers (Vicon UDP) -> tick::poses (arena: gate, referee) -> vehicle: newest pose, events
//!                        tick::draw  (renderer)             -> mailbox: newest drawn tick
//!                        encode      (room in the outlet?)  -> outlet -> transport (QUIC)
//!                                                           -> previews -> dashboard (WebSocket)
//! ```
//! Four threads (poses, render, encode, previews) and a tokio runtime for sockets meet in [`hub::Hub`],
//! which holds a [`vehicle::Vehicle`] each.
//! Everything is latest-wins but events, which are a log. [`serve()`] runs it all.

pub mod accounts;
pub mod args;
mod berth;
pub mod cameras;
pub mod clock;
pub mod crash;
pub mod dashboard;
pub mod door;
pub mod drawn;
pub mod drivers;
pub mod encode;
pub mod environment;
pub mod events;
pub mod hub;
pub mod leaderboard;
mod limits;
pub mod mailbox;
pub mod map;
pub mod moving;
pub mod outlet;
pub mod pace;
pub mod previews;
pub mod render;
pub mod scene;
mod serve;
pub mod slices;
pub mod stats;
pub mod stop;
pub mod tick;
pub mod transport;
pub mod vehicle;
mod view;

pub use args::ServeArgs;
pub use scene::default_arena;
pub use serve::serve;
pub use view::{ViewArgs, view};
