//! Newest reading of each sensor other than cameras, shared by its receiver and its users.
//!
//! ```text
//! receiver tasks (or a graded flight) ── put ──▶ Readings ──▶ image thread: into observations and the log
//!                                                    └──────▶ control loop: to the autopilot
//! ```
//! Newest wins, by the instant of measurement. A reading is shared, not copied; its memory is freed after its last use.

use std::sync::{Arc, Mutex};
use vizflyt_process::lock;

use vizflyt_protocol::sensor::{InvalidReading, MAX_SENSORS, ReadingHeader};
use vizflyt_protocol::time::HostTime;
use vizflyt_sdk::GivenReading;

/// One received reading.
#[derive(Clone, Debug, PartialEq)]
pub struct Reading {
    /// Sensor, time and pose of the reading.
    pub header: ReadingHeader,
    /// Measurement time of the newest pose used for it. [host]
    pub pose: HostTime,
    /// Instant of the reading. [host]
    pub shown: HostTime,
    /// Arrival time of the last byte. [host]
    pub received: HostTime,
    pub records: Vec<u8>,
}

/// The newest reading of each sensor, by its index.
pub type NewestReadings = [Option<Arc<Reading>>; MAX_SENSORS];

impl Reading {
    /// Returns the reading's part of an observation, with the pose of the body only if the course `gives_pose`.
    pub fn given(&self, gives_pose: bool) -> GivenReading<'_> {
        GivenReading {
            seq: self.header.seq.get(),
            pose: self.pose,
            shown: self.shown,
            ready: self.received,
            body_from_sensor: self.header.body_from_sensor(),
            world_from_body: gives_pose.then(|| self.header.world_from_body()),
            records: &self.records,
        }
    }
}

/// The newest readings, behind a lock.
#[derive(Debug, Default)]
pub struct Readings(Mutex<NewestReadings>);

impl Readings {
    /// Replaces the sensor's older reading; drops `reading` if a newer one has arrived. Returns whether it was stored.
    pub fn put(&self, reading: Reading) -> bool {
        let mut newest = lock(&self.0);
        let Some(place) = newest.get_mut(usize::from(reading.header.sensor)) else { return false };
        let is_newer = place.as_ref().is_none_or(|old| old.shown < reading.shown);
        if is_newer {
            *place = Some(Arc::new(reading));
        }
        is_newer
    }

    /// Returns the newest readings.
    pub fn newest(&self) -> NewestReadings {
        lock(&self.0).clone()
    }
}

/// Returns the header of a reading, and the size of the records that follow. [bytes]
///
/// # Errors
/// Returns the errors of [`ReadingHeader::parse`].
pub(super) fn head(bytes: &[u8]) -> Result<(ReadingHeader, usize), InvalidReading> {
    let (header, _) = ReadingHeader::parse(bytes)?;
    Ok((header, header.payload_len()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::geometry::Pose;
    use vizflyt_protocol::sensor::SensorKind;
    use vizflyt_protocol::time::ServerTime;

    fn reading(sensor: u8, seq: u64, at_ns: u64) -> Reading {
        let of = (sensor, SensorKind::Sonar);
        let stamp = ServerTime::from_ns(at_ns);
        let header = ReadingHeader::new(seq, of, stamp, &Pose::IDENTITY, &Pose::IDENTITY, 1);
        let at = HostTime::from_ns(at_ns);
        Reading { header, pose: at, shown: at, received: at, records: vec![0; 8] }
    }

    #[test]
    fn keeps_the_newest_reading_of_each_sensor() {
        let readings = Readings::default();
        assert!(readings.put(reading(0, 5, 50)) && readings.put(reading(3, 1, 10)));
        assert!(!readings.put(reading(0, 4, 40)), "older than the stored one");
        // A restarted server counts from 1 again, but its stamps continue.
        assert!(readings.put(reading(0, 1, 60)));
        assert!(!readings.put(reading(200, 1, 70)), "invalid sensor index");
        let newest = readings.newest();
        let seqs: Vec<_> = newest.iter().flatten().map(|one| one.header.seq.get()).collect();
        assert_eq!(seqs, [1, 1]);
        assert_eq!(newest[0].as_ref().unwrap().given(false).world_from_body, None);
        assert!(newest[0].as_ref().unwrap().given(true).world_from_body.is_some());
    }
}
