//! Distance readings to MAVLink: DISTANCE_SENSOR (132) for range finders and sonars, OBSTACLE_DISTANCE (330) for a
//! LiDAR.
//!
//! Orientations are rotations of a forward-right-down frame, as in ArduPilot's `Rotation`: YAW_90 faces right, PITCH_90
//! up, PITCH_270 down (ardupilot.org, "Distance sensors by MAVLink").

use glam::{DQuat, DVec3};

use super::dialect::{
    DISTANCE_SENSOR_DATA, MavDistanceSensor, MavFrame, MavSensorOrientation, OBSTACLE_DISTANCE_DATA,
};
use crate::sensor::{LidarPoint, RangeReading, SensorInfo, SensorKind};

/// Number of sectors in an OBSTACLE_DISTANCE around the vehicle.
const SECTORS: usize = 72;
/// Width of a sector. [deg]
const SECTOR_DEG: f64 = 360.0 / SECTORS as f64;
/// Maximum height difference to the sensor for an obstacle. Points beyond it are floor or ceiling. [m]
const BAND_M: f64 = 0.3;
/// Minimum alignment with a named direction. [cosine; 5 degrees]
const ALIGNED: f64 = 0.9962;

/// Returns the message for a reading of a range finder or sonar. Without a return, the distance is one centimetre above
/// the maximum range, which ArduPilot interprets as "out of range high". `id` is the number of the sensor.
///
/// ```
/// use glam::{DQuat, DVec3};
/// use vizflyt_protocol::geometry::Pose;
/// use vizflyt_protocol::mavlink::dialect::MavSensorOrientation;
/// use vizflyt_protocol::mavlink::distance_to_mavlink;
/// use vizflyt_protocol::messages::bounded;
/// use vizflyt_protocol::sensor::{RangeReading, SensorInfo, SensorKind};
/// // The sensor looks down: its x axis is the body's -z.
/// let down = SensorInfo {
///     name: bounded("down"),
///     kind: SensorKind::RangeFinder,
///     enabled: true,
///     to_autopilot: true,
///     rate_hz: 20.0,
///     min_range_m: 0.1,
///     max_range_m: 8.0,
///     horizontal_fov_rad: 0.03,
///     vertical_fov_rad: 0.03,
///     most_records: 1,
///     body_from_sensor: Pose::new(DVec3::ZERO, DQuat::from_rotation_y(90f64.to_radians())),
/// };
/// let message = distance_to_mavlink(&down, 3, RangeReading { range_m: 1.234, signal: 1.0 }, 55);
/// assert_eq!((message.current_distance, message.min_distance, message.max_distance), (123, 10, 800));
/// assert_eq!(message.orientation, MavSensorOrientation::MAV_SENSOR_ROTATION_PITCH_270);
/// ```
pub fn distance_to_mavlink(
    sensor: &SensorInfo,
    id: u8,
    reading: RangeReading,
    time_boot_ms: u32,
) -> DISTANCE_SENSOR_DATA {
    let max_distance = centimetres(sensor.max_range_m);
    let measured = reading.measured_m();
    let orientation = orientation(sensor.body_from_sensor.rotation);
    // Twice the threshold power is a good signal. 1 means an invalid signal, 0 an unknown one.
    let quality = (reading.signal * 50.0).clamp(2.0, 100.0) as u8;
    DISTANCE_SENSOR_DATA {
        time_boot_ms,
        min_distance: centimetres(sensor.min_range_m),
        max_distance,
        current_distance: measured.map_or(max_distance.saturating_add(1), centimetres),
        mavtype: sensor_type(sensor.kind),
        id,
        orientation,
        covariance: u8::MAX,
        horizontal_fov: sensor.horizontal_fov_rad,
        vertical_fov: sensor.vertical_fov_rad,
        quaternion: match orientation {
            MavSensorOrientation::MAV_SENSOR_ROTATION_CUSTOM => {
                wxyz_frd(sensor.body_from_sensor.rotation)
            }
            _ => [0.0; 4],
        },
        signal_quality: if measured.is_some() { quality } else { 0 },
    }
}

