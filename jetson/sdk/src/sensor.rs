//! Sensors other than cameras: views for the plugin, and the writer for the runtime.

use vizflyt_protocol::geometry::{Body, Pose, Sensor, World};
use vizflyt_protocol::packet::ObservationHeader;
use vizflyt_protocol::sensor::memory::{Records, align, records_begin, section_len};
use vizflyt_protocol::sensor::{
    LidarPoint, MAX_SENSORS, RadarDetection, SensorHeader, SensorInfo, SensorKind,
};
use vizflyt_protocol::time::HostTime;
use zerocopy::{FromBytes, IntoBytes};

use crate::memory::ObservationWriter;
use crate::observation::Observation;

/// Newest reading of one sensor.
///
/// A reading stays in later observations until the next one arrives. A changed `seq` marks a new reading.
#[derive(Clone, Copy, Debug)]
pub struct SensorReading<'a> {
    /// Name of the sensor in `arena.toml`.
    pub name: &'a str,
    /// Kind of the sensor; `records` has the matching variant.
    pub kind: SensorKind,
    /// Number of the reading, from 1. Missing numbers were dropped, because no subscriber needed them in time.
    pub seq: u64,
    /// Measurement time of the newest pose behind the reading. [host]
    pub stamp: HostTime,
    /// Instant of the reading; for a sweep, the instant of its last beam. [host]
    pub shown: HostTime,
    /// Time at which the runtime received the reading. [host]
    pub ready: HostTime,
    /// Pose of the sensor on the body. Its axes are x forward, y left, z up.
    pub body_from_sensor: Pose<Body, Sensor>,
    /// Pose of the body at `shown`; `None` if the course withholds the pose. [m, world]
    pub pose_at_reading: Option<Pose<World, Body>>,
    /// Measured values.
    pub records: Records<'a>,
}

impl<'a> SensorReading<'a> {
    /// Returns the points of a LiDAR; empty for other sensors.
    pub fn points(&self) -> &'a [LidarPoint] {
        match self.records {
            Records::Lidar(points) => points,
            _ => &[],
        }
    }

    /// Returns the distance measured by a range finder or sonar. `None` without a return, and for other sensors. [m]
    pub fn range_m(&self) -> Option<f32> {
        match self.records {
            Records::Range(reading) => reading.measured_m(),
            _ => None,
        }
    }

    /// Returns the detections of a radar; empty for other sensors.
    pub fn detections(&self) -> &'a [RadarDetection] {
        match self.records {
            Records::Radar(detections) => detections,
            _ => &[],
        }
    }
}

impl<'a> Observation<'a> {
    /// Returns the newest reading of the sensor with this name. `None` for an unknown name, or without a reading.
    pub fn sensor(&self, name: &str) -> Option<SensorReading<'a>> {
        self.sensors().find(|reading| reading.name == name)
    }

    /// Returns the newest available readings, in the order of the arena's sensors.
    pub fn sensors(&self) -> impl Iterator<Item = SensorReading<'a>> + use<'a> {
        let bytes = self.as_bytes();
        let table = self.header().sensors(bytes);
        table.iter().filter_map(move |sensor| reading(bytes, sensor))
    }
}

fn reading<'a>(bytes: &'a [u8], sensor: &'a SensorHeader) -> Option<SensorReading<'a>> {
    Some(SensorReading {
        name: sensor.name(),
        kind: sensor.kind()?,
        seq: sensor.seq,
        stamp: HostTime::from_ns(sensor.pose_ns),
        shown: HostTime::from_ns(sensor.stamp_ns),
        ready: HostTime::from_ns(sensor.ready_ns),
        body_from_sensor: sensor.body_from_sensor(),
        pose_at_reading: sensor.pose_at_reading(),
        records: sensor.records(bytes)?,
    })
}

/// Reading to be written into an observation.
#[derive(Clone, Copy, Debug)]
pub struct GivenReading<'r> {
    /// Number of the reading, from 1.
    pub seq: u64,
    /// Measurement time of the newest pose behind the reading. [host]
    pub pose: HostTime,
    /// Instant of the reading. [host]
    pub shown: HostTime,
    /// Time at which the runtime received the reading. [host]
    pub ready: HostTime,
    /// Pose of the sensor on the body.
    pub body_from_sensor: Pose<Body, Sensor>,
    /// Pose of the body, if the course gives the pose to the plugin. [m, world]
    pub world_from_body: Option<Pose<World, Body>>,
    /// Records as bytes, at most the maximum number of the sensor's kind.
    pub records: &'r [u8],
}

