//! Readings of sensors other than cameras: sweeps of a LiDAR as PCD files (the format of the Point Cloud Library, which
//! Open3D and CloudCompare read), and a table for each other sensor.
//!
//! ```text
//! NAME/sensor.yaml   kind and pose in the body, in EuRoC's format
//! NAME/data.csv      LiDAR: times and files; range finder or sonar: distances; radar: one row per detection
//! NAME/data/NS.pcd   one sweep: x y z before_ns intensity ring, in the sensor's axes
//! ```
//! `NS` is the time of a reading since 1970.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;

use anyhow::{Context, Result};
use vizflyt_protocol::sensor::records::{LidarPoint, RadarDetection, RangeReading};
use vizflyt_protocol::sensor::{SensorHeader, SensorKind};
use vizflyt_runtime::log::data::{FlightData, FlightDatum, FlightReading};
use vizflyt_runtime::log::read::LogReader;
use zerocopy::FromBytes;

use super::euroc::{rate_hz, transform};
use super::files::Folder;
use super::table::file_name;
use super::{context, write_text};

/// Readings of a sensor.
struct Measured {
    header: SensorHeader,
    stamps: Vec<u64>,
    csv: String,
}

/// Writes the readings of a log below `above`, in a folder for each sensor. Returns the number of readings.
pub(super) fn write(folder: &Folder, log: &Path, above: &str) -> Result<usize> {
    let name = || format!("cannot read {}", log.display());
    let mut data = FlightData::new(LogReader::open(log).with_context(name)?, true);
    let mut sensors: BTreeMap<String, Measured> = BTreeMap::new();
    while let Some(datum) = data.next().with_context(name)? {
        let FlightDatum::Reading(reading) = datum else { continue };
        let Some(kind) = reading.sensor.kind() else { continue };
        let sensor = file_name(reading.sensor.name());
        let measured = sensors.entry(sensor.clone()).or_insert_with(|| Measured {
            header: reading.sensor,
            stamps: Vec::new(),
            csv: head(kind).to_owned(),
        });
        let at_ns = reading.at_ns;
        if kind == SensorKind::Lidar {
            let path = folder.at(&format!("{above}{sensor}/data/{at_ns}.pcd"))?;
            std::fs::write(&path, pcd(&reading.records)).with_context(context(&path))?;
        }
        measured.csv.push_str(&rows(kind, &reading));
        measured.stamps.push(at_ns);
    }
    for (sensor, Measured { header, stamps, csv }) in &sensors {
        write_text(&folder.at(&format!("{above}{sensor}/data.csv"))?, csv)?;
        let kind = header.kind().map(SensorKind::name).unwrap_or_default();
        let yaml = format!(
            "sensor_type: {kind}\ncomment: {}\n{}rate_hz: {:.3}\n",
            header.name(),
            transform(&header.body_from_sensor()),
            rate_hz(stamps)
        );
        write_text(&folder.at(&format!("{above}{sensor}/sensor.yaml"))?, &yaml)?;
    }
    Ok(sensors.values().map(|measured| measured.stamps.len()).sum())
}

fn head(kind: SensorKind) -> &'static str {
    match kind {
        SensorKind::Lidar => "#timestamp [ns],filename\n",
        SensorKind::RangeFinder | SensorKind::Sonar => "#timestamp [ns],range [m],signal []\n",
        SensorKind::Radar => {
            "#timestamp [ns],range [m],azimuth [rad],radial velocity [m s^-1],snr [dB],cross section [m^2]\n"
        }
    }
}

/// Returns the rows of a reading. A radar without detections has none. A beam without a return has an empty range.
fn rows(kind: SensorKind, reading: &FlightReading) -> String {
    let at_ns = reading.at_ns;
    let mut text = String::new();
    match kind {
        SensorKind::Lidar => {
            let _ = writeln!(text, "{at_ns},{at_ns}.pcd");
        }
        SensorKind::RangeFinder | SensorKind::Sonar => {
            if let Ok(range) = RangeReading::read_from_bytes(&reading.records) {
                let range_m = range.measured_m().map(|range_m| range_m.to_string());
                let _ = writeln!(text, "{at_ns},{},{}", range_m.unwrap_or_default(), range.signal);
            }
        }
        SensorKind::Radar => {
            let detections = reading.records.chunks_exact(size_of::<RadarDetection>());
            for one in detections.filter_map(|bytes| RadarDetection::read_from_bytes(bytes).ok()) {
                let RadarDetection { range_m, azimuth_rad, radial_mps, snr_db, cross_section_m2 } =
                    one;
                let _ = writeln!(
                    text,
                    "{at_ns},{range_m},{azimuth_rad},{radial_mps},{snr_db},{cross_section_m2}"
                );
            }
        }
    }
    text
}

/// Returns points as a PCD file (pointclouds.org, "The PCD file format", 0.7). Its binary form has the memory layout of
/// the records.
fn pcd(records: &[u8]) -> Vec<u8> {
    let points = records.len() / size_of::<LidarPoint>();
    let head = format!(
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z before_ns intensity ring\n\
         SIZE 4 4 4 4 2 2\nTYPE F F F U U U\nCOUNT 1 1 1 1 1 1\nWIDTH {points}\nHEIGHT 1\n\
         VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA binary\n"
    );
    let mut bytes = head.into_bytes();
    bytes.extend_from_slice(&records[..points * size_of::<LidarPoint>()]);
    bytes
}

#[cfg(test)]
mod tests {
    use zerocopy::IntoBytes;

    use super::*;

    fn reading(records: &[u8]) -> FlightReading {
        FlightReading { at_ns: 5, sensor: SensorHeader::default(), records: records.to_vec() }
    }

    #[test]
    fn missing_returns_have_no_range() {
        let far = RangeReading { range_m: 2.5, signal: 3.0 };
        assert_eq!(rows(SensorKind::Sonar, &reading(far.as_bytes())), "5,2.5,3\n");
        let nothing = RangeReading::default();
        assert_eq!(rows(SensorKind::RangeFinder, &reading(nothing.as_bytes())), "5,,0\n");
        assert_eq!(rows(SensorKind::RangeFinder, &reading(&[1])), "");
        let two = [RadarDetection { range_m: 1.0, ..RadarDetection::default() }; 2];
        assert_eq!(rows(SensorKind::Radar, &reading(two.as_bytes())), "5,1,0,0,0,0\n".repeat(2));
        assert_eq!(rows(SensorKind::Radar, &reading(&[])), "");
    }

    #[test]
    fn writes_a_sweep_as_header_and_raw_records() {
        let points = [LidarPoint { p_m: [1.0, 2.0, 3.0], ring: 7, ..LidarPoint::default() }; 3];
        let file = pcd(points.as_bytes());
        let head = file.len() - points.as_bytes().len();
        assert_eq!(&file[head..], points.as_bytes());
        let text = std::str::from_utf8(&file[..head]).unwrap();
        assert!(text.contains("\nPOINTS 3\n") && text.ends_with("DATA binary\n"), "{text}");
    }
}
