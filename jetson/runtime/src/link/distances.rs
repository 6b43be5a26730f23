//! Sends distances of simulated sensors to the autopilot, at rates that its link can carry.

use vizflyt_protocol::geometry::yaw_of;
use vizflyt_protocol::mavlink::dialect::MavMessage;
use vizflyt_protocol::mavlink::{distance_to_mavlink, obstacles_to_mavlink};
use vizflyt_protocol::sensor::{LidarPoint, MAX_SENSORS, RangeReading, SensorInfo, SensorKind};
use vizflyt_protocol::time::HostTime;
use vizflyt_sdk::glam::DQuat;
use zerocopy::FromBytes;

use super::Link;

/// Minimum period of a sensor's messages: 20 Hz, the rate at which ArduPilot reads its range finders. [s]
const DISTANCE_S: f64 = 0.05;
/// As [`DISTANCE_S`], for a message of 167 bytes: 10 Hz. [s]
const OBSTACLES_S: f64 = 0.1;
/// A reading may be early by this share of the period, because of jitter.
const EARLY: f64 = 0.2;

/// Time of each sensor's next message.
pub(super) type Due = [HostTime; MAX_SENSORS];

impl Link {
    /// Sends a reading of sensor `index` as DISTANCE_SENSOR or OBSTACLE_DISTANCE, unless the last message was too
    /// recent. Detections of a radar are not sent.
    pub fn reading(&mut self, now: HostTime, index: u8, sensor: &SensorInfo, records: &[u8]) {
        let Some(due) = self.distances_due.get(usize::from(index)).copied() else { return };
        if self.autopilot.is_none() || now < due {
            return;
        }
        let (message, period_s) = match sensor.kind {
            SensorKind::RangeFinder | SensorKind::Sonar => {
                let Ok(reading) = RangeReading::read_from_bytes(records) else { return };
                let time_boot_ms = (now.as_ns() / 1_000_000) as u32;
                let message = distance_to_mavlink(sensor, index, reading, time_boot_ms);
                (MavMessage::DISTANCE_SENSOR(message), DISTANCE_S)
            }
            SensorKind::Lidar => {
                let points: Vec<LidarPoint> = records
                    .as_chunks::<{ size_of::<LidarPoint>() }>()
                    .0
                    .iter()
                    .filter_map(|bytes| LidarPoint::read_from_bytes(bytes).ok())
                    .collect();
                let world_from_body = self.state.world_from_body;
                let level_from_body =
                    DQuat::from_rotation_z(-yaw_of(world_from_body)) * world_from_body;
                let usec = now.as_ns() / 1000;
                let message = obstacles_to_mavlink(sensor, &points, level_from_body, usec);
                (MavMessage::OBSTACLE_DISTANCE(message), OBSTACLES_S)
            }
            SensorKind::Radar => return,
        };
        self.distances_due[usize::from(index)] = now.plus_seconds((1.0 - EARLY) * period_s);
        self.send(now, &message);
    }
}
