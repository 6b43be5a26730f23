//! Data of a flight log for `vizflyt export`: images with the instants that they show, poses, IMU and setpoints, in
//! the order in which they were written.

use std::io::Read;

use glam::DVec3;
use vizflyt_protocol::geometry::{Body, Frame, Odom, Pose, World};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::sensor::{MAX_SENSORS, SensorHeader};
use zerocopy::FromBytes;

use super::channels::Channel;
use super::messages::Observation;
use super::read::{LogError, LogMessage, LogReader, Next, Recorded, RecordedFlight, pose_of};

/// Pose of the body at an instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StampedPose<A: Frame> {
    /// Time since 1970. [ns]
    pub at_ns: u64,
    /// Pose of the body in the frame `A`.
    pub from_body: Pose<A, Body>,
}

/// One image of a flight. Times count from 1970, on the clock of the log.
#[derive(Clone, Debug, PartialEq)]
pub struct FlightImage {
    /// Name of the camera.
    pub camera: String,
    /// Number of the image's observation.
    pub seq: u64,
    /// Instant that the image shows. [ns]
    pub shown_ns: u64,
    /// Measurement time of the newest pose used for the image. [ns]
    pub pose_ns: u64,
    /// Arrival time of the last byte. [ns]
    pub received_ns: u64,
    /// Camera, lens, mounting, and pose for rendering.
    pub header: ImageHeader,
    /// RGB-D bitstream; empty if read without images.
    pub bitstream: Vec<u8>,
}

/// Localized velocity of the vehicle, and uncertainty of its pose.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FlightMotion {
    /// Instant of the motion, since 1970. [ns]
    pub at_ns: u64,
    /// Velocity. [m/s, world]
    pub v_world_mps: DVec3,
    /// Standard deviation of the position on each axis; 0 if unknown. [m, world]
    pub position_sigma_m: DVec3,
    /// Standard deviation of the attitude about each axis; 0 if unknown. [rad, body]
    pub rotation_sigma_rad: DVec3,
}

/// A reading of the IMU.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlightImu {
    /// Measurement time, since 1970. [ns]
    pub at_ns: u64,
    /// Specific force. [m/s^2, body]
    pub accel_mps2: DVec3,
    /// Angular velocity. [rad/s, body]
    pub gyro_radps: DVec3,
}

/// A new reading of a sensor other than a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct FlightReading {
    /// Instant of the reading, for a sweep its end, since 1970. [ns]
    pub at_ns: u64,
    /// Header of the sensor as passed to the plugin; its times are on the clock of the flight's computer. [ns, host]
    pub sensor: SensorHeader,
    /// Records as in shared memory, in the format of the sensor's kind.
    pub records: Vec<u8>,
}

/// Datum of a flight's log.
#[derive(Clone, Debug, PartialEq)]
#[allow(clippy::large_enum_variant)] // Why: only one exists at a time.
pub enum FlightDatum {
    Image(FlightImage),
    /// Images omitted by a reduced log.
    LeftOut,
    /// A reading of a sensor. Large readings require reading with images.
    Reading(FlightReading),
    /// A localized pose.
    Pose(StampedPose<World>),
    /// Velocity and uncertainty for the pose of the same instant.
    Motion(FlightMotion),
    Imu(FlightImu),
    /// An odometry estimate of the plugin.
    Odometry(StampedPose<Odom>),
    /// Time and JSON of a setpoint requested by the plugin. [ns, since 1970]
    Asked(u64, Vec<u8>),
    /// Time and JSON of a setpoint sent by the guard. [ns, since 1970]
    Sent(u64, Vec<u8>),
    /// An image of an unsupported protocol version.
    Foreign {
        protocol: u32,
    },
}

/// Reads the data of a flight log.
pub struct FlightData<R> {
    flight: RecordedFlight<R>,
    topics: [(String, Topic); 6],
    /// Data of the last message, not yet returned.
    ready: std::collections::VecDeque<FlightDatum>,
    /// Number of each sensor's newest reading.
    readings_had: [u64; MAX_SENSORS],
}

#[derive(Clone, Copy, Debug)]
enum Topic {
    Pose,
    Motion,
    Imu,
    Odometry,
    Asked,
    Sent,
}

impl<R: Read> FlightData<R> {
    /// Reads from `reader`; without images, their bitstreams are empty.
    pub fn new(reader: LogReader<R>, with_images: bool) -> Self {
        let topics = [
            (Channel::Pose, Topic::Pose),
            (Channel::Motion, Topic::Motion),
            (Channel::Imu, Topic::Imu),
            (Channel::Odometry, Topic::Odometry),
            (Channel::Requested, Topic::Asked),
            (Channel::Sent, Topic::Sent),
        ];
        Self {
            flight: RecordedFlight::new(reader, with_images),
            topics: topics.map(|(channel, topic)| (channel.topic(""), topic)),
            ready: std::collections::VecDeque::new(),
            readings_had: [0; MAX_SENSORS],
        }
    }

