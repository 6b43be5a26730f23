//! What the sensors beside the cameras measure: LiDAR, range finders, sonar, radar.
//!
//! ```text
//! [[sensors]] ─▶ SensorSet (changed in flight: Sensors) ─▶ VehicleSensors: which are due, readings
//! newest motions, the splats as rays meet them ───────────┘        │ thread (wall clock), graded flights
//!                                                                  └▶ newest reading of each, to sessions and the page
//! ```
//! Policy: images come first. The thread has one core at most, of its own pool, and what it does not get done in time is
//! left out: a sensor that is late is due again from then on. It rests while nobody wants a vehicle's images, and is not
//! there at all in an arena without sensors.
//!
//! A reading shows the instant that an image rendered at the same time would ([`Exposure`](super::schedule::Exposure)):
//! the vehicle is where it will be when the plugin has it. A sweep ends then.

mod measure;
mod model;
mod set;
pub mod thread;

pub use measure::{Around, VehicleSensors};
pub use model::SensorModel;
pub use set::{MadeReading, SensorCounters, SensorSet, Sensors};