impl ObservationWriter<'_> {
    /// Returns the maximum size of these sensors' readings after the images of an observation. [bytes]
    pub fn sensors_len(sensors: &[SensorInfo]) -> usize {
        section_len(sensors.iter().take(MAX_SENSORS).map(SensorInfo::most_bytes))
    }

    /// Writes the newest readings after the images. `None` stands for a sensor without a reading. Call it once, when
    /// all images are written. If a reading does not fit into the memory or is not valid for its sensor, only the
    /// sensor's entry is written.
    pub fn sensors(&mut self, sensors: &[SensorInfo], readings: &[Option<GivenReading<'_>>]) {
        let count = sensors.len().min(MAX_SENSORS);
        let begin = self.images_end();
        let mut end = begin + records_begin(count);
        if count == 0 || end > self.memory().len() {
            return;
        }
        let mut table = [SensorHeader::default(); MAX_SENSORS];
        for (index, (sensor, head)) in sensors.iter().zip(&mut table).enumerate() {
            head.set_name(&sensor.name);
            head.kind = sensor.kind as u32;
            let Some(reading) = readings.get(index).copied().flatten() else { continue };
            let (len, record) = (reading.records.len(), sensor.kind.record_len());
            let count = len / record;
            let is_one = len % record == 0
                && count <= sensor.kind.max_records()
                && (count == 1 || !sensor.kind.is_single());
            let Some(room) = self.memory().get_mut(end..end + len).filter(|_| is_one) else {
                continue;
            };
            room.copy_from_slice(reading.records);
            (head.records_offset, head.record_count) = (end as u32, count as u32);
            (head.seq, head.pose_ns) = (reading.seq, reading.pose.as_ns());
            (head.stamp_ns, head.ready_ns) = (reading.shown.as_ns(), reading.ready.as_ns());
            head.translation_m = reading.body_from_sensor.translation_m.to_array();
            head.rotation_xyzw = reading.body_from_sensor.rotation.to_array();
            if let Some(pose) = reading.world_from_body {
                head.body_position_m = pose.translation_m.to_array();
                head.body_rotation_xyzw = pose.rotation.to_array();
            }
            end = align(end + len);
        }
        let bytes = table[..count].as_bytes();
        self.memory()[begin..begin + bytes.len()].copy_from_slice(bytes);
        let total_len = end.min(self.memory().len()) as u32;
        if let Ok((header, _)) = ObservationHeader::mut_from_prefix(self.memory()) {
            (header.sensors_offset, header.sensor_count) = (begin as u32, count as u32);
            header.total_len = total_len;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ObservationBuffer;
    use glam::{DQuat, DVec3};
    use vizflyt_protocol::geometry::Intrinsics;
    use vizflyt_protocol::messages::{CameraInfo, bounded};
    use vizflyt_protocol::sensor::RangeReading;

    fn sensor(name: &str, kind: SensorKind, most_records: u32) -> SensorInfo {
        SensorInfo {
            name: bounded(name),
            kind,
            enabled: true,
            to_autopilot: false,
            rate_hz: 10.0,
            min_range_m: 0.1,
            max_range_m: 10.0,
            horizontal_fov_rad: 0.1,
            vertical_fov_rad: 0.1,
            most_records,
            body_from_sensor: Pose::IDENTITY,
        }
    }

    fn given(seq: u64, records: &[u8]) -> GivenReading<'_> {
        GivenReading {
            seq,
            pose: HostTime::from_ns(5),
            shown: HostTime::from_ns(7),
            ready: HostTime::from_ns(9),
            body_from_sensor: Pose::new(DVec3::Z, DQuat::from_rotation_y(0.5)),
            world_from_body: Some(Pose::new(DVec3::X, DQuat::IDENTITY)),
            records,
        }
    }

    #[test]
    fn readings_round_trip_through_memory() {
        let camera = CameraInfo::forward("front", Intrinsics::from_horizontal_fov(5, 3, 1.5));
        let sensors = [
            sensor("top", SensorKind::Lidar, 3),
            sensor("down", SensorKind::RangeFinder, 1),
            sensor("nose", SensorKind::Radar, 4),
        ];
        let mut buffer = ObservationBuffer::with_sensors(&[camera], &sensors);
        assert!(buffer.observation().sensors().next().is_none(), "none yet");
        let points = [LidarPoint { p_m: [1.0, 2.0, 3.0], ring: 7, ..LidarPoint::default() }; 2];
        let range = RangeReading { range_m: 1.25, signal: 1.0 };
        buffer.set_readings(&[
            Some(given(3, points.as_bytes())),
            Some(given(4, range.as_bytes())),
            None,
        ]);
        let found = buffer.observation();
        let top = found.sensor("top").unwrap();
        assert_eq!((top.seq, top.points(), top.range_m()), (3, &points[..], None));
        assert_eq!((top.stamp.as_ns(), top.shown.as_ns(), top.ready.as_ns()), (5, 7, 9));
        assert_eq!(top.pose_at_reading.unwrap().translation_m, DVec3::X);
        assert_eq!(found.sensor("down").unwrap().range_m(), Some(1.25));
        assert!(found.sensor("nose").is_none() && found.sensors().count() == 2);
        // A scan with more records than its kind allows, and one that is cut in the middle of a record.
        let many = [LidarPoint::default(); 300];
        buffer.set_readings(&[Some(given(5, many.as_bytes())), Some(given(5, &[0; 7])), None]);
        assert_eq!(buffer.observation().sensors().count(), 0);
    }

    #[test]
    fn no_sensors_add_no_bytes_to_an_observation() {
        let camera = CameraInfo::forward("front", Intrinsics::from_horizontal_fov(5, 3, 1.5));
        assert_eq!(ObservationWriter::sensors_len(&[]), 0);
        let mut buffer = ObservationBuffer::new(std::slice::from_ref(&camera));
        buffer.set_readings(&[]);
        assert_eq!(buffer.observation().sensors().count(), 0);
        let len = buffer.as_bytes().len();
        assert_eq!(len, ObservationBuffer::with_sensors(&[camera], &[]).as_bytes().len());
    }
}
