//! What there is of sensors beside the cameras.

use serde::{Deserialize, Serialize};

use super::records::{LidarPoint, RadarDetection, RangeReading};
use crate::geometry::{Body, Pose, Sensor};
use crate::messages::Name;

/// The kind of a sensor; its number is the same on the wire, in shared memory and in the C header. New kinds go
/// at the end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum SensorKind {
    /// Points, of a spinning or a solid-state scanner: [`LidarPoint`]s.
    Lidar = 1,
    /// One narrow beam of light: a [`RangeReading`].
    RangeFinder = 2,
    /// One wide cone of ultrasound: a [`RangeReading`].
    Sonar = 3,
    /// Range, direction and radial speed: [`RadarDetection`]s.
    Radar = 4,
}

impl SensorKind {
    /// Every one.
    pub const ALL: [Self; 4] = [Self::Lidar, Self::RangeFinder, Self::Sonar, Self::Radar];

    /// Returns the kind of a number; `None` of one that this version does not know.
    pub fn from_number(number: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|&kind| kind as u32 == number)
    }

    /// Returns its name, as `arena.toml` has it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Lidar => "lidar",
            Self::RangeFinder => "range_finder",
            Self::Sonar => "sonar",
            Self::Radar => "radar",
        }
    }

    /// Returns the bytes of one of its records. [bytes]
    pub const fn record_len(self) -> usize {
        match self {
            Self::Lidar => size_of::<LidarPoint>(),
            Self::RangeFinder | Self::Sonar => size_of::<RangeReading>(),
            Self::Radar => size_of::<RadarDetection>(),
        }
    }

    /// Returns the most records of one reading: of a LiDAR 128 rings of 1024 columns, which are 2.6 MB.
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

/// A sensor as the runtime and plugins must know it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SensorInfo {
    /// Its name in `arena.toml`.
    pub name: Name,
    /// Its kind.
    pub kind: SensorKind,
    /// Whether it measures; it can be switched in flight.
    pub enabled: bool,
    /// Whether the runtime passes its readings on to the autopilot.
    pub to_autopilot: bool,
    /// Readings a second. [Hz]
    pub rate_hz: f32,
    /// Nearest that it measures. [m]
    pub min_range_m: f32,
    /// Furthest that it measures. [m]
    pub max_range_m: f32,
    /// Width of what it sees, from side to side. [rad]
    pub horizontal_fov_rad: f32,
    /// Height of what it sees. [rad]
    pub vertical_fov_rad: f32,
    /// Most records of one reading; memory is laid out for so many.
    pub most_records: u32,
    /// Where it sits: sensor axes are x forward, y left, z up.
    pub body_from_sensor: Pose<Body, Sensor>,
}

impl SensorInfo {
    /// Returns the most bytes of one reading's records. [bytes]
    pub fn most_bytes(&self) -> usize {
        (self.most_records as usize).min(self.kind.max_records()) * self.kind.record_len()
    }
}
