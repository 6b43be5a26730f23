//! Sensors other than cameras: a list of sensors by kind, and their readings on the wire and in shared memory.
//!
//! ```text
//! server ── ReadingHeader, records ──▶ runtime ── SensorHeader, records ──▶ plugin
//!           one QUIC stream per reading           after the cameras' planes
//! ```
//! The records are the same in both places: fixed little-endian structs, one or more per reading ([`records`]). The
//! size of a reading is limited by its header and its kind ([`SensorKind::max_records`]), so that a malicious length
//! cannot cause an allocation. A sensor's axes are x forward, y left, z up ([`crate::geometry::Sensor`]).
//!
//! To add a kind (for example an event camera), add its number, record and maximum here.

mod info;
pub mod memory;
mod reading;
pub mod records;

pub use info::{SensorInfo, SensorKind};
pub use memory::SensorHeader;
pub use reading::{InvalidReading, ReadingHeader};
pub use records::{LidarPoint, RadarDetection, RangeReading};

/// Maximum number of sensors per vehicle, not counting cameras.
pub const MAX_SENSORS: usize = 8;
