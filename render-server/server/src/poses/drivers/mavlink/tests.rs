use super::*;
use crate::poses::drivers::lost_poses;
use proptest::prelude::*;
use vizflyt_arena::pose::Rejected;
use vizflyt_protocol::mavlink::dialect::{
    HEARTBEAT_DATA, LOCAL_POSITION_NED_DATA, MavAutopilot, MavType,
};
use vizflyt_protocol::mavlink::{
    attitude_to_mavlink, local_position_to_mavlink, ned_rotation_from_world,
};

fn at(ms: u64) -> ServerTime {
    ServerTime::from_ns(1_000_000_000 + ms * 1_000_000)
}

fn stream(settings: &str, vehicles: &[&str]) -> MavlinkStream {
    let config = LocalizationConfig::parse(&format!("mavlink:127.0.0.1:0,{settings}")).unwrap();
    MavlinkStream::new(&config, 1, vehicles)
}

fn packet(system_id: u8, message: &MavMessage) -> Vec<u8> {
    let header = MavHeader { system_id: system_id.into(), component_id: 1, sequence: 0 };
    encode(header, message, &mut [0; MAX_PACKET]).to_vec()
}

fn position(system: u8, boot_ms: u32, p_world_m: DVec3) -> Vec<u8> {
    let message = local_position_to_mavlink(p_world_m, DVec3::ZERO, boot_ms);
    packet(system, &MavMessage::LOCAL_POSITION_NED(message))
}

fn quaternion(system: u8, boot_ms: u32, rotation: DQuat, yaw_rate_radps: f32) -> Vec<u8> {
    let [x, y, z, w] = ned_rotation_from_world(rotation).to_array().map(|v| v as f32);
    packet(
        system,
        &MavMessage::ATTITUDE_QUATERNION(ATTITUDE_QUATERNION_DATA {
            time_boot_ms: boot_ms,
            q1: w,
            q2: x,
            q3: y,
            q4: z,
            yawspeed: yaw_rate_radps,
            ..ATTITUDE_QUATERNION_DATA::default()
        }),
    )
}

#[test]
fn extrapolates_the_attitude_to_the_positions_time() {
    let mut s = stream("", &["vizflyt"]);
    let (p, q) = (DVec3::new(1.0, 2.0, 0.5), DQuat::from_rotation_z(0.7));
    assert_eq!(s.handle_packet(at(0), &position(1, 5000, p)), [], "no attitude yet");
    // FRD turns to the right are positive.
    assert_eq!(s.handle_packet(at(10), &quaternion(1, 5010, q, -1.0)), []);
    let found = s.handle_packet(at(20), &position(1, 5020, p))[0];
    assert_eq!((found.source, found.stamp), (1, at(20)));
    assert!((found.world_from_body.translation_m - p).length() < 1e-6);
    let yaw_rad = found.world_from_body.rotation.to_scaled_axis().z;
    assert!((yaw_rad - 0.71).abs() < 1e-6, "{yaw_rad}");
    assert_eq!(s.handle_packet(at(21), &position(1, 5020, p)), [], "twice");
    assert_eq!(s.handle_packet(at(300), &position(1, 5300, p)), [], "the attitude is too old");
    let euler = attitude_to_mavlink(q, DVec3::ZERO, 5310);
    s.handle_packet(at(310), &packet(1, &MavMessage::ATTITUDE(euler)));
    assert_eq!(s.handle_packet(at(320), &position(1, 5320, p)).len(), 1);
}

#[test]
fn prefers_odometry_with_its_covariance() {
    let mut s = stream("", &["vizflyt"]);
    let mut message = ODOMETRY_DATA {
        time_usec: 7_000_000,
        frame_id: MavFrame::MAV_FRAME_LOCAL_NED,
        x: 2.0,
        y: 1.0,
        z: -3.0,
        q: [1.0, 0.0, 0.0, 0.0],
        ..ODOMETRY_DATA::default()
    };
    for (index, variance) in [(0, 0.01), (6, 0.04), (11, 0.09), (15, 1e-4), (18, 4e-4), (20, 9e-4)]
    {
        message.pose_covariance[index] = variance;
    }
    let found = s.handle_packet(at(5), &packet(1, &MavMessage::ODOMETRY(message.clone())))[0];
    assert_eq!(found.world_from_body.translation_m, DVec3::new(1.0, 2.0, 3.0));
    // Nose to the north: y.
    assert!((found.world_from_body.rotate(DVec3::X) - DVec3::Y).length() < 1e-6);
    let sigma = found.sigma.unwrap();
    assert!((sigma.position_m - DVec3::new(0.2, 0.1, 0.3)).length() < 1e-6, "{sigma:?}");
    s.handle_packet(at(6), &quaternion(1, 7001, DQuat::IDENTITY, 0.0));
    assert_eq!(s.handle_packet(at(7), &position(1, 7002, DVec3::ZERO)), []);
    let other = ODOMETRY_DATA { frame_id: MavFrame::MAV_FRAME_BODY_FRD, ..message };
    assert_eq!(s.handle_packet(at(8), &packet(1, &MavMessage::ODOMETRY(other))), []);
    assert!(s.next_warning().unwrap().contains("only MAV_FRAME_LOCAL_NED is known"));
}

