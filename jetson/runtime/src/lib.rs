//! The runtime on the vehicle's computer: images to the plugin, setpoints through the guard,
//! MAVLink to the autopilot.
//!
//! ```text
//! server ══QUIC══▶ stream ─▶ images ══shared memory══▶ plugin process
//!                    │                                     │ replies
//!                    ▼ poses, events                       ▼
//!                  control ─▶ companion: flight ─▶ guard ─▶ link ══MAVLink══▶ autopilot
//!                    └─▶ log (MCAP), report, telemetry to the server
//! ```
//! Modules in the order of the data: [`stream`] (QUIC), [`images`] (decode, publish), [`supervisor`] (the plugin's
//! process and its limits), [`companion`] (all decisions, sans-IO) and its two drivers, [`control`] (wall clock) and
//! [`lockstep`] (virtual clock, for grades). The companion combines [`flight`] (phases and outcome), [`trajectory`]
//! (path following), [`guard`] (limits and fence), [`link`] (MAVLink) and [`steering`] (timing of setpoints), all
//! sans-IO. Then [`stats`] and [`waterfall`] (ages by stage), [`log`], `odometry` (the plugin's own estimate),
//! [`replay`] (a log to a plugin), [`report`]. [`fly()`] starts everything. Outside this chain: [`airframe`] (reads,
//! checks and writes the autopilot's parameters before a flight) and [`bench`].

pub mod airframe;
pub mod args;
pub mod bench;
pub mod clock;
pub mod companion;
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
mod odometry;
pub mod replay;
pub mod replies;
pub mod report;
pub mod stats;
pub mod steering;
pub mod stream;
pub mod supervisor;
pub mod trajectory;
pub mod waterfall;

pub use args::FlyArgs;
pub use fly::{fly, fly_command};
pub use stream::pair;
