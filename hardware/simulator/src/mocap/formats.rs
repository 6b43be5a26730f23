//! Encodes measured poses for the wire.
//!
//! Vicon Tracker's UDP object stream, little-endian, packed: `u32 frame, u8 items`, then per item `u8 id = 0, u16 size
//! = 72, char[24] name, f64 x, y, z [mm], f64 rx, ry, rz [rad]`; rotations about the fixed x, then y, then z axis, `R =
//! Rz(rz) * Ry(ry) * Rx(rx)`.
//!
//! VizFlyt's own pose packet: a JSON object, described in `docs/guides/localization.md`.
//!
//! OptiTrack's NatNet 4.1, with Motive's default axes: y up, so that the world's x, y and z become x, -z and y.
//!
//! LOCAL_POSITION_NED and ATTITUDE_QUATERNION of an autopilot, as if it had its own localization.

use glam::{DQuat, DVec3, EulerRot};
use natnet::{
    ConnectionInfo, DataSet, ModelDef, PlannedBody, RigidBodyDef, ServerInfo, SyntheticServer,
    Version,
};
use serde_json::json;
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::mavlink::dialect::{ATTITUDE_QUATERNION_DATA, MavMessage};
use vizflyt_protocol::mavlink::{
    MAX_PACKET, MavHeader, encode, local_position_to_mavlink, ned_rotation_from_world,
};
use vizflyt_protocol::time::AutopilotTime;

use super::{MAX_NAME, Sight};

/// Length of a Vicon datagram with one object [bytes].
pub const DATAGRAM: usize = 5 + 3 + 72;

/// Returns a pose packet, stamped by the simulator's clock.
pub fn encode_json(name: &str, sight: &Sight) -> Vec<u8> {
    let pose = &sight.world_from_body;
    let packet = json!({
        "vizflyt_pose": 1,
        "object": name,
        "seq": sight.frame,
        "stamp_ns": sight.at.as_ns(),
        "position_m": pose.translation_m.to_array(),
        "rotation_xyzw": pose.rotation.to_array(),
    });
    packet.to_string().into_bytes()
}

/// Streaming id of the vehicle's rigid body.
const BODY_ID: i32 = 1;
/// Frequency of Motive's clock [Hz].
const TICKS_HZ: u64 = 10_000_000;

/// Returns a NatNet frame with the pose in `sight`, sent at `now`.
pub fn encode_natnet(sight: &Sight, now: AutopilotTime) -> Option<Vec<u8>> {
    let y_up = |v: DVec3| DVec3::new(v.x, v.z, -v.y);
    let pose = &sight.world_from_body;
    let axis = y_up(pose.rotation.xyz());
    let rotation = DQuat::from_xyzw(axis.x, axis.y, axis.z, pose.rotation.w);
    let p_m = y_up(pose.translation_m).to_array().map(|v| v as f32);
    let body = PlannedBody::tracked(BODY_ID, p_m, rotation.to_array().map(|v| v as f32));
    let server = SyntheticServer::new(Version::V4_1, TICKS_HZ);
    let seconds = sight.at.as_ns() as f64 * 1e-9;
    let mut frame = server.frame(sight.frame.cast_signed(), seconds, &[body]);
    frame.timing.transmit = now.as_ns() / (1_000_000_000 / TICKS_HZ);
    frame.to_datagram(Version::V4_1).ok()
}

/// Returns Motive's answer to a command.
pub fn answer_natnet(name: &str, command: &[u8]) -> Option<Vec<u8>> {
    match natnet::MessageHeader::parse(command).ok()?.message_id {
        natnet::NAT_CONNECT => {
            let info = ServerInfo {
                application_name: "vizflyt sim".to_owned(),
                server_version: Version::new(3, 1, 0, 0),
                protocol_version: Version::V4_1,
                high_res_clock_frequency: TICKS_HZ,
                connection: ConnectionInfo {
                    data_port: 1511,
                    multicast: false,
                    multicast_group: [239, 255, 42, 99],
                },
            };
            info.to_datagram().ok()
        }
        natnet::NAT_REQUEST_MODELDEF => {
            let body = RigidBodyDef {
                name: name.to_owned(),
                id: BODY_ID,
                parent_id: -1,
                offset: [0.0; 3],
                // No markers.
                tail: 0i32.to_le_bytes().to_vec(),
            };
            ModelDef { datasets: vec![DataSet::RigidBody(body)] }.to_datagram(Version::V4_1).ok()
        }
        _ => None,
    }
}

/// Returns the MAVLink packets of an autopilot that estimates the measured pose.
pub fn encode_mavlink(sight: &Sight) -> Vec<u8> {
    let pose = &sight.world_from_body;
    let boot_ms = (sight.at.as_ns() / 1_000_000) as u32;
    let [x, y, z, w] = ned_rotation_from_world(pose.rotation).to_array().map(|v| v as f32);
    let attitude = MavMessage::ATTITUDE_QUATERNION(ATTITUDE_QUATERNION_DATA {
        time_boot_ms: boot_ms,
        q1: w,
        q2: x,
        q3: y,
        q4: z,
        ..ATTITUDE_QUATERNION_DATA::default()
    });
    let position = local_position_to_mavlink(pose.translation_m, DVec3::ZERO, boot_ms);
    let mut bytes = Vec::new();
    for message in [attitude, MavMessage::LOCAL_POSITION_NED(position)] {
        let header = MavHeader { system_id: 1, component_id: 1, sequence: sight.frame as u8 };
        bytes.extend_from_slice(encode(header, &message, &mut [0; MAX_PACKET]));
    }
    bytes
}

