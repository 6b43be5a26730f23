//! The runtime on the vehicle's computer: images to the plugin, setpoints through the guard,
//! MAVLink to the autopilot.
//!
//! ```text
//! server ══QUIC══▶ stream ─▶ images ══shared memory══▶ plugin process
//!                    │                                     │ answers
//!                    ▼ poses, events                       ▼
//!                  control (50 Hz): flight ─▶ guard ─▶ link ══MAVLink══▶ autopilot
//!                    └─▶ log (MCAP), report, telemetry to the server
//! ```
//! The modules in the order of the data: [`stream`] (QUIC), [`images`] (decode, publish),
//! [`supervisor`] (the plugin's process, its limits), [`control`] (the loop that owns the rest), [`flight`]
//! (phases and outcome, pure), [`trajectory`] (follows paths, pure), [`guard`] (the last word,
//! pure), [`link`] (MAVLink, sans-IO),
//! [`steering`] (when setpoints leave), [`stats`] and [`waterfall`] (ages by stage), [`log`],
//! [`replay`] (a log to a plugin), [`report`], [`lockstep`] (the same flight on a virtual clock, for grades). [`fly()`] starts it all. [`airframe`] stands beside: the
//! autopilot's parameters, read, judged and written before a flight.

pub mod airframe;
mod answers;
pub mod args;
pub mod clock;
pub mod config;
pub mod console;
pub mod control;
pub mod flight;
pub mod fly;
pub mod guard;
pub mod images;
pub mod link;
pub mod lockstep;
pub mod log;
pub mod replay;
pub mod report;
pub mod stats;
pub mod steering;
pub mod stream;
pub mod supervisor;
pub mod trajectory;
pub mod waterfall;

pub use args::FlyArgs;
pub use flight::Outcome;
pub use fly::{fly, fly_command};
pub use stream::pair;
