//! Readings of sensors other than cameras, as messages for viewers on `/sensor/NAME`, in the sensor's axes: LiDAR and
//! radar as foxglove.PointCloud, range finder and sonar as foxglove.LaserScan of one beam.
//!
//! A LiDAR's points have the same bytes as for the plugin, so that a replay reads them from these messages.

use std::sync::Arc;

use foxglove::messages as fox;
use prost::Message;
use vizflyt_protocol::geometry::{Body, Pose, Sensor};
use vizflyt_protocol::packet::ObservationHeader;
use vizflyt_protocol::sensor::{LidarPoint, RadarDetection, SensorInfo, SensorKind};
use zerocopy::{FromBytes, IntoBytes};

use super::channels::Channel;
use super::convert::{BODY, parts, timestamp};
use crate::stream::{NewestReadings, Reading};

/// Sensors of an observation for the log.
#[derive(Clone, Debug, Default)]
pub struct LoggedSensors {
    /// Table of sensors in shared memory: one `vizflyt_protocol::sensor::SensorHeader` each.
    pub table: Vec<u8>,
    /// Newest readings.
    pub readings: Vec<LoggedReading>,
}

/// Newest reading of one sensor for the log.
#[derive(Clone, Debug)]
pub struct LoggedReading {
    /// Index of the sensor.
    pub sensor: u8,
    /// Name of the sensor.
    pub name: String,
    pub reading: Arc<Reading>,
}

impl LoggedSensors {
    /// Returns the sensors of an observation in shared memory, with those readings that it contains.
    pub fn of(observation: &[u8], sensors: &[SensorInfo], readings: &NewestReadings) -> Self {
        if sensors.is_empty() {
            return Self::default();
        }
        let table = ObservationHeader::parse(observation)
            .map(|header| header.sensors(observation))
            .unwrap_or_default();
        let written = (0..).zip(sensors).zip(readings).zip(table).filter(|(_, head)| head.seq > 0);
        let logged = written.filter_map(|(((sensor, info), reading), _)| {
            let (name, reading) = (info.name.as_str().to_owned(), reading.clone()?);
            Some(LoggedReading { sensor, name, reading })
        });
        Self { table: table.as_bytes().to_vec(), readings: logged.collect() }
    }
}

impl LoggedReading {
    pub(super) fn kind(&self) -> SensorKind {
        self.reading.header.kind()
    }

    /// Whether the log keeps the records only on the sensor's topic.
    pub(super) fn is_apart(&self) -> bool {
        self.kind() == SensorKind::Lidar
    }

    pub(super) fn channel(&self) -> Channel {
        if self.kind().is_single() {
            Channel::Range(self.sensor)
        } else {
            Channel::Points(self.sensor)
        }
    }

    /// Returns the message for viewers, with the instant `at_ns`. [ns, since 1970]
    pub(super) fn message(&self, at_ns: u64) -> Vec<u8> {
        let body_from_sensor = self.reading.header.body_from_sensor();
        let records = &self.reading.records;
        match self.kind() {
            SensorKind::Lidar => {
                cloud(at_ns, &body_from_sensor, LIDAR, size_of::<LidarPoint>(), records.clone())
            }
            SensorKind::RangeFinder | SensorKind::Sonar => {
                let range = vizflyt_protocol::sensor::RangeReading::read_from_bytes(records);
                let range = range.unwrap_or_default();
                fox::LaserScan {
                    timestamp: Some(timestamp(at_ns)),
                    frame_id: BODY.into(),
                    pose: Some(fox_pose(&body_from_sensor)),
                    start_angle: 0.0,
                    end_angle: 0.0,
                    // Infinity for no return, as in ROS (REP 117).
                    ranges: vec![range.measured_m().map_or(f64::INFINITY, f64::from)],
                    intensities: vec![range.signal.into()],
                }
                .encode_to_vec()
            }
            SensorKind::Radar => {
                let detections = <[RadarDetection]>::ref_from_bytes(records).unwrap_or_default();
                let data: Vec<u8> = detections.iter().flat_map(bytes_of).collect();
                cloud(at_ns, &body_from_sensor, RADAR, 20, data)
            }
        }
    }
}

/// Returns the points of a LiDAR's message from [`LoggedReading::message`].
pub(super) fn points_of(message: &[u8]) -> Option<Vec<u8>> {
    let cloud = fox::PointCloud::decode(message).ok()?;
    Some(cloud.data.to_vec()).filter(|data| data.len() % size_of::<LidarPoint>() == 0)
}

/// Name, offset and type of each field of a point.
type Fields = &'static [(&'static str, u32, fox::packed_element_field::NumericType)];

use fox::packed_element_field::NumericType::{Float32, Uint16, Uint32};

const LIDAR: Fields = &[
    ("x", 0, Float32),
    ("y", 4, Float32),
    ("z", 8, Float32),
    ("before_ns", 12, Uint32),
    ("intensity", 16, Uint16),
    ("ring", 18, Uint16),
];
const RADAR: Fields = &[
    ("x", 0, Float32),
    ("y", 4, Float32),
    ("z", 8, Float32),
    ("radial_mps", 12, Float32),
    ("snr_db", 16, Float32),
];

