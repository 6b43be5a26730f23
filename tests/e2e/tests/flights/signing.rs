//! A flight with signed MAVLink packets: the signing key is sent over the wire, as a person would do it. From then on
//! the vehicle obeys only its runtime.

use std::process::Command;

use crate::lab::{Lab, Plan};
use vizflyt_e2e::vizflyt;
use vizflyt_protocol::mavlink::dialect::{COMMAND_LONG_DATA, MavCmd, MavMessage};
use vizflyt_protocol::mavlink::{MAX_PACKET, MavHeader, encode};

/// Returns a packet that stops the motors even in flight, as an attacker would send it: MAV_CMD_COMPONENT_ARM_DISARM
/// with ArduPilot's number that forces it.
fn motors_off() -> Vec<u8> {
    let message = MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
        param1: 0.0,
        param2: 21196.0,
        target_system: 1,
        target_component: 1,
        ..Default::default()
    });
    let header = MavHeader { system_id: 255, component_id: 190, sequence: 0 };
    encode(header, &message, &mut [0; MAX_PACKET]).to_vec()
}

#[test]
fn signed_flight_ignores_unsigned_commands() {
    let folder = tempfile::tempdir().unwrap();
    let key = folder.path().join("mavlink.key");
    let key = key.to_str().unwrap();
    // A key made for another vehicle.
    let digits = "1f".repeat(32);
    std::fs::write(key, digits).unwrap();
    let mode = std::os::unix::fs::PermissionsExt::from_mode(0o600);
    std::fs::set_permissions(key, mode).unwrap();

    let lab = Lab::open(1);
    let settings = format!("[vehicle]\nsigning_key = \"{key}\"");
    // The vehicle's first link is its USB port, which needs no signatures.
    let usb = ["--mavlink=tcpin:127.0.0.1:0"];
    let plan = Plan {
        how: "forward",
        settings: &settings,
        more: &["--seconds=5"],
        vehicle: &usb,
        ..Plan::default()
    };
    let mut flight = lab.fly(0, plan);

    // Until the vehicle has the key, its packets are rejected.
    flight.until("not signed");
    let usb = format!("tcpout:{}", flight.link(0));
    let given = Command::new(vizflyt())
        .args(["vehicle", "sign", "--mavlink", &usb, "--key", key])
        .output()
        .unwrap();
    assert!(given.status.success(), "{}", String::from_utf8_lossy(&given.stderr));

    flight.until("\"phase\":\"flying\"");
    let start = flight.now().p_m;
    while (flight.now().p_m - start).truncate().length() < 0.5 {
        flight.tell_vehicle(&motors_off());
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    flight.until("\"phase\":\"landed\"");
    let fell = flight.so_far().0.windows(20).any(|w| w[0].p_m.z - w[19].p_m.z > 0.2);
    assert!(!fell, "the motors were stopped");
    let report = flight.vehicle_report();
    assert!(report["mavlink_packets_refused"].as_u64().unwrap() > 5, "{report:#}");
}
