//! Readings of the sensors beside the cameras: the newest of each, from whoever receives it to those who use it.
//!
//! ```text
//! receiver tasks (or a graded flight) ── put ──▶ Readings ──▶ image thread: into observations and the log
//!                                                    └──────▶ control loop: to the autopilot
//! ```
//! Newest wins, by the instant that a reading is of. A reading is shared, not copied; its memory goes when its last user
//! has done with it.

use std::sync::{Arc, Mutex};
use vizflyt_process::lock;

use vizflyt_protocol::sensor::{InvalidReading, MAX_SENSORS, ReadingHeader};
use vizflyt_protocol::time::HostTime;
use vizflyt_sdk::GivenReading;

/// One reading as it came.
#[derive(Clone, Debug, PartialEq)]
pub struct Reading {
    /// Whose it is, when and from where it was made.
    pub header: ReadingHeader,
    /// When the newest pose behind it was measured. [host]
    pub pose: HostTime,
    /// The instant that it is of. [host]
    pub shown: HostTime,
    /// When its last byte had come. [host]
    pub received: HostTime,
    /// Its records.
    pub records: Vec<u8>,
}

/// The newest reading of each sensor, by its index.
pub type NewestReadings = [Option<Arc<Reading>>; MAX_SENSORS];

impl Reading {
    /// Returns what goes into an observation; where the body was only if the course `gives_pose`.
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

/// Where the newest readings are.
#[derive(Debug, Default)]
pub struct Readings(Mutex<NewestReadings>);

impl Readings {
    /// Puts a reading in the place of an older one of the same sensor; drops one that was overtaken. Returns whether it
    /// was put.
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

/// Returns the header of a reading on the wire, and its bytes of records that follow.
///
/// # Errors
/// As [`ReadingHeader::parse`].
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
    fn the_newest_of_each_sensor_counts() {
        let readings = Readings::default();
        assert!(readings.put(reading(0, 5, 50)) && readings.put(reading(3, 1, 10)));
        assert!(!readings.put(reading(0, 4, 40)), "overtaken on its way");
        // A server that was restarted counts from the start; its instants go on.
        assert!(readings.put(reading(0, 1, 60)));
        assert!(!readings.put(reading(200, 1, 70)), "there is no such sensor");
        let newest = readings.newest();
        let seqs: Vec<_> = newest.iter().flatten().map(|one| one.header.seq.get()).collect();
        assert_eq!(seqs, [1, 1]);
        assert_eq!(newest[0].as_ref().unwrap().given(false).world_from_body, None);
        assert!(newest[0].as_ref().unwrap().given(true).world_from_body.is_some());
    }
}