/// Returns the message for a LiDAR's scan: for each of 72 sectors, clockwise from the nose, the distance of the nearest
/// return within 0.3 m of the sensor's height. `level_from_body` is the vehicle's roll and pitch: without it, a tilted
/// scan would report the floor as an obstacle.
pub fn obstacles_to_mavlink(
    sensor: &SensorInfo,
    points: &[LidarPoint],
    level_from_body: DQuat,
    time_usec: u64,
) -> OBSTACLE_DISTANCE_DATA {
    let max_distance = centimetres(sensor.max_range_m);
    let level_from_sensor = level_from_body * sensor.body_from_sensor.rotation;
    let ahead = level_from_sensor * DVec3::X;
    let middle_deg = clockwise_deg(ahead);
    let half_deg = f64::from(sensor.horizontal_fov_rad).to_degrees() / 2.0;
    let mut distances = [u16::MAX; SECTORS];
    for (index, distance) in distances.iter_mut().enumerate() {
        let off_deg = libm::remainder(index as f64 * SECTOR_DEG - middle_deg, 360.0);
        if off_deg.abs() <= half_deg {
            *distance = max_distance.saturating_add(1);
        }
    }
    for point in points {
        let p_level = level_from_sensor * DVec3::from(point.p_m.map(f64::from));
        let range_m = libm::hypot(p_level.x, p_level.y);
        if !(p_level.z.abs() <= BAND_M && range_m >= f64::from(sensor.min_range_m)) {
            continue;
        }
        let sector = libm::round(clockwise_deg(p_level) / SECTOR_DEG) as usize % SECTORS;
        let found = centimetres(range_m as f32).min(max_distance);
        distances[sector] = distances[sector].min(found);
    }
    OBSTACLE_DISTANCE_DATA {
        time_usec,
        distances,
        min_distance: centimetres(sensor.min_range_m),
        max_distance,
        sensor_type: sensor_type(sensor.kind),
        increment: SECTOR_DEG as u8,
        increment_f: SECTOR_DEG as f32,
        angle_offset: 0.0,
        frame: MavFrame::MAV_FRAME_BODY_FRD,
    }
}

/// Returns the angle of a level vector from the nose to the right, 0 to 360. [deg]
fn clockwise_deg(v: DVec3) -> f64 {
    let left_deg = libm::atan2(v.y, v.x).to_degrees();
    if left_deg > 0.0 { 360.0 - left_deg } else { -left_deg }
}

/// Rounds to whole centimetres. NaN and negative values give 0.
fn centimetres(m: f32) -> u16 {
    libm::roundf(m * 100.0) as u16
}

fn sensor_type(kind: SensorKind) -> MavDistanceSensor {
    match kind {
        SensorKind::Lidar | SensorKind::RangeFinder => MavDistanceSensor::MAV_DISTANCE_SENSOR_LASER,
        SensorKind::Sonar => MavDistanceSensor::MAV_DISTANCE_SENSOR_ULTRASOUND,
        SensorKind::Radar => MavDistanceSensor::MAV_DISTANCE_SENSOR_RADAR,
    }
}

/// Returns MAVLink's name of the sensor's direction.
fn orientation(body_from_sensor: DQuat) -> MavSensorOrientation {
    use MavSensorOrientation as Named;
    const HALF: f64 = core::f64::consts::FRAC_1_SQRT_2;
    let named = [
        (DVec3::X, Named::MAV_SENSOR_ROTATION_NONE),
        (DVec3::new(HALF, -HALF, 0.0), Named::MAV_SENSOR_ROTATION_YAW_45),
        (DVec3::NEG_Y, Named::MAV_SENSOR_ROTATION_YAW_90),
        (DVec3::new(-HALF, -HALF, 0.0), Named::MAV_SENSOR_ROTATION_YAW_135),
        (DVec3::NEG_X, Named::MAV_SENSOR_ROTATION_YAW_180),
        (DVec3::new(-HALF, HALF, 0.0), Named::MAV_SENSOR_ROTATION_YAW_225),
        (DVec3::Y, Named::MAV_SENSOR_ROTATION_YAW_270),
        (DVec3::new(HALF, HALF, 0.0), Named::MAV_SENSOR_ROTATION_YAW_315),
        (DVec3::Z, Named::MAV_SENSOR_ROTATION_PITCH_90),
        (DVec3::NEG_Z, Named::MAV_SENSOR_ROTATION_PITCH_270),
    ];
    let ahead = body_from_sensor * DVec3::X;
    let found = named.into_iter().find(|(direction, _)| ahead.dot(*direction) > ALIGNED);
    found.map_or(Named::MAV_SENSOR_ROTATION_CUSTOM, |(_, name)| name)
}