fn bytes_of(detection: &RadarDetection) -> [u8; 20] {
    let RadarDetection { range_m, azimuth_rad, radial_mps, snr_db, .. } = *detection;
    let (x, y) = (range_m * azimuth_rad.cos(), range_m * azimuth_rad.sin());
    let mut bytes = [0; 20];
    let values = [x, y, 0.0, radial_mps, snr_db];
    for (to, value) in bytes.as_chunks_mut::<4>().0.iter_mut().zip(values) {
        *to = value.to_le_bytes();
    }
    bytes
}

fn cloud(
    at_ns: u64,
    body_from_sensor: &Pose<Body, Sensor>,
    fields: Fields,
    stride: usize,
    data: Vec<u8>,
) -> Vec<u8> {
    let field = |&(name, offset, kind): &(&str, u32, fox::packed_element_field::NumericType)| {
        fox::PackedElementField { name: name.into(), offset, r#type: kind.into() }
    };
    fox::PointCloud {
        timestamp: Some(timestamp(at_ns)),
        frame_id: BODY.into(),
        pose: Some(fox_pose(body_from_sensor)),
        point_stride: stride as u32,
        fields: fields.iter().map(field).collect(),
        data: data.into(),
    }
    .encode_to_vec()
}

fn fox_pose(pose: &Pose<Body, Sensor>) -> fox::Pose {
    let (position, orientation) = parts(pose);
    fox::Pose { position: Some(position), orientation: Some(orientation) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};
    use vizflyt_protocol::sensor::{RangeReading, ReadingHeader};
    use vizflyt_protocol::time::{HostTime, ServerTime};

    fn logged(kind: SensorKind, records: &[u8]) -> LoggedReading {
        let mount = Pose::new(DVec3::Z, DQuat::from_rotation_z(0.5));
        let count = (records.len() / kind.record_len()) as u32;
        let stamp = ServerTime::from_ns(5);
        let header = ReadingHeader::new(1, (0, kind), stamp, &mount, &Pose::IDENTITY, count);
        let at = HostTime::from_ns(5);
        let reading =
            Reading { header, pose: at, shown: at, received: at, records: records.to_vec() };
        LoggedReading { sensor: 0, name: "top".into(), reading: Arc::new(reading) }
    }

    #[test]
    fn lidar_points_keep_their_bytes_in_a_point_cloud() {
        let points = [LidarPoint { p_m: [1.0, 2.0, 3.0], before_ns: 9, intensity: 4, ring: 5 }; 3];
        let one = logged(SensorKind::Lidar, points.as_bytes());
        let message = one.message(7_000_000_001);
        assert_eq!(points_of(&message).as_deref(), Some(points.as_bytes()));
        let cloud = fox::PointCloud::decode(&*message).unwrap();
        assert_eq!((cloud.point_stride, &*cloud.frame_id), (20, "body"));
        // Reads values with the message's description of its fields, as viewers do.
        let at = |name: &str| {
            let field = cloud.fields.iter().find(|field| field.name == name).unwrap();
            let from = 20 + field.offset as usize;
            (field.r#type(), cloud.data[from..from + 4].to_vec())
        };
        assert_eq!(at("y"), (Float32, 2f32.to_le_bytes().to_vec()));
        assert_eq!(at("before_ns"), (Uint32, 9u32.to_le_bytes().to_vec()));
        let (kind, bytes) = at("intensity");
        assert_eq!((kind, &bytes[..2]), (Uint16, &4u16.to_le_bytes()[..]));
        assert_eq!(cloud.pose.unwrap().position.unwrap().z, 1.0);
        assert_eq!(points_of(&[1, 2, 3]), None);
    }

    #[test]
    fn converts_ranges_to_scans_and_detections_to_points() {
        let range = RangeReading { range_m: 1.5, signal: 0.25 };
        let message = logged(SensorKind::Sonar, range.as_bytes()).message(0);
        let scan = fox::LaserScan::decode(&*message).unwrap();
        assert_eq!((scan.ranges, scan.intensities), (vec![1.5], vec![0.25]));
        let nothing = RangeReading::default();
        let message = logged(SensorKind::RangeFinder, nothing.as_bytes()).message(0);
        assert_eq!(fox::LaserScan::decode(&*message).unwrap().ranges, [f64::INFINITY]);
        let half_pi = std::f32::consts::FRAC_PI_2;
        let left =
            RadarDetection { range_m: 4.0, azimuth_rad: half_pi, ..RadarDetection::default() };
        let message = logged(SensorKind::Radar, left.as_bytes()).message(0);
        let data = fox::PointCloud::decode(&*message).unwrap().data;
        let y = f32::from_le_bytes(data[4..8].try_into().unwrap());
        assert!((y - 4.0).abs() < 1e-6, "{y}");
    }
}
