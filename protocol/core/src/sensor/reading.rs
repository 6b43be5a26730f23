//! Header of a sensor reading on a separate unidirectional QUIC stream. Its records follow, then the stream ends.

use glam::{DQuat, DVec3};
use zerocopy::byteorder::little_endian::{F64, U16, U32, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use super::{MAX_SENSORS, SensorKind};
use crate::PROTOCOL_VERSION;
use crate::geometry::{Body, Pose, Sensor, World};
use crate::time::ServerTime;

/// Header of a reading: sensor, time and pose. `record_count` records of the sensor's kind follow.
#[derive(
    Clone, Copy, Debug, PartialEq, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned,
)]
#[repr(C)]
pub struct ReadingHeader {
    magic: [u8; 4],
    version: U16,
    /// Index into [`crate::messages::ArenaInfo::sensors`].
    pub sensor: u8,
    kind: u8,
    /// Sequence number of this sensor's readings, from 1.
    pub seq: U64,
    /// Time at which the newest pose used for the reading was measured. [ns, server]
    pub pose_ns: U64,
    /// Time of the reading; for a sweep, its end. [ns, server]
    pub stamp_ns: U64,
    /// Body position at that time. [m, world]
    pub position_m: [F64; 3],
    /// Body-to-world rotation at that time, xyzw.
    pub rotation_xyzw: [F64; 4],
    /// Sensor position on the body. [m, body]
    pub mount_m: [F64; 3],
    /// Sensor-to-body rotation, xyzw.
    pub mount_xyzw: [F64; 4],
    /// Number of records that follow.
    pub record_count: U32,
    reserved: U32,
}

/// Reason why bytes are not a valid header of a reading.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InvalidReading {
    /// Fewer bytes than a header.
    #[error("header of a sensor's reading is cut short at {0} of {size} bytes", size = ReadingHeader::SIZE)]
    Short(usize),
    /// Wrong magic or version.
    #[error("these bytes are not a sensor reading of protocol {PROTOCOL_VERSION}")]
    Foreign,
    /// Kind that this version does not support.
    #[error("reading of sensor kind {0}, which is unknown")]
    Kind(u8),
    /// Sensor index above the maximum.
    #[error("reading of sensor {0}; there are at most {MAX_SENSORS}")]
    Sensor(u8),
    /// Number of records that the kind does not allow.
    #[error("reading of {count} records; a {kind} has at most {most}", most = kind.max_records())]
    Records {
        /// Number of records in the header.
        count: u32,
        /// Kind of the sensor.
        kind: SensorKind,
    },
    /// Invalid pose of the body or the sensor.
    #[error("reading: the pose of the body or the sensor is out of range")]
    Pose,
}

impl ReadingHeader {
    /// Size on the wire. [bytes]
    pub const SIZE: usize = size_of::<Self>();
    /// First bytes of every reading. Images start with other bytes.
    pub const MAGIC: [u8; 4] = *b"VZSR";

    /// Returns the header of a reading with `record_count` records, at the time of its pose.
    pub fn new(
        seq: u64,
        (sensor, kind): (u8, SensorKind),
        stamp: ServerTime,
        body_from_sensor: &Pose<Body, Sensor>,
        world_from_body: &Pose<World, Body>,
        record_count: u32,
    ) -> Self {
        Self {
            magic: Self::MAGIC,
            version: PROTOCOL_VERSION.into(),
            sensor,
            kind: kind as u8,
            seq: seq.into(),
            pose_ns: stamp.as_ns().into(),
            stamp_ns: stamp.as_ns().into(),
            position_m: world_from_body.translation_m.to_array().map(F64::new),
            rotation_xyzw: world_from_body.rotation.to_array().map(F64::new),
            mount_m: body_from_sensor.translation_m.to_array().map(F64::new),
            mount_xyzw: body_from_sensor.rotation.to_array().map(F64::new),
            record_count: record_count.into(),
            reserved: 0.into(),
        }
    }

    /// Reads and validates a header at the start of `bytes`. Returns it and the remaining bytes.
    ///
    /// # Errors
    /// Returns the first error found. In a valid header, [`Self::payload_len`] is bounded.
    pub fn parse(bytes: &[u8]) -> Result<(Self, &[u8]), InvalidReading> {
        let (header, rest) =
            Self::read_from_prefix(bytes).map_err(|_| InvalidReading::Short(bytes.len()))?;
        if header.magic != Self::MAGIC || header.version.get() != PROTOCOL_VERSION {
            return Err(InvalidReading::Foreign);
        }
        let kind =
            SensorKind::from_number(header.kind.into()).ok_or(InvalidReading::Kind(header.kind))?;
        if usize::from(header.sensor) >= MAX_SENSORS {
            return Err(InvalidReading::Sensor(header.sensor));
        }
        let count = header.record_count.get();
        let fits = count as usize <= kind.max_records() && (count == 1 || !kind.is_single());
        if !fits {
            return Err(InvalidReading::Records { count, kind });
        }
        if !(header.world_from_body().is_valid() && header.body_from_sensor().is_valid()) {
            return Err(InvalidReading::Pose);
        }
        Ok((header, rest))
    }

