//! Render server: receives poses, streams RGB-D images, referees flights, serves the page.
//!
//! ```text
//! serve  loads the scene, starts threads and tasks, prints the report
//! web       page, previews, top view        imports stream, render, poses, flights, scene
//! stream    encoder, subscriptions, QUIC    imports render, poses, flights
//! render    cameras -> rendered ticks       imports poses, flights, scene
//! poses     drivers -> referee -> motions   imports flights
//! flights   leases, events, runs            imports none of these
//! scene     files -> splats, obstacles      imports none of these
//! ```
//! Modules below the rooms import no room: clock, stop, mailbox, timing, rate limits, admission,
//! priority, authorization. `tests/server/arrows.rs` fails on an upward import.
//!
//! Four threads (pose, render, encode, previews), one more with sensors, and a tokio runtime for sockets share
//! the rooms' states ([`stream::Rooms`]). All data are latest-wins except events, which are a log. [`serve()`]
//! starts everything.

mod admission;
pub mod args;
pub mod authorization;
pub mod clock;
pub mod flights;
pub mod mailbox;
pub mod poses;
mod priority;
mod rate_limit;
pub mod render;
pub mod scene;
mod serve;
pub mod settings;
pub mod stop;
pub mod stream;
pub mod timing;
pub mod web;

pub use args::ServeArgs;
pub use scene::default_arena;
pub use serve::serve;
pub use web::{ViewArgs, view};
