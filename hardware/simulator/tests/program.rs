//! The real program on loopback: it speaks first, streams the mocap, reports, and ends with its
//! parent.

use std::io::{BufRead, BufReader};
use std::net::UdpSocket;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use vizflyt_protocol::mavlink::StreamDecoder;
use vizflyt_protocol::mavlink::dialect::MavMessage;

/// Long enough for any machine: nothing here depends on how long it takes.
const PATIENCE: Duration = Duration::from_secs(30);

fn listen() -> (UdpSocket, String) {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    let address = socket.local_addr().unwrap().to_string();
    (socket, address)
}

fn start(mavlink: &str, vicon: &str) -> Child {
    Command::new(env!("CARGO_BIN_EXE_vizflyt-simulator"))
        .args(["--json", "--lifeline", "--spawn", "1,2,0,90", "--object", "drone"])
        .args(["--mavlink", &format!("udpout:{mavlink}"), "--vicon", vicon])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

#[test]
fn speaks_first_and_ends_with_its_parent() {
    let ((mavlink, mavlink_address), (vicon, vicon_address)) = (listen(), listen());
    let mut child = start(&mavlink_address, &vicon_address);
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let mut line = || serde_json::from_str::<serde_json::Value>(&lines.next().unwrap().unwrap());
    assert_eq!(line().unwrap()["ready"], "simulator");

    let mut buffer = [0; 2048];
    let mut heartbeats = 0;
    let mut decoder = StreamDecoder::default();
    while heartbeats == 0 {
        let length = mavlink.recv(&mut buffer).unwrap();
        decoder.push(&buffer[..length], |packet| {
            heartbeats += u32::from(matches!(packet.message, MavMessage::HEARTBEAT(_)));
        });
    }
    let length = vicon.recv(&mut buffer).unwrap();
    assert_eq!(length, 80);
    assert_eq!(&buffer[8..14], b"drone\0");

    drop(child.stdin.take());
    let report = line().unwrap();
    assert_eq!(report["report"]["landed"], false);
    let position = report["report"]["final_position_m"].as_array().unwrap();
    assert!((position[1].as_f64().unwrap() - 2.0).abs() < 0.01, "{position:?}");
    assert!(child.wait().unwrap().success());
}
