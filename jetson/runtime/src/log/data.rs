//! A flight log as data: images by the instant that they show, poses, IMU, setpoints, in the order in which they
//! were written. What `vizflyt export` writes for other people's programs.

use std::io::Read;

use glam::DVec3;
use vizflyt_protocol::geometry::{Body, Frame, Odom, Pose, World};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::sensor::{MAX_SENSORS, SensorHeader};
use zerocopy::FromBytes;

use super::channels::Channel;
use super::messages::Observation;
use super::read::{LogError, LogMessage, LogReader, Next, Recorded, RecordedFlight, pose_of};

/// Where the body was at an instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StampedPose<A: Frame> {
    /// Since 1970. [ns]
    pub at_ns: u64,
    /// The body in the frame `A`.
    pub from_body: Pose<A, Body>,
}

/// One image of a flight. Times count since 1970, on the clock of the log.
#[derive(Clone, Debug, PartialEq)]
pub struct FlightImage {
    /// Its camera's name.
    pub camera: String,
    /// The observation that it was in.
    pub seq: u64,
    /// The instant that it shows. [ns]
    pub shown_ns: u64,
    /// When the newest pose behind it was measured. [ns]
    pub pose_ns: u64,
    /// When its last byte had come. [ns]
    pub received_ns: u64,
    /// Camera, lens, mounting, and where it was rendered from.
    pub header: ImageHeader,
    /// The RGB-D bitstream; empty if images are not wanted.
    pub bitstream: Vec<u8>,
}

/// The localized motion of the vehicle, and how well it is known.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FlightMotion {
    /// When it was true, since 1970. [ns]
    pub at_ns: u64,
    /// Velocity. [m/s, world]
    pub v_world_mps: DVec3,
    /// How far the position may be off, one standard deviation an axis; 0 is not known. [m, world]
    pub position_sigma_m: DVec3,
    /// How far the attitude may be off, about each axis; 0 is not known. [rad, body]
    pub rotation_sigma_rad: DVec3,
}

/// A reading of the IMU.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlightImu {
    /// When it was measured, since 1970. [ns]
    pub at_ns: u64,
    /// Specific force. [m/s^2, body]
    pub accel_mps2: DVec3,
    /// Angular velocity. [rad/s, body]
    pub gyro_radps: DVec3,
}

/// A new reading of a sensor beside the cameras.
#[derive(Clone, Debug, PartialEq)]
pub struct FlightReading {
    /// The instant that it is of, since 1970; a sweep's last. [ns]
    pub at_ns: u64,
    /// The sensor, and what else the plugin knew of the reading; its times are of the computer that flew. [ns, host]
    pub sensor: SensorHeader,
    /// As in shared memory, by the sensor's kind.
    pub records: Vec<u8>,
}

/// Something that a flight's log holds.
#[derive(Clone, Debug, PartialEq)]
#[allow(clippy::large_enum_variant)] // Why: there is one of it at a time.
pub enum FlightDatum {
    /// An image.
    Image(FlightImage),
    /// Images that a reduced log left out.
    LeftOut,
    /// A sensor's reading; only with images, which a large one lies beside.
    Reading(FlightReading),
    /// A localized pose.
    Pose(StampedPose<World>),
    /// What belongs to the pose of the same instant.
    Motion(FlightMotion),
    /// A reading of the IMU.
    Imu(FlightImu),
    /// The plugin's own estimate.
    Odometry(StampedPose<Odom>),
    /// What the plugin answered, as JSON, and when. [ns, since 1970]
    Asked(u64, Vec<u8>),
    /// What the guard let through, as JSON, and when. [ns, since 1970]
    Sent(u64, Vec<u8>),
    /// An image of a protocol whose images are not known here.
    Foreign {
        /// The protocol.
        protocol: u32,
    },
}

/// Reads them.
pub struct FlightData<R> {
    flight: RecordedFlight<R>,
    topics: [(String, Topic); 6],
    /// What came with the message before.
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
    /// Reads from `reader`; without images, theirs are empty bitstreams.
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

    /// Whether the log ended before its end; known when [`Self::next`] has returned `None`.
    pub fn is_cut(&self) -> bool {
        self.flight.is_cut()
    }

    /// Returns the next thing; `None` at the end. What does not decode is left out.
    ///
    /// # Errors
    /// As [`LogReader::next`].
    #[allow(clippy::should_implement_trait)] // Why: as `LogReader::next`.
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

    /// Takes the readings that are new in an observation.
    fn readings(&mut self, offset_ns: u64, observation: &Observation) {
        let table = observation.sensors.chunks_exact(size_of::<SensorHeader>());
        let table = table.filter_map(|bytes| SensorHeader::read_from_bytes(bytes).ok());
        for (index, (sensor, had)) in table.zip(&mut self.readings_had).enumerate() {
            // Points that are apart were not asked for, or are not in a reduced log.
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
        // From this computer's clock to time since 1970.
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
    // A topic of poses says in which frame they are.
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

    /// From the clock of the computer that flew to 1970. [ns]
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
    fn images_have_the_instants_that_they_show() {
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
    fn a_reading_comes_once_by_the_instant_that_it_is_of() {
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
        assert_eq!(found, [(4_000, &[4][..]), (6_000, &[6])], "a reduced log lacks the fifth");
    }

    #[test]
    fn images_of_a_protocol_that_is_not_known_are_said_to_be() {
        let foreign = Observation { protocol: 99, ..observation(1) };
        assert_eq!(read(log(&[foreign])), [FlightDatum::Foreign { protocol: 99 }]);
        let left_out = Observation { images: Vec::new(), ..observation(1) };
        assert_eq!(read(log(&[left_out]))[0], FlightDatum::LeftOut);
    }
}
