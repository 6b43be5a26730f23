//! Sensor section of an observation in shared memory, after the cameras' planes: a table of [`SensorHeader`]s, then the
//! records of each sensor, aligned to 64 bytes. An observation without sensors has no such section.

use glam::{DQuat, DVec3};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

use super::records::{LidarPoint, RadarDetection, RangeReading};
use super::{MAX_SENSORS, SensorKind};
use crate::geometry::{Body, Pose, Sensor, World};
use crate::packet::PLANE_ALIGN;

/// Maximum length of a sensor's name. [bytes]
const NAME: usize = 32;

/// Sensor of an observation, with its newest reading.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, KnownLayout, Immutable)]
#[repr(C)]
pub struct SensorHeader {
    /// Sequence number of this sensor's readings, from 1; 0 before the first. The same number means the same reading.
    pub seq: u64,
    /// Time at which the newest pose used for the reading was measured. [ns, host]
    pub pose_ns: u64,
    /// Time of the reading; for a sweep, its end. [ns, host]
    pub stamp_ns: u64,
    /// Time at which the runtime received it. [ns, host]
    pub ready_ns: u64,
    /// Sensor position on the body. [m, body]
    pub translation_m: [f64; 3],
    /// Sensor-to-body rotation, xyzw.
    pub rotation_xyzw: [f64; 4],
    /// Position of the body at that time; zero if the course withholds it. [m, world]
    pub body_position_m: [f64; 3],
    /// Body-to-world rotation at that time, xyzw; zero if the course withholds it.
    pub body_rotation_xyzw: [f64; 4],
    /// Number of the [`SensorKind`].
    pub kind: u32,
    /// Number of records in the reading.
    pub record_count: u32,
    /// Offset of the records from the start of the observation. [bytes]
    pub records_offset: u32,
    /// Always zero.
    pub reserved: u32,
    /// Name, padded with zeros.
    pub name: [u8; NAME],
}

// The layout is an interface to other languages and processes.
const _: () = assert!(size_of::<SensorHeader>() == 192);

/// Records of a reading, by kind.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Records<'a> {
    /// Records of [`SensorKind::Lidar`].
    Lidar(&'a [LidarPoint]),
    /// Reading of [`SensorKind::RangeFinder`] or [`SensorKind::Sonar`].
    Range(RangeReading),
    /// Records of [`SensorKind::Radar`].
    Radar(&'a [RadarDetection]),
}

impl SensorHeader {
    /// Returns the kind, which is known in a validated observation.
    pub fn kind(&self) -> Option<SensorKind> {
        SensorKind::from_number(self.kind)
    }

    /// Returns the name; empty if the bytes are not valid UTF-8.
    pub fn name(&self) -> &str {
        let len = self.name.iter().position(|&byte| byte == 0).unwrap_or(NAME);
        core::str::from_utf8(&self.name[..len]).unwrap_or_default()
    }

    /// Writes the name, truncated to 32 bytes.
    pub fn set_name(&mut self, name: &str) {
        self.name = [0; NAME];
        for (to, from) in self.name.iter_mut().zip(name.bytes()) {
            *to = from;
        }
    }

    /// Returns the pose of the sensor on the body.
    pub fn body_from_sensor(&self) -> Pose<Body, Sensor> {
        Pose::new(DVec3::from(self.translation_m), DQuat::from_array(self.rotation_xyzw))
    }

    /// Returns the pose of the body at the time of the reading, if the course allows it.
    pub fn pose_at_reading(&self) -> Option<Pose<World, Body>> {
        let rotation = DQuat::from_array(self.body_rotation_xyzw);
        Some(Pose::new(DVec3::from(self.body_position_m), rotation)).filter(Pose::is_valid)
    }

    /// Returns the records in the observation's memory; `None` without a reading or if they lie outside the memory.
    pub fn records<'a>(&self, observation: &'a [u8]) -> Option<Records<'a>> {
        let kind = self.kind().filter(|_| self.seq > 0)?;
        let len = (self.record_count as usize).checked_mul(kind.record_len())?;
        let at = self.records_offset as usize;
        let bytes = observation.get(at..at.checked_add(len)?)?;
        Some(match kind {
            SensorKind::Lidar => Records::Lidar(<[LidarPoint]>::ref_from_bytes(bytes).ok()?),
            SensorKind::RangeFinder | SensorKind::Sonar => {
                Records::Range(RangeReading::read_from_bytes(bytes).ok()?)
            }
            SensorKind::Radar => Records::Radar(<[RadarDetection]>::ref_from_bytes(bytes).ok()?),
        })
    }
}

/// Returns the size of the sensor section for readings with these record sizes. [bytes]
pub fn section_len(records: impl IntoIterator<Item = usize>) -> usize {
    let (count, bytes) =
        records.into_iter().fold((0, 0), |(count, bytes), len| (count + 1, bytes + align(len)));
    if count == 0 { 0 } else { align(count * size_of::<SensorHeader>()) + bytes }
}

