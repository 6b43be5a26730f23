//! The real program on loopback: it sends first, streams the mocap, reports, and ends with its parent.

use std::io::{BufRead, BufReader};
use std::net::UdpSocket;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use vizflyt_protocol::mavlink::dialect::{MavMessage, PARAM_REQUEST_READ_DATA};
use vizflyt_protocol::mavlink::{MAX_PACKET, MavHeader, StreamDecoder, encode};
use vizflyt_simulator::link::serial::SerialPort;

/// Longer than any machine needs; no result depends on it.
const PATIENCE: Duration = Duration::from_secs(30);

fn listen() -> (UdpSocket, String) {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    let address = socket.local_addr().unwrap().to_string();
    (socket, address)
}

fn start(mavlink: &[&str], vicon: &str) -> Child {
    Command::new(env!("CARGO_BIN_EXE_vizflyt-simulator"))
        .args(["--json", "--lifeline", "--spawn", "1,2,0,90", "--object", "drone"])
        .args(mavlink)
        .args(["--vicon", vicon])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

#[test]
fn sends_first_and_ends_with_its_parent() {
    let ((mavlink, mavlink_address), (vicon, vicon_address)) = (listen(), listen());
    let mavlink_endpoint = format!("udpout:{mavlink_address}");
    let mut child = start(&["--mavlink", &mavlink_endpoint], &vicon_address);
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

/// A telemetry port on a pseudo-terminal, in addition to UDP: packets are accepted from both and sent to both.
#[test]
fn serves_a_serial_line_and_udp() {
    let ((mavlink, mavlink_address), (_vicon, vicon_address)) = (listen(), listen());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("uart");
    let name = path.to_str().unwrap();
    let endpoint = format!("udpout:{mavlink_address}");
    let mut child = start(&["--mavlink", &endpoint, "--pty", name], &vicon_address);
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let ready: serde_json::Value = serde_json::from_str(&lines.next().unwrap().unwrap()).unwrap();
    assert_eq!(ready["links"][1], name);

    let mut uart = SerialPort::open(&path, 921_600);
    let request = MavMessage::PARAM_REQUEST_READ(PARAM_REQUEST_READ_DATA {
        param_index: 0,
        target_system: 1,
        target_component: 1,
        ..Default::default()
    });
    let header = MavHeader { system_id: 255, component_id: 1, sequence: 0 };
    let mut buffer = [0; MAX_PACKET];
    let asked = encode(header, &request, &mut buffer);
    let is_answer = |message: &MavMessage| matches!(message, MavMessage::PARAM_VALUE(_));
    let (mut over_uart, mut over_udp) = (0, 0);
    let mut decoders = [StreamDecoder::default(), StreamDecoder::default()];
    let end = Instant::now() + PATIENCE;
    while over_uart == 0 {
        assert!(Instant::now() < end, "no answer over the serial line");
        uart.send(asked);
        uart.receive(|bytes| {
            decoders[0].push(bytes, |packet| over_uart += u32::from(is_answer(&packet.message)));
        });
        std::thread::yield_now();
    }
    let mut buffer = [0; 2048];
    while over_udp == 0 {
        let length = mavlink.recv(&mut buffer).unwrap();
        decoders[1].push(&buffer[..length], |packet| {
            over_udp += u32::from(is_answer(&packet.message));
        });
    }
    drop(child.stdin.take());
    assert!(child.wait().unwrap().success());
    assert!(!path.is_symlink(), "the link must be removed");
}
