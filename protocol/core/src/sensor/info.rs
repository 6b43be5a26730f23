//! Descriptions of sensors other than cameras.

use serde::{Deserialize, Serialize};

use super::records::{LidarPoint, RadarDetection, RangeReading};
use crate::geometry::{Body, Pose, Sensor};
use crate::messages::Name;

/// Kind of a sensor. The number is the same on the wire, in shared memory and in the C header. Add new kinds at the
/// end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum SensorKind {
    /// Points from a spinning or solid-state scanner: [`LidarPoint`]s.
    Lidar = 1,
    /// One narrow light beam: a [`RangeReading`].
    RangeFinder = 2,
    /// One wide ultrasonic cone: a [`RangeReading`].
    Sonar = 3,
    /// Range, direction and radial speed: [`RadarDetection`]s.
    Radar = 4,
}

impl SensorKind {
    /// All kinds.
    pub const ALL: [Self; 4] = [Self::Lidar, Self::RangeFinder, Self::Sonar, Self::Radar];

    /// Returns the kind with this number; `None` if it is unknown.
    pub fn from_number(number: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|&kind| kind as u32 == number)
    }

    /// Returns the name, as in `arena.toml`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Lidar => "lidar",
            Self::RangeFinder => "range_finder",
            Self::Sonar => "sonar",
            Self::Radar => "radar",
        }
    }

    /// Returns the size of one record. [bytes]
    pub const fn record_len(self) -> usize {
        match self {
            Self::Lidar => size_of::<LidarPoint>(),
            Self::RangeFinder | Self::Sonar => size_of::<RangeReading>(),
            Self::Radar => size_of::<RadarDetection>(),
        }
    }

    /// Returns the maximum number of records in a reading. For a LiDAR: 128 rings of 1024 columns, 2.6 MB.
    pub const fn max_records(self) -> usize {
        match self {
            Self::Lidar => 128 * 1024,
            Self::RangeFinder | Self::Sonar => 1,
            Self::Radar => 256,
        }
    }

    /// Whether each reading has exactly one record.
    pub const fn is_single(self) -> bool {
        matches!(self, Self::RangeFinder | Self::Sonar)
    }
}

impl core::fmt::Display for SensorKind {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.pad(self.name())
    }
}

/// Sensor, as described to the runtime and plugins.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SensorInfo {
    /// Name in `arena.toml`.
    pub name: Name,
    /// Kind of the sensor.
    pub kind: SensorKind,
    /// Whether it is switched on. It can be switched in flight.
    pub enabled: bool,
    /// Whether the runtime forwards its readings to the autopilot.
    pub to_autopilot: bool,
    /// Rate of readings. [Hz]
    pub rate_hz: f32,
    /// Minimum range. [m]
    pub min_range_m: f32,
    /// Maximum range. [m]
    pub max_range_m: f32,
    /// Horizontal field of view. [rad]
    pub horizontal_fov_rad: f32,
    /// Vertical field of view. [rad]
    pub vertical_fov_rad: f32,
    /// Maximum number of records in a reading, used for the memory layout.
    pub most_records: u32,
    /// Pose of the sensor on the body. Sensor axes: x forward, y left, z up.
    pub body_from_sensor: Pose<Body, Sensor>,
}

impl SensorInfo {
    /// Returns the maximum size of a reading's records. [bytes]
    pub fn most_bytes(&self) -> usize {
        (self.most_records as usize).min(self.kind.max_records()) * self.kind.record_len()
    }
}