    /// Returns the kind, which is known for a parsed header.
    pub fn kind(&self) -> SensorKind {
        SensorKind::from_number(self.kind.into()).unwrap_or(SensorKind::Lidar)
    }

    /// Returns the size of its records. [bytes]
    pub fn payload_len(&self) -> usize {
        self.record_count.get() as usize * self.kind().record_len()
    }

    /// Returns the pose of the body at the time of the reading.
    pub fn world_from_body(&self) -> Pose<World, Body> {
        Pose::new(
            DVec3::from_array(self.position_m.map(F64::get)),
            DQuat::from_array(self.rotation_xyzw.map(F64::get)),
        )
    }

    /// Returns the pose of the sensor on the body.
    pub fn body_from_sensor(&self) -> Pose<Body, Sensor> {
        Pose::new(
            DVec3::from_array(self.mount_m.map(F64::get)),
            DQuat::from_array(self.mount_xyzw.map(F64::get)),
        )
    }

    /// Returns the stamp of the pose.
    pub fn pose_stamp(&self) -> ServerTime {
        ServerTime::from_ns(self.pose_ns.get())
    }

    /// Returns the time of the reading.
    pub fn stamp(&self) -> ServerTime {
        ServerTime::from_ns(self.stamp_ns.get())
    }
}

// The layout is an interface between both ends.
const _: () = assert!(ReadingHeader::SIZE == 152);

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn header(kind: SensorKind, count: u32) -> ReadingHeader {
        let mount = Pose::new(DVec3::X, DQuat::from_rotation_y(0.5));
        let body = Pose::new(DVec3::Z, DQuat::from_rotation_z(0.5));
        ReadingHeader::new(7, (2, kind), ServerTime::from_ns(9), &mount, &body, count)
    }

    #[test]
    fn rejects_invalid_headers() {
        let check = |change: &dyn Fn(&mut ReadingHeader), expected| {
            let mut h = header(SensorKind::Lidar, 5);
            change(&mut h);
            assert_eq!(ReadingHeader::parse(h.as_bytes()).unwrap_err(), expected);
        };
        check(&|h| h.kind = 0, InvalidReading::Kind(0));
        check(&|h| h.sensor = 8, InvalidReading::Sensor(8));
        check(&|h| h.version = 12.into(), InvalidReading::Foreign);
        check(&|h| h.magic = *b"VZIM", InvalidReading::Foreign);
        check(&|h| h.mount_xyzw = [0.0; 4].map(F64::new), InvalidReading::Pose);
        check(&|h| h.position_m[1] = F64::new(f64::NAN), InvalidReading::Pose);
        let kind = SensorKind::Lidar;
        let records = InvalidReading::Records { count: u32::MAX, kind };
        check(&|h| h.record_count = u32::MAX.into(), records);
        let kind = SensorKind::Sonar;
        for count in [0, 2] {
            let found = ReadingHeader::parse(header(kind, count).as_bytes()).unwrap_err();
            assert_eq!(found, InvalidReading::Records { count, kind });
        }
        assert_eq!(ReadingHeader::parse(&[0; 9]), Err(InvalidReading::Short(9)));
    }

    proptest! {
        #[test]
        fn headers_survive_the_wire(
            seq: u64, sensor in 0..MAX_SENSORS as u8, stamp: u64, pose: u64, count in 0u32..1000, kind in 0usize..4,
        ) {
            let kind = SensorKind::ALL[kind];
            let mut sent = header(kind, count);
            (sent.seq, sent.sensor) = (seq.into(), sensor);
            (sent.stamp_ns, sent.pose_ns) = (stamp.into(), pose.into());
            match ReadingHeader::parse(sent.as_bytes()) {
                Ok((found, rest)) => {
                    prop_assert!(found == sent && rest.is_empty() && found.kind() == kind);
                    prop_assert_eq!(found.payload_len(), count as usize * kind.record_len());
                }
                Err(error) => {
                    prop_assert_eq!(error, InvalidReading::Records { count, kind });
                    prop_assert!(kind.is_single() && count != 1 || count as usize > kind.max_records());
                }
            }
        }

        #[test]
        fn any_bytes_parse_or_fail_cleanly(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            if let Ok((header, _)) = ReadingHeader::parse(&bytes) {
                prop_assert!(header.payload_len() <= 4 << 20);
            }
        }
    }
}
