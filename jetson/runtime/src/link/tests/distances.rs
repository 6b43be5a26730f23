//! Readings of simulated sensors, sent to the autopilot.

use vizflyt_protocol::mavlink::dialect::MavSensorOrientation;
use vizflyt_protocol::messages::bounded;
use vizflyt_protocol::sensor::{LidarPoint, RangeReading, SensorInfo, SensorKind};
use zerocopy::IntoBytes;

use super::*;

fn sensor(kind: SensorKind) -> SensorInfo {
    SensorInfo {
        name: bounded("x"),
        kind,
        enabled: true,
        to_autopilot: true,
        rate_hz: 100.0,
        min_range_m: 0.1,
        max_range_m: 10.0,
        horizontal_fov_rad: 6.3,
        vertical_fov_rad: 0.5,
        most_records: 9,
        body_from_sensor: Pose::new(DVec3::ZERO, DQuat::from_rotation_y(90f64.to_radians())),
    }
}

#[test]
fn limits_the_rate_of_distances() {
    let mut script = Script::ready();
    let (down, scan) = (sensor(SensorKind::RangeFinder), sensor(SensorKind::Lidar));
    let range = RangeReading { range_m: 1.5, signal: 1.0 };
    let points = [LidarPoint { p_m: [0.0, 0.0, 2.0], ..LidarPoint::default() }];
    script.sent.clear();
    // One second of readings at 100 Hz, of both sensors.
    for _ in 0..100 {
        script.now = script.now.plus_seconds(0.01);
        script.link.reading(script.now, 3, &down, range.as_bytes());
        script.link.reading(script.now, 4, &scan, points.as_bytes());
        script.link.reading(script.now, 5, &sensor(SensorKind::Radar), &[0; 20]);
        script.link.reading(script.now, 200, &down, range.as_bytes());
        script.drain();
    }
    let (mut distances, mut obstacles) = (0, 0);
    for message in &script.sent {
        match message {
            MavMessage::DISTANCE_SENSOR(m) => {
                distances += 1;
                assert_eq!((m.id, m.current_distance), (3, 150));
                assert_eq!(m.orientation, MavSensorOrientation::MAV_SENSOR_ROTATION_PITCH_270);
            }
            MavMessage::OBSTACLE_DISTANCE(m) => {
                obstacles += 1;
                // The sensor's z is the body's x: forward.
                assert_eq!((m.distances[0], m.max_distance), (200, 1000));
            }
            _ => {}
        }
    }
    assert!(
        (17..=26).contains(&distances) && (8..=13).contains(&obstacles),
        "{distances} {obstacles}"
    );
}

#[test]
fn sends_nothing_without_an_autopilot_or_for_invalid_readings() {
    let mut script = Script::new();
    let range = RangeReading { range_m: 1.5, signal: 1.0 };
    script.link.reading(script.now, 0, &sensor(SensorKind::Sonar), range.as_bytes());
    script.drain();
    assert!(script.sent.iter().all(|m| !matches!(m, MavMessage::DISTANCE_SENSOR(_))));
    let mut script = Script::ready();
    script.sent.clear();
    script.link.reading(script.now, 0, &sensor(SensorKind::Sonar), &[0; 7]);
    script.drain();
    assert!(script.sent.is_empty(), "{:?}", script.sent);
}
