//! What sensors measure, as plain structs: the same bytes on the wire, in shared memory and in logs. Little-endian, as
//! all of shared memory.

use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// One return of a LiDAR. Beams without a return have none.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, KnownLayout, Immutable)]
#[repr(C)]
pub struct LidarPoint {
    /// Where the beam met something, in the sensor's axes as they were when this beam was fired: x forward, y left,
    /// z up. Not corrected for motion during the sweep. [m, sensor]
    pub p_m: [f32; 3],
    /// How long before the reading's instant the beam was fired: the instant is that of the sweep's last. [ns]
    pub before_ns: u32,
    /// What came back, freed of range: 255 of a white surface across the whole beam.
    pub intensity: u16,
    /// The beam's ring or row, from 0, in the order of its model.
    pub ring: u16,
}

/// One measurement of a single beam or cone.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, KnownLayout, Immutable)]
#[repr(C)]
pub struct RangeReading {
    /// Distance along the sensor's x axis; 0 where nothing came back within its range. [m]
    pub range_m: f32,
    /// Power of the echo over the detection threshold: 1 where nine in ten such echoes are detected; 0 without one.
    pub signal: f32,
}

impl RangeReading {
    /// Returns the distance; `None` where nothing came back. [m]
    pub fn measured_m(&self) -> Option<f32> {
        (self.range_m > 0.0).then_some(self.range_m)
    }
}

/// One detection of a radar.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, KnownLayout, Immutable)]
#[repr(C)]
pub struct RadarDetection {
    /// Distance. [m]
    pub range_m: f32,
    /// Angle to the left of the sensor's x axis, about z. [rad, sensor]
    pub azimuth_rad: f32,
    /// How fast it goes away; an approaching one is negative. [m/s]
    pub radial_mps: f32,
    /// Its power above the noise. [dB]
    pub snr_db: f32,
    /// Radar cross section. [m^2]
    pub cross_section_m2: f32,
}

// The layout is a contract with other languages and processes.
const _: () = assert!(size_of::<LidarPoint>() == 20 && align_of::<LidarPoint>() == 4);
const _: () = assert!(size_of::<RangeReading>() == 8 && size_of::<RadarDetection>() == 20);
