//! Sensor measurements as plain structs, with the same bytes on the wire, in shared memory and in logs. Little-endian,
//! like all of shared memory.

use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// One return of a LiDAR. Beams without a return have no point.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, KnownLayout, Immutable)]
#[repr(C)]
pub struct LidarPoint {
    /// Position of the return in the sensor's axes at the time of this beam: x forward, y left, z up. Not corrected for
    /// motion during the sweep. [m, sensor]
    pub p_m: [f32; 3],
    /// Time from this beam to the stamp of the reading, which is the last beam of the sweep. [ns]
    pub before_ns: u32,
    /// Intensity, corrected for range: 255 for a white surface that fills the beam.
    pub intensity: u16,
    /// Ring or row of the beam, from 0, in the order of the sensor's model.
    pub ring: u16,
}

/// One measurement of a single beam or cone.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, KnownLayout, Immutable)]
#[repr(C)]
pub struct RangeReading {
    /// Distance along the sensor's x axis; 0 without a return within range. [m]
    pub range_m: f32,
    /// Power of the echo relative to the detection threshold: at 1, nine of ten such echoes are detected. 0 without an
    /// echo.
    pub signal: f32,
}

impl RangeReading {
    /// Returns the distance; `None` without a return. [m]
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
    /// Radial speed, positive if moving away. [m/s]
    pub radial_mps: f32,
    /// Signal-to-noise ratio. [dB]
    pub snr_db: f32,
    /// Radar cross section. [m^2]
    pub cross_section_m2: f32,
}

// The layout is an interface to other languages and processes.
const _: () = assert!(size_of::<LidarPoint>() == 20 && align_of::<LidarPoint>() == 4);
const _: () = assert!(size_of::<RangeReading>() == 8 && size_of::<RadarDetection>() == 20);