/// Returns a Vicon datagram with one object. Longer names are truncated.
pub fn encode_object(frame: u32, name: &str, pose: &Pose<World, Body>) -> [u8; DATAGRAM] {
    let mut datagram = [0; DATAGRAM];
    datagram[..4].copy_from_slice(&frame.to_le_bytes());
    datagram[4] = 1;
    datagram[6..8].copy_from_slice(&72u16.to_le_bytes());
    let length = name.len().min(MAX_NAME);
    datagram[8..8 + length].copy_from_slice(&name.as_bytes()[..length]);
    let p_mm = pose.translation_m * 1000.0;
    // Intrinsic z-y-x is fixed x-y-z.
    let (rz, ry, rx) = pose.rotation.to_euler(EulerRot::ZYX);
    for (i, value) in [p_mm.x, p_mm.y, p_mm.z, rx, ry, rz].into_iter().enumerate() {
        let at = 8 + MAX_NAME + 8 * i;
        datagram[at..at + 8].copy_from_slice(&value.to_le_bytes());
    }
    datagram
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn json_matches_the_guide() {
        let pose = Pose::new(DVec3::new(1.0, 2.0, 0.5), DQuat::IDENTITY);
        let at = AutopilotTime::from_ns(77);
        let bytes = encode_json("bee", &Sight { frame: 3, at, world_from_body: pose });
        let value: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
        assert_eq!((&value["vizflyt_pose"], &value["seq"]), (&json!(1), &json!(3)));
        assert_eq!((&value["object"], &value["stamp_ns"]), (&json!("bee"), &json!(77)));
        assert_eq!(value["position_m"], json!([1.0, 2.0, 0.5]));
        assert_eq!(value["rotation_xyzw"], json!([0.0, 0.0, 0.0, 1.0]));
    }

    #[test]
    fn natnet_is_y_up_with_two_time_stamps() {
        let pose = Pose::new(DVec3::new(1.0, 2.0, 0.5), DQuat::from_rotation_z(0.5));
        let at = AutopilotTime::from_ns(2_000_000_000);
        let sight = Sight { frame: 3, at, world_from_body: pose };
        let bytes = encode_natnet(&sight, at.plus_seconds(0.01)).unwrap();
        let frame = natnet::FrameOfData::parse(&bytes, Version::V4_1).unwrap();
        assert_eq!(frame.frame_number, 3);
        assert_eq!(frame.rigid_bodies[0].position, [1.0, 0.5, -2.0]);
        let rotation = DQuat::from_array(frame.rigid_bodies[0].orientation.map(f64::from));
        assert!((rotation.to_scaled_axis() - DVec3::Y * 0.5).length() < 1e-6);
        assert_eq!(frame.timing.transmit - frame.timing.camera_mid_exposure, 100_000);
        let asked = natnet::command::request_modeldef().unwrap();
        let answer = answer_natnet("bee", asked.as_bytes()).unwrap();
        let model = ModelDef::parse(&answer, Version::V4_1).unwrap();
        assert_eq!(model.resolve_rigid_body("bee"), Some(BODY_ID));
        assert_eq!(answer_natnet("bee", b"?"), None);
    }

    fn read(datagram: &[u8; DATAGRAM]) -> (u32, String, [f64; 6]) {
        let frame = u32::from_le_bytes(datagram[..4].try_into().unwrap());
        let name = String::from_utf8_lossy(&datagram[8..32]).trim_end_matches('\0').to_owned();
        let value =
            |i: usize| f64::from_le_bytes(datagram[32 + 8 * i..40 + 8 * i].try_into().unwrap());
        (frame, name, std::array::from_fn(value))
    }

    #[test]
    fn layout_matches_vicon_tracker() {
        let rotation = DQuat::from_rotation_z(0.3);
        let pose = Pose::new(DVec3::new(1.0, -2.0, 0.5), rotation);
        let datagram = encode_object(7, "vizflyt", &pose);
        assert_eq!(datagram.len(), 80);
        assert_eq!(&datagram[..8], &[7, 0, 0, 0, 1, 0, 72, 0]);
        let (_, name, values) = read(&datagram);
        assert_eq!(name, "vizflyt");
        assert_eq!(&values[..3], &[1000.0, -2000.0, 500.0]);
        assert!(values[3].abs() < 1e-12 && values[4].abs() < 1e-12);
        assert!((values[5] - 0.3).abs() < 1e-12);
    }

    proptest! {
        /// R = Rz(rz) * Ry(ry) * Rx(rx).
        #[test]
        fn angles_are_about_fixed_x_then_y_then_z(
            rx in -3.0..3.0f64, ry in -1.5..1.5f64, rz in -3.0..3.0f64,
        ) {
            let rotation = DQuat::from_rotation_z(rz) * DQuat::from_rotation_y(ry) * DQuat::from_rotation_x(rx);
            let (_, _, values) = read(&encode_object(0, "x", &Pose::new(DVec3::ZERO, rotation)));
            prop_assert!((values[3] - rx).abs() < 1e-6);
            prop_assert!((values[4] - ry).abs() < 1e-6);
            prop_assert!((values[5] - rz).abs() < 1e-6);
        }
    }
}
