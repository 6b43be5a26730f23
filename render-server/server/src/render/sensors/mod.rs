//! Simulated sensors in addition to the cameras: LiDAR, range finders, sonar, radar.
//!
//! ```text
//! [[sensors]] ─▶ SensorSet (changed in flight: Sensors) ─▶ VehicleSensors: schedule, readings
//! newest motions, splats for ray queries ─────────────────┘        │ thread (wall clock), graded flights
//!                                                                  └▶ newest reading of each, to sessions and the page
//! ```
//! Policy: images have priority. The thread uses at most one core, from a separate pool, and skips readings that it
//! cannot make in time: a late sensor's next reading is counted from then on. It rests without demand for a
//! vehicle's images, and is not started in an arena without sensors.
//!
//! A reading shows the same instant as an image rendered at the same time
//! ([`Exposure`](super::schedule::Exposure)): the predicted pose of the vehicle when the plugin receives it. A
//! sweep ends at that instant.

mod measure;
mod model;
mod set;
pub mod thread;

pub use measure::{Around, VehicleSensors};
pub use model::SensorModel;
pub use set::{MadeReading, SensorCounters, SensorSet, Sensors};
