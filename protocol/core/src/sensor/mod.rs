//! Sensors beside the cameras: one list, each of a kind; their readings on the wire and in shared memory.
//!
//! ```text
//! server ── ReadingHeader, records ──▶ runtime ── SensorHeader, records ──▶ plugin
//!           one QUIC stream a reading             behind the cameras' planes
//! ```
//! The records are the same at both places: fixed little-endian structs, some per reading ([`records`]). A
//! reading is as long as its header says and its kind allows ([`SensorKind::max_records`]): a hostile length
//! costs nothing. A sensor's axes are x forward, y left, z up ([`crate::geometry::Sensor`]).
//!
//! A new kind (an event camera, say) gets its number, its record and its bound here.

mod info;
pub mod memory;
mod reading;
pub mod records;

pub use info::{SensorInfo, SensorKind};
pub use memory::SensorHeader;
pub use reading::{InvalidReading, ReadingHeader};
pub use records::{LidarPoint, RadarDetection, RangeReading};

/// Most sensors beside the cameras of one vehicle.
pub const MAX_SENSORS: usize = 8;