/// Converts a rotation from forward-left-up to forward-right-down frames, w first.
fn wxyz_frd(rotation: DQuat) -> [f32; 4] {
    let [x, y, z, w] = rotation.to_array().map(|part| part as f32);
    // Avoids -0: a packet ends with its last non-zero byte.
    [w, x, 0.0 - y, 0.0 - z]
}

#[cfg(test)]
mod tests {
    extern crate std;
    use std::vec::Vec;

    use super::super::dialect::MavMessage;
    use super::super::{MAX_PACKET, MavHeader, encode};
    use super::*;
    use crate::geometry::Pose;
    use crate::messages::bounded;

    fn sensor(kind: SensorKind, yaw_deg: f64, tilt_deg: f64) -> SensorInfo {
        let rotation = DQuat::from_rotation_z(yaw_deg.to_radians())
            * DQuat::from_rotation_y(-tilt_deg.to_radians());
        SensorInfo {
            name: bounded("x"),
            kind,
            enabled: true,
            to_autopilot: true,
            rate_hz: 10.0,
            min_range_m: 0.2,
            max_range_m: 12.0,
            horizontal_fov_rad: core::f32::consts::TAU,
            vertical_fov_rad: 0.5,
            most_records: 9,
            body_from_sensor: Pose::new(DVec3::ZERO, rotation),
        }
    }

    fn at(p_m: [f32; 3]) -> LidarPoint {
        LidarPoint { p_m, ..LidarPoint::default() }
    }

    #[test]
    fn names_the_directions() {
        use MavSensorOrientation as Named;
        // VizFlyt's yaw is to the left, MAVLink's to the right.
        for (yaw_deg, tilt_deg, expected) in [
            (0.0, 0.0, Named::MAV_SENSOR_ROTATION_NONE),
            (-90.0, 0.0, Named::MAV_SENSOR_ROTATION_YAW_90),
            (90.0, 3.0, Named::MAV_SENSOR_ROTATION_YAW_270),
            (180.0, 0.0, Named::MAV_SENSOR_ROTATION_YAW_180),
            (-45.0, 0.0, Named::MAV_SENSOR_ROTATION_YAW_45),
            (30.0, 90.0, Named::MAV_SENSOR_ROTATION_PITCH_90),
            (0.0, -90.0, Named::MAV_SENSOR_ROTATION_PITCH_270),
            (0.0, -20.0, Named::MAV_SENSOR_ROTATION_CUSTOM),
        ] {
            let sensor = sensor(SensorKind::Sonar, yaw_deg, tilt_deg);
            let message = distance_to_mavlink(&sensor, 1, RangeReading::default(), 7);
            assert_eq!(message.orientation, expected, "yaw {yaw_deg}, tilt {tilt_deg}");
            assert_eq!(message.current_distance, 1201, "no return");
            assert_eq!(message.mavtype, MavDistanceSensor::MAV_DISTANCE_SENSOR_ULTRASOUND);
        }
        // 20 degrees nose-down is a pitch of -20 degrees in FRD: a rotation about y by -20.
        let [w, x, y, z] =
            wxyz_frd(sensor(SensorKind::Sonar, 0.0, -20.0).body_from_sensor.rotation);
        let half = 10f32.to_radians();
        assert!((w - half.cos()).abs() < 1e-6 && (y + half.sin()).abs() < 1e-6);
        assert!(x == 0.0 && z == 0.0);
    }