    /// Whether the log is truncated or damaged; valid after [`Self::next`] has returned `None`.
    pub fn is_cut(&self) -> bool {
        self.flight.is_cut()
    }

    /// Returns the next datum; `None` at the end. Skips messages that do not decode.
    ///
    /// # Errors
    /// If the file cannot be read.
    #[allow(clippy::should_implement_trait)] // Why: `Result<Option>` ends at an error.
    pub fn next(&mut self) -> Result<Option<FlightDatum>, LogError> {
        loop {
            if let Some(datum) = self.ready.pop_front() {
                return Ok(Some(datum));
            }
            match self.flight.next_of_all()? {
                None => return Ok(None),
                Some((at_ns, Next::Recorded(Recorded::Observation(observation)))) => {
                    self.observation(at_ns, observation);
                }
                Some((_, Next::Recorded(_))) => {}
                Some((_, Next::Other(message))) => {
                    let datum = self.datum(&message);
                    self.ready.extend(datum);
                }
            }
        }
    }

    fn datum(&self, message: &LogMessage) -> Option<FlightDatum> {
        let (_, topic) = self.topics.iter().find(|(topic, _)| **topic == *message.topic)?;
        let json = || serde_json::from_slice::<serde_json::Value>(&message.data).ok();
        let at_ns = message.log_time_ns;
        Some(match topic {
            Topic::Pose => FlightDatum::Pose(stamped(message)?),
            Topic::Odometry => FlightDatum::Odometry(stamped(message)?),
            Topic::Motion => {
                let motion = json()?;
                let of = |key: &str| vector(&motion[key]);
                FlightDatum::Motion(FlightMotion {
                    at_ns,
                    v_world_mps: of("v_world_mps")?,
                    position_sigma_m: of("position_sigma_m").unwrap_or_default(),
                    rotation_sigma_rad: of("rotation_sigma_rad").unwrap_or_default(),
                })
            }
            Topic::Imu => {
                let reading = json()?;
                let (accel_mps2, gyro_radps) =
                    (vector(&reading["accel_mps2"])?, vector(&reading["gyro_radps"])?);
                FlightDatum::Imu(FlightImu { at_ns, accel_mps2, gyro_radps })
            }
            Topic::Asked => FlightDatum::Asked(at_ns, message.data.clone()),
            Topic::Sent => FlightDatum::Sent(at_ns, message.data.clone()),
        })
    }

    /// Queues the new readings of an observation.
    fn readings(&mut self, offset_ns: u64, observation: &Observation) {
        let table = observation.sensors.chunks_exact(size_of::<SensorHeader>());
        let table = table.filter_map(|bytes| SensorHeader::read_from_bytes(bytes).ok());
        for (index, (sensor, had)) in table.zip(&mut self.readings_had).enumerate() {
            // Separate points are missing if read without images, or in a reduced log.
            let records = observation
                .records
                .iter()
                .find(|records| records.sensor as usize == index && !records.is_apart);
            let Some(records) = records else { continue };
            if std::mem::replace(had, sensor.seq) != sensor.seq {
                self.ready.push_back(FlightDatum::Reading(FlightReading {
                    at_ns: sensor.stamp_ns.wrapping_add(offset_ns),
                    sensor,
                    records: records.bytes.clone(),
                }));
            }
        }
    }

    fn observation(&mut self, at_ns: u64, observation: Observation) {
        // Offset from the host clock to time since 1970.
        let offset_ns = at_ns.wrapping_sub(observation.published_ns);
        self.readings(offset_ns, &observation);
        let Observation { seq, protocol, images, .. } = observation;
        if images.is_empty() {
            self.ready.push_back(FlightDatum::LeftOut);
        }
        for image in images {
            let Ok((header, _)) = ImageHeader::parse_logged(&image.header, protocol) else {
                self.ready.push_back(FlightDatum::Foreign { protocol });
                continue;
            };
            self.ready.push_back(FlightDatum::Image(FlightImage {
                camera: image.name,
                seq,
                shown_ns: image.shown_ns.wrapping_add(offset_ns),
                pose_ns: image.pose_ns.wrapping_add(offset_ns),
                received_ns: image.received_ns.wrapping_add(offset_ns),
                header,
                bitstream: image.bitstream,
            }));
        }
    }
}

fn vector(value: &serde_json::Value) -> Option<DVec3> {
    let numbers: [f64; 3] = serde_json::from_value(value.clone()).ok()?;
    Some(DVec3::from(numbers)).filter(|vector| vector.is_finite())
}