#[test]
fn distinguishes_systems_and_requests_their_messages() {
    let mut s = stream("objects.ant=1,objects.bee=2", &["ant", "bee"]);
    let from = "10.0.0.9:14550".parse().unwrap();
    assert_eq!(s.poll_transmit(at(0)), None);
    s.handle_packet_from(at(1), from, &quaternion(2, 5, DQuat::IDENTITY, 0.0));
    let found = s.handle_packet_from(at(2), from, &position(2, 6, DVec3::X))[0];
    assert_eq!(found.vehicle, 1);
    let mut asked = Vec::new();
    while let Some((to, bytes)) = s.poll_transmit(at(3)) {
        assert_eq!(to, from);
        StreamDecoder::default().push(&bytes, |packet| {
            if let MavMessage::COMMAND_LONG(command) = packet.message {
                asked.push((command.target_system, command.param1, command.param2));
            }
        });
    }
    assert_eq!(asked, [(2, 32.0, 20_000.0), (2, 31.0, 20_000.0)]);
    // A system that is not configured.
    let heartbeat = packet(9, &beat(MavType::MAV_TYPE_QUADROTOR));
    let mut s = stream("objects.ant=1", &["ant", "bee"]);
    s.handle_packet(at(1), &heartbeat);
    let warning = s.next_warning().unwrap();
    assert!(warning.contains("object '9' streams, but '1', 'bee' was asked for"), "{warning}");
    s.handle_packet(at(1), b"hello");
    assert!(s.next_warning().unwrap().contains("5 bytes contain no MAVLink packet"));
}

fn beat(mavtype: MavType) -> MavMessage {
    let autopilot = MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA;
    MavMessage::HEARTBEAT(HEARTBEAT_DATA { mavtype, autopilot, ..HEARTBEAT_DATA::default() })
}

#[test]
fn ignores_poses_of_other_vehicles() {
    let mut s = stream("", &["v"]);
    let from = "10.0.0.9:14550".parse().unwrap();
    s.handle_packet_from(at(0), from, &packet(3, &beat(MavType::MAV_TYPE_GROUND_ROVER)));
    let warning = s.next_warning().unwrap();
    assert!(warning.contains("system 3 is a rover, not a multirotor"), "{warning}");
    s.handle_packet_from(at(1), from, &quaternion(3, 1, DQuat::IDENTITY, 0.0));
    assert_eq!(s.handle_packet_from(at(2), from, &position(3, 2, DVec3::X)), []);
    assert_eq!((s.poll_transmit(at(3)), s.next_warning()), (None, None));
    s.handle_packet(at(4), &packet(1, &beat(MavType::MAV_TYPE_HEXAROTOR)));
    s.handle_packet(at(5), &quaternion(1, 4, DQuat::IDENTITY, 0.0));
    assert_eq!(s.handle_packet(at(6), &position(1, 5, DVec3::X)).len(), 1);
}