    #[test]
    fn sectors_run_clockwise_from_the_nose() {
        let lidar = sensor(SensorKind::Lidar, 0.0, 0.0);
        // Ahead, right, behind, left; the floor; below the minimum range; a more distant one ahead.
        let points = [
            at([2.0, 0.0, 0.1]),
            at([0.0, -3.0, 0.0]),
            at([-4.0, 0.0, 0.0]),
            at([0.0, 5.0, 0.0]),
            at([1.0, 1.0, -0.5]),
            at([0.1, -0.1, 0.0]),
            at([2.5, 0.0, 0.0]),
        ];
        let message = obstacles_to_mavlink(&lidar, &points, DQuat::IDENTITY, 9);
        let seen: [(usize, u16); 4] = [(0, 200), (18, 300), (36, 400), (54, 500)];
        for (sector, &distance) in message.distances.iter().enumerate() {
            let expected = seen.iter().find(|(at, _)| *at == sector);
            assert_eq!(distance, expected.map_or(1201, |(_, cm)| *cm), "sector {sector}");
        }
        assert_eq!((message.min_distance, message.max_distance, message.increment), (20, 1200, 5));
        assert_eq!(message.frame, MavFrame::MAV_FRAME_BODY_FRD);
    }

    #[test]
    fn does_not_report_the_floor_of_a_tilted_vehicle() {
        let mut lidar = sensor(SensorKind::Lidar, 0.0, 0.0);
        // Nose down by 20 degrees: the point straight ahead of the body is the floor, 1 m below.
        let level_from_body = DQuat::from_rotation_y(20f64.to_radians());
        let floor = level_from_body.inverse() * DVec3::new(2.75, 0.0, -1.0);
        let wall = level_from_body.inverse() * DVec3::new(4.0, 0.0, 0.0);
        let points = [floor, wall].map(|p| at(p.to_array().map(|part| part as f32)));
        let message = obstacles_to_mavlink(&lidar, &points, level_from_body, 9);
        assert_eq!(message.distances[0], 400);
        // Sectors outside the field of view are unknown.
        lidar.horizontal_fov_rad = 1.0;
        let message = obstacles_to_mavlink(&lidar, &[], DQuat::IDENTITY, 9);
        let known = message.distances.iter().filter(|&&cm| cm == 1201).count();
        assert_eq!((known, message.distances[36]), (11, u16::MAX));
    }
    /// Compares packets bit by bit with those of pymavlink for the same readings: `tests/clients/capture.py`.
    #[test]
    fn packets_match_those_of_pymavlink() {
        let level = DQuat::IDENTITY;
        let narrow =
            |kind, tilt_deg| SensorInfo { horizontal_fov_rad: 0.25, ..sensor(kind, 0.0, tilt_deg) };
        let down = narrow(SensorKind::RangeFinder, -90.0);
        let below = narrow(SensorKind::Sonar, -20.0);
        let reading = RangeReading { range_m: 1.23, signal: 1.0 };
        let walls = [at([2.0, 0.0, 0.0]), at([0.0, -3.0, 0.0])];
        let lidar = sensor(SensorKind::Lidar, 0.0, 0.0);
        let messages = [
            MavMessage::DISTANCE_SENSOR(distance_to_mavlink(&down, 3, reading, 55)),
            MavMessage::DISTANCE_SENSOR(distance_to_mavlink(
                &below,
                4,
                RangeReading::default(),
                56,
            )),
            MavMessage::OBSTACLE_DISTANCE(obstacles_to_mavlink(&lidar, &walls, level, 9)),
        ];
        let header = MavHeader { system_id: 1, component_id: 191, sequence: 0 };
        let mut expected = include_str!("distances.txt").lines();
        for message in messages {
            let mut buffer = [0; MAX_PACKET];
            let packet = encode(header, &message, &mut buffer);
            let line = expected.next().unwrap();
            let theirs = (0..line.len() / 2).map(|at| u8::from_str_radix(&line[2 * at..][..2], 16));
            let theirs: Vec<u8> = theirs.map(Result::unwrap).collect();
            assert_eq!(packet, theirs);
        }
        assert_eq!(expected.next(), None);
    }
}