/// Returns the offset of the first records in a section with this number of sensors. [bytes]
pub fn records_begin(sensors: usize) -> usize {
    align(sensors * size_of::<SensorHeader>())
}

/// Rounds up to the next 64-byte boundary.
pub const fn align(offset: usize) -> usize {
    offset.next_multiple_of(PLANE_ALIGN)
}

/// Returns the table of sensors at `offset`, if the table and all its readings lie within `observation`. Otherwise
/// returns the index of the first invalid sensor.
pub(crate) fn parse(observation: &[u8], offset: u32, count: u32) -> Result<&[SensorHeader], usize> {
    let count = count as usize;
    if count == 0 {
        return Ok(&[]);
    }
    let table = observation.get(offset as usize..).filter(|_| count <= MAX_SENSORS);
    let (table, _) = table
        .and_then(|bytes| <[SensorHeader]>::ref_from_prefix_with_elems(bytes, count).ok())
        .ok_or(0_usize)?;
    for (index, sensor) in table.iter().enumerate() {
        let kind = sensor.kind().ok_or(index)?;
        let most = sensor.record_count as usize <= kind.max_records();
        let single = !kind.is_single() || sensor.record_count == 1 || sensor.seq == 0;
        if !(most && single) || sensor.seq > 0 && sensor.records(observation).is_none() {
            return Err(index);
        }
    }
    Ok(table)
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use proptest::prelude::*;

    #[repr(align(64))]
    struct Aligned([u8; 1024]);

    fn section() -> Aligned {
        let mut memory = Aligned([0; 1024]);
        let mut table = [SensorHeader { seq: 3, ..SensorHeader::default() }; 2];
        (table[0].kind, table[0].record_count, table[0].records_offset) = (1, 2, 448);
        (table[1].kind, table[1].record_count, table[1].records_offset) = (3, 1, 512);
        table[1].set_name("down");
        memory.0[64..448].copy_from_slice(table.as_bytes());
        let points = [LidarPoint { ring: 1, ..LidarPoint::default() }; 2];
        memory.0[448..488].copy_from_slice(points.as_bytes());
        let range = RangeReading { range_m: 1.5, signal: 0.5 };
        memory.0[512..520].copy_from_slice(range.as_bytes());
        memory
    }

    #[test]
    fn reads_a_valid_section() {
        let memory = section();
        let table = parse(&memory.0, 64, 2).unwrap();
        assert_eq!((table[0].name(), table[1].name()), ("", "down"));
        let Some(Records::Lidar(points)) = table[0].records(&memory.0) else { panic!() };
        assert_eq!((points.len(), points[1].ring), (2, 1));
        let Some(Records::Range(range)) = table[1].records(&memory.0) else { panic!() };
        assert_eq!(range.measured_m(), Some(1.5));
        assert_eq!(table[1].pose_at_reading(), None, "withheld");
        assert_eq!(RangeReading::default().measured_m(), None);
        assert_eq!((section_len([]), section_len([40, 8])), (0, 384 + 64 + 64));
    }

    #[test]
    fn rejects_records_outside_the_memory() {
        let memory = section();
        assert_eq!(parse(&memory.0, 1024, 1), Err(0));
        assert_eq!(parse(&memory.0, 64, 9), Err(0), "more than there may be");
        assert_eq!(parse(&memory.0, 65, 2), Err(0), "misaligned");
        let with = |index: usize, change: &dyn Fn(&mut SensorHeader)| {
            let mut memory = section();
            let at = 64 + 192 * index;
            change(SensorHeader::mut_from_bytes(&mut memory.0[at..at + 192]).unwrap());
            parse(&memory.0, 64, 2).map(<[_]>::len)
        };
        assert_eq!(with(1, &|s| s.record_count = 2), Err(1));
        assert_eq!(with(1, &|s| s.records_offset = 1020), Err(1));
        assert_eq!(with(0, &|s| s.record_count = u32::MAX), Err(0));
        assert_eq!(with(0, &|s| s.records_offset = 449), Err(0), "misaligned records");
        assert_eq!(with(0, &|s| s.kind = 99), Err(0));
        assert_eq!(with(0, &|s| (s.seq, s.records_offset) = (0, 9999)), Ok(2), "no reading yet");
    }

    proptest! {
        #[test]
        fn invalid_tables_are_never_read_outside_the_memory(at in 64usize..448, value: u8) {
            let mut memory = section();
            memory.0[at] = value;
            for sensor in parse(&memory.0, 64, 2).into_iter().flatten() {
                let _ = (sensor.name(), sensor.records(&memory.0));
            }
        }
    }
}