#[test]
fn heartbeats_of_a_stranger_do_not_stop_the_poses() {
    let mut s = stream("", &["v"]);
    let [ours, stranger] =
        ["10.0.0.1:14550", "10.0.0.2:14550"].map(|address| address.parse().unwrap());
    let pose = |s: &mut MavlinkStream, ms: u32| {
        let turn = DQuat::from_rotation_z(f64::from(ms) * 1e-3);
        s.handle_packet_from(at(ms.into()), ours, &quaternion(1, ms, turn, 0.0));
        s.handle_packet_from(at(ms.into()), ours, &position(1, ms, DVec3::X)).len()
    };
    assert_eq!(pose(&mut s, 10), 1);
    let rover = packet(1, &beat(MavType::MAV_TYPE_GROUND_ROVER));
    s.handle_packet_from(at(15), stranger, &rover);
    assert_eq!((pose(&mut s, 20), s.next_warning()), (1, None));
    assert_eq!(s.poll_transmit(at(21)).unwrap().0, ours);
    // The autopilot's address has changed: its poses must be requested there.
    let copter = packet(1, &beat(MavType::MAV_TYPE_QUADROTOR));
    s.handle_packet_from(at(9000), stranger, &copter);
    assert_eq!(s.poll_transmit(at(9001)).unwrap().0, stranger);
}

#[test]
fn invalid_estimates_are_rejected() {
    let mut s = stream("", &["v"]);
    s.handle_packet(at(0), &quaternion(1, 10, DQuat::IDENTITY, 0.0));
    let nan = LOCAL_POSITION_NED_DATA { time_boot_ms: 20, x: f32::NAN, ..Default::default() };
    assert_eq!(s.handle_packet(at(1), &packet(1, &MavMessage::LOCAL_POSITION_NED(nan))), []);
    assert!(s.next_warning().unwrap().contains("has the autopilot an estimate yet?"));
}

proptest! {
    #[test]
    fn any_bytes_parse_or_fail_cleanly(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
        for found in stream("", &["v"]).handle_packet(at(0), &bytes) {
            prop_assert!(found.world_from_body.is_valid());
        }
    }

    #[test]
    fn returned_poses_are_valid(values in prop::array::uniform7(any::<f32>()), rate in any::<f32>(), apart in any::<i16>()) {
        let mut s = stream("", &["v"]);
        let [w, x, y, z, a, b, c] = values;
        s.handle_packet(at(0), &packet(1, &MavMessage::ATTITUDE_QUATERNION(ATTITUDE_QUATERNION_DATA {
            time_boot_ms: 50_000, q1: w, q2: x, q3: y, q4: z, rollspeed: rate, ..Default::default()
        })));
        s.handle_packet(at(0), &quaternion(1, 50_000, DQuat::IDENTITY, rate));
        let boot_ms = 50_000u32.wrapping_add_signed(i32::from(apart));
        let p = LOCAL_POSITION_NED_DATA { time_boot_ms: boot_ms, x: a, y: b, z: c, ..Default::default() };
        for found in s.handle_packet(at(1), &packet(1, &MavMessage::LOCAL_POSITION_NED(p))) {
            prop_assert!(found.world_from_body.is_valid());
        }
    }
}

fn hovering(index: u32, p_m: DVec3) -> Vec<u8> {
    let boot_ms = 5000 + 20 * index;
    // The attitude is of the gyroscope, which does not stand still.
    let turned = DQuat::from_rotation_z(0.3 + 1e-3 * f64::from(index % 11));
    [quaternion(1, boot_ms, turned, 0.1), position(1, boot_ms, p_m)].concat()
}

#[test]
fn estimates_without_measurements_are_missing() {
    let reason = |origin| lost_poses::reason_of(origin, &mut stream("", &["vizflyt"]), hovering);
    assert!(matches!(reason(false), Some(Rejected::Repeated(_))));
    assert_eq!(reason(true), Some(Rejected::NotVisible));
}

#[test]
fn stream_of_a_vehicle_has_one_sender() {
    lost_poses::check_second_sender(&mut stream("", &["vizflyt"]), hovering);
}

#[test]
fn names_the_unit_of_stamps() {
    let mut s = stream("", &["vizflyt"]);
    let mut warnings = Vec::new();
    for index in 0..300u64 {
        let odometry = ODOMETRY_DATA {
            // Nanoseconds.
            time_usec: 1_800_000_000_000_000_000 + index * 10_000_000,
            frame_id: MavFrame::MAV_FRAME_LOCAL_NED,
            q: [1.0, 0.0, 0.0, 0.0],
            z: index as f32 * 1e-3,
            ..ODOMETRY_DATA::default()
        };
        s.handle_packet(at(10 * index), &packet(1, &MavMessage::ODOMETRY(odometry)));
        warnings.extend(std::iter::from_fn(|| s.next_warning()));
    }
    let [warning] = &warnings[..] else { panic!("{warnings:?}") };
    assert!(warning.contains("in nanoseconds instead of microseconds"), "{warning}");
}