fn stamped<A: Frame>(message: &LogMessage) -> Option<StampedPose<A>> {
    // The topic determines the frame of its poses.
    let (at_ns, pose) = pose_of(message)?;
    Some(StampedPose { at_ns, from_body: Pose::new(pose.translation_m, pose.rotation) })
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use glam::DQuat;
    use mcap::records::MessageHeader;
    use prost::Message as _;
    use vizflyt_protocol::PROTOCOL_VERSION;
    use vizflyt_protocol::geometry::Intrinsics;
    use vizflyt_protocol::time::ServerTime;
    use zerocopy::IntoBytes;

    use super::super::messages::{ObservedImage, ObservedRecords};
    use super::*;

    /// Offset from the clock of the flight's computer to time since 1970. [ns]
    const OFFSET_NS: u64 = 1_700_000_000_000_000_000;

    fn observation(n: u64) -> Observation {
        let pose_ns = n * 33_000_000;
        let k = Intrinsics::from_horizontal_fov(8, 6, 1.5);
        let body = Pose::new(DVec3::X * n as f64, DQuat::IDENTITY);
        let (stamp, mount) = (ServerTime::from_ns(1), Pose::IDENTITY);
        let image = ObservedImage {
            camera: 1,
            name: "down".into(),
            header: ImageHeader::new(n, 1, stamp, &k, &mount, &body).as_bytes().to_vec(),
            received_ns: pose_ns + 1,
            bitstream: vec![7],
            pose_ns,
            shown_ns: pose_ns + 48_000_000,
            ..ObservedImage::default()
        };
        let (protocol, published_ns) = (PROTOCOL_VERSION.into(), pose_ns + 20_000_000);
        Observation {
            seq: n,
            protocol,
            published_ns,
            images: vec![image],
            ..Observation::default()
        }
    }

    fn log(observations: &[Observation]) -> Vec<u8> {
        let mut file = Cursor::new(Vec::new());
        let mut writer = mcap::WriteOptions::new().compression(None).create(&mut file).unwrap();
        let id =
            writer.add_channel(0, "/observation", "protobuf", &std::collections::BTreeMap::new());
        let channel_id = id.unwrap();
        for observation in observations {
            let log_time = OFFSET_NS + observation.published_ns;
            let header =
                MessageHeader { channel_id, sequence: 1, log_time, publish_time: log_time };
            writer.write_to_known_channel(&header, &observation.encode_to_vec()).unwrap();
        }
        writer.finish().unwrap();
        drop(writer);
        file.into_inner()
    }

    fn read(bytes: Vec<u8>) -> Vec<FlightDatum> {
        let mut data = FlightData::new(LogReader::new(Cursor::new(bytes)).unwrap(), true);
        std::iter::from_fn(|| data.next().unwrap()).collect()
    }

    #[test]
    fn returns_the_instants_that_images_show() {
        let observations: Vec<_> = (1..20).map(observation).collect();
        let found = read(log(&observations));
        let images = found.iter().filter_map(|datum| match datum {
            FlightDatum::Image(image) => Some(image),
            _ => None,
        });
        for (image, n) in images.clone().zip(1..) {
            let pose_ns = OFFSET_NS + n * 33_000_000;
            assert_eq!((image.pose_ns, image.shown_ns), (pose_ns, pose_ns + 48_000_000));
            assert_eq!((image.received_ns, &*image.camera, image.seq), (pose_ns + 1, "down", n));
            assert_eq!(image.header.world_from_body().translation_m, DVec3::X * n as f64);
        }
        assert_eq!(images.count(), 19);
    }

    #[test]
    fn returns_each_reading_once_with_its_instant() {
        let observed = |n: u64, seq: u64, is_apart: bool| {
            let header = SensorHeader { seq, stamp_ns: 1_000 * seq, ..SensorHeader::default() };
            let bytes = if is_apart { Vec::new() } else { vec![seq as u8] };
            let records = ObservedRecords { sensor: 1, name: "top".into(), is_apart, bytes };
            Observation {
                sensors: [SensorHeader::default(), header].as_bytes().to_vec(),
                records: vec![records],
                images: Vec::new(),
                ..observation(n)
            }
        };
        let all = [observed(1, 4, false), observed(2, 4, false), observed(3, 5, true)];
        let found = read(log(&[&all[..], &[observed(4, 6, false)]].concat()));
        let readings = found.iter().filter_map(|datum| match datum {
            FlightDatum::Reading(reading) => Some((reading.at_ns - OFFSET_NS, &*reading.records)),
            _ => None,
        });
        let found: Vec<_> = readings.collect();
        assert_eq!(found, [(4_000, &[4][..]), (6_000, &[6])], "a reduced log omits the fifth");
    }

    #[test]
    fn reports_images_of_unsupported_protocols() {
        let foreign = Observation { protocol: 99, ..observation(1) };
        assert_eq!(read(log(&[foreign])), [FlightDatum::Foreign { protocol: 99 }]);
        let left_out = Observation { images: Vec::new(), ..observation(1) };
        assert_eq!(read(log(&[left_out]))[0], FlightDatum::LeftOut);
    }
}
