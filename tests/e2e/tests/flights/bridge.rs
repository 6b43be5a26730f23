//! Black-box tests of `vizflyt bridge emulate`: a pseudo-terminal on one side, sockets on the other, MAVLink in
//! between. The same core runs on the chips.

use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Write};
use std::net::{TcpStream, UdpSocket};
use std::os::unix::fs::OpenOptionsExt;
use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::Value;
use vizflyt_e2e::{Demo, vizflyt};
use vizflyt_protocol::mavlink::dialect::{
    ATTITUDE_DATA, HEARTBEAT_DATA, MavAutopilot, MavMessage, MavModeFlag, MavType,
    PARAM_VALUE_DATA, VISION_POSITION_ESTIMATE_DATA,
};
use vizflyt_protocol::mavlink::{MAX_PACKET, MavHeader, StreamDecoder, encode};

/// Timeout for any machine.
const PATIENCE: Duration = Duration::from_mins(1);
/// O_NONBLOCK | O_NOCTTY on Linux.
const FLAGS: i32 = 0o4000 | 0o400;

/// An emulated bridge and both of its sides.
struct Rig {
    bridge: Demo,
    uart: File,
    companion: UdpSocket,
    tcp: String,
    /// Address of its status page; empty if it has none.
    page: String,
    folder: tempfile::TempDir,
}

impl Rig {
    fn start(more: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let companion = UdpSocket::bind("127.0.0.1:0").unwrap();
        companion.set_nonblocking(true).unwrap();
        let (bridge, ready) = start(&folder, "127.0.0.1:0", more);
        let uart = open_uart(&ready);
        companion.connect(ready["udp"].as_str().unwrap()).unwrap();
        let tcp = ready["tcp"].as_str().unwrap().to_owned();
        let page = ready["page"].as_str().unwrap_or_default().to_owned();
        Self { bridge, uart, companion, tcp, page, folder }
    }
}

fn start(folder: &tempfile::TempDir, listen: &str, more: &[&str]) -> (Demo, Value) {
    let uart = format!("--uart=pty:{}", folder.path().join("uart").display());
    let mut bridge = Demo::spawn(
        Command::new(vizflyt())
            .args(["bridge", "emulate", "--json", "--tcp=127.0.0.1:0", &uart])
            .arg(format!("--listen={listen}"))
            .args(more),
    );
    let ready = serde_json::from_str(&bridge.wait_for("\"ready\"", PATIENCE)).unwrap();
    (bridge, ready)
}

fn open_uart(ready: &Value) -> File {
    let path = ready["uart"].as_str().unwrap();
    OpenOptions::new().read(true).write(true).custom_flags(FLAGS).open(path).unwrap()
}

fn packet(sequence: u8, from: (u8, u8), message: &MavMessage) -> Vec<u8> {
    let header = MavHeader { system_id: from.0.into(), component_id: from.1, sequence };
    encode(header, message, &mut [0; MAX_PACKET]).to_vec()
}

fn heartbeat(armed: bool) -> MavMessage {
    let mut base_mode = MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED;
    base_mode.set(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED, armed);
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        custom_mode: 4,
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode,
        ..Default::default()
    })
}

fn vision(usec: u64) -> MavMessage {
    MavMessage::VISION_POSITION_ESTIMATE(VISION_POSITION_ESTIMATE_DATA {
        usec,
        ..Default::default()
    })
}

fn attitude(time_boot_ms: u32) -> MavMessage {
    MavMessage::ATTITUDE(ATTITUDE_DATA { time_boot_ms, roll: 0.25, ..Default::default() })
}

fn param(param_index: u16) -> MavMessage {
    MavMessage::PARAM_VALUE(PARAM_VALUE_DATA { param_index, ..Default::default() })
}

/// Reads all available packets, without waiting.
fn read(from: &mut impl Read, decoder: &mut StreamDecoder, into: &mut Vec<MavMessage>) {
    let mut bytes = [0; 4096];
    loop {
        match from.read(&mut bytes) {
            Ok(0) => return,
            Ok(len) => decoder.push(&bytes[..len], |packet| into.push(packet.message)),
            Err(error) if error.kind() == ErrorKind::WouldBlock => return,
            Err(error) => panic!("{error}"),
        }
    }
}

/// Receives all available datagrams; each contains complete packets.
fn receive(socket: &UdpSocket, into: &mut Vec<MavMessage>) {
    let mut bytes = [0; 2048];
    // Refused while the bridge is down: treat like no data.
    while let Ok(len) = socket.recv(&mut bytes) {
        let mut decoder = StreamDecoder::default();
        decoder.push(&bytes[..len], |packet| into.push(packet.message));
        assert_eq!(decoder.stats().dropped_bytes, 0, "a datagram holds whole packets");
    }
}

/// Repeats `step` until it returns true.
fn until(what: &str, mut step: impl FnMut() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !step() {
        assert!(Instant::now() < end, "never: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn carries_thousands_of_packets_both_ways_without_loss_or_change() {
    let mut rig = Rig::start(&[]);
    let (mut up, mut down) = (Vec::new(), Vec::new());
    // No setpoints: the bridge drops late ones, and this machine may be slow.
    let (mut decoder, count) = (StreamDecoder::default(), 2000u32);
    let mut sent = 0;
    rig.companion.send(&packet(0, (255, 191), &heartbeat(false))).unwrap();
    until("the bridge knows its client", || {
        rig.uart.write_all(&packet(0, (1, 1), &heartbeat(false))).unwrap();
        receive(&rig.companion, &mut down);
        !down.is_empty()
    });
    until("all packets are through", || {
        // Limit the packets in transit to the capacity of line and queues: the drop counters must stay at zero.
        let through = up.len().min(down.len()) as u32;
        while sent < count && sent < through + 15 {
            rig.companion.send(&packet(sent as u8, (255, 191), &param(sent as u16))).unwrap();
            rig.uart.write_all(&packet(sent as u8, (1, 1), &attitude(sent))).unwrap();
            sent += 1;
        }
        read(&mut rig.uart, &mut decoder, &mut up);
        receive(&rig.companion, &mut down);
        up.retain(|message| matches!(message, MavMessage::PARAM_VALUE(_)));
        down.retain(|message| matches!(message, MavMessage::ATTITUDE(_)));
        up.len() == count as usize && down.len() == count as usize
    });
    assert_eq!(up, (0..count).map(|i| param(i as u16)).collect::<Vec<_>>());
    assert_eq!(down, (0..count).map(attitude).collect::<Vec<_>>());
    let report = stats(&rig);
    for (name, value) in report.as_object().unwrap() {
        if name.starts_with("drop_") && name != "drop_no_client" || name.ends_with("dropped_bytes")
        {
            assert_eq!(value, 0, "{name}: {report:#}");
        }
    }
}

fn stats(rig: &Rig) -> Value {
    let address = rig.companion.peer_addr().unwrap().to_string();
    let output =
        Command::new(vizflyt()).args(["bridge", "stats", "--json", &address]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn carries_packets_for_a_tcp_client() {
    let mut rig = Rig::start(&[]);
    let mut client = TcpStream::connect(&rig.tcp).unwrap();
    client.set_nonblocking(true).unwrap();
    let (mut up, mut down) = (Vec::new(), Vec::new());
    let (mut up_decoder, mut down_decoder) = (StreamDecoder::default(), StreamDecoder::default());
    let mut at = 0u16;
    until("both directions carry", || {
        client.write_all(&packet(at as u8, (255, 191), &param(at))).unwrap();
        rig.uart.write_all(&packet(at as u8, (1, 1), &attitude(at.into()))).unwrap();
        at += 1;
        read(&mut rig.uart, &mut up_decoder, &mut up);
        read(&mut client, &mut down_decoder, &mut down);
        up.iter().filter(|m| matches!(m, MavMessage::PARAM_VALUE(_))).count() > 50
            && down.iter().filter(|m| matches!(m, MavMessage::ATTITUDE(_))).count() > 50
    });
}

#[test]
fn traffic_continues_after_a_killed_bridge_restarts() {
    let mut rig = Rig::start(&[]);
    let address = rig.companion.peer_addr().unwrap().to_string();
    let mut down = Vec::new();
    let mut carried = |rig: &mut Rig| {
        down.clear();
        until("telemetry comes", || {
            // Refused while the bridge is down; the companion continues to send.
            let _ = rig.companion.send(&packet(0, (255, 191), &vision(1)));
            rig.uart.write_all(&packet(0, (1, 1), &attitude(1))).unwrap();
            receive(&rig.companion, &mut down);
            down.iter().any(|message| matches!(message, MavMessage::ATTITUDE(_)))
        });
    };
    carried(&mut rig);
    // Dropping kills the bridge, like a power cut.
    let old = std::mem::replace(&mut rig.bridge, Demo::spawn(&mut Command::new("true")));
    drop(old);
    let (bridge, ready) = start(&rig.folder, &address, &[]);
    rig.bridge = bridge;
    rig.uart = open_uart(&ready);
    carried(&mut rig);
}

#[test]
fn bridge_is_claimed_configured_and_keeps_its_settings() {
    let folder = tempfile::tempdir().unwrap();
    let flash = format!("--flash={}", folder.path().join("flash").display());
    let mut rig = Rig::start(&[&flash]);
    let address = rig.companion.peer_addr().unwrap().to_string();
    let keys = folder.path().join("keys");
    let configure = |more: &[&str]| {
        let output = Command::new(vizflyt())
            .args(["bridge", "configure", "--bridge", &address, "--keys"])
            .arg(&keys)
            .args(more)
            .output()
            .unwrap();
        let printed = [output.stdout, output.stderr].concat();
        (output.status.success(), String::from_utf8(printed).unwrap())
    };
    let check = |more: &[&str], works: bool, expected: &str| {
        let (worked, printed) = configure(more);
        assert!(worked == works && printed.contains(expected), "{more:?}: {printed}");
    };
    check(&["LOSS_MS=700"], false, "--claim");
    check(&["--claim"], true, "claimed");
    check(&["--claim"], false, "has a key already");
    check(&["LOSS_MS=1"], false, "out of range");
    check(&["LOSS_MS=700", "wifi.password=correct horse", "--restart"], true, "saved");
    check(&[], true, "LOSS_MS            700");
    let (_, shown) = configure(&[]);
    assert!(!shown.contains("horse"), "{shown}");
    // The settings of an armed vehicle's bridge must not change.
    until("the bridge knows that the vehicle is armed", || {
        rig.uart.write_all(&packet(0, (1, 1), &heartbeat(true))).unwrap();
        let (worked, printed) = configure(&["LOSS_MS=800"]);
        !worked && printed.contains("armed")
    });
    // Kill and restart on the same flash.
    drop(rig);
    let rig = Rig::start(&[&flash]);
    let address = rig.companion.peer_addr().unwrap().to_string();
    let output = Command::new(vizflyt())
        .args(["bridge", "configure", "--bridge", &address])
        .output()
        .unwrap();
    let printed = String::from_utf8(output.stdout).unwrap();
    assert!(printed.contains("LOSS_MS            700"), "{printed}");
}

#[test]
fn firmware_update_over_the_network_is_verified_as_on_a_chip() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let firmware = |args: &[&str]| {
        let output =
            Command::new(vizflyt()).args(["bridge", "firmware"]).args(args).output().unwrap();
        let printed = [output.stdout, output.stderr].concat();
        (output.status.success(), String::from_utf8(printed).unwrap())
    };
    let (keys, image) = (at("keys"), at("image"));
    let (_, key) = firmware(&["key", "--keys", &keys]);
    std::fs::write(&image, (0..200_000u32).map(|i| ((i * 31) >> 3) as u8).collect::<Vec<_>>())
        .unwrap();
    let sign = |chip: &str, build: &str| {
        let signed = at(&format!("{chip}-{build}.signed"));
        let (made, printed) = firmware(&[
            "sign", &image, "--chip", chip, "--build", build, "--keys", &keys, "-o", &signed,
        ]);
        assert!(made, "{printed}");
        signed
    };
    let rig = Rig::start(&["--page=127.0.0.1:0", "--firmware-key", key.trim()]);
    let page = rig.page.clone();
    let check = |file: &str, works: bool, expected: &str| {
        let (worked, printed) = firmware(&["send", file, "--bridge", &page]);
        assert!(worked == works && printed.contains(expected), "{file}: {printed}");
    };
    let seven = sign("host", "7");
    check(&seven, true, "verified");
    check(&sign("host", "6"), false, "older than the one that runs");
    check(&sign("esp32c3", "8"), false, "another chip");
    check(&image, false, "is not signed");
    // Flip one bit of the program, then one of the signature.
    for (place, expected) in
        [(150_000, "differ from the signed firmware"), (60, "signature is not of")]
    {
        let mut bytes = std::fs::read(&seven).unwrap();
        bytes[place] ^= 1;
        let damaged = at("damaged.signed");
        std::fs::write(&damaged, bytes).unwrap();
        check(&damaged, false, expected);
    }
    // The page is available all the time, also for a browser.
    let shown = get(&page, "/");
    assert!(shown.starts_with("HTTP/1.0 200") && shown.contains("no vehicle"), "{shown}");
    assert!(get(&page, "/stats.json").contains("\"uart_packets_in\""));
    assert!(get(&page, "/nothing").starts_with("HTTP/1.0 404"));
    check(&seven, true, "verified");
}

fn get(address: &str, path: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    write!(stream, "GET {path} HTTP/1.0\r\n\r\n").unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

#[test]
fn demo_flies_through_the_bridge_without_drops() {
    let folder = tempfile::tempdir().unwrap();
    let report = folder.path().join("report.json");
    let mut demo = Demo::start(&[
        "--through-bridge",
        "--seconds=25",
        "--report",
        report.to_str().unwrap(),
        "--log-dir",
        folder.path().join("flights").to_str().unwrap(),
    ]);
    demo.wait(Duration::from_mins(4));
    let report: Value = serde_json::from_str(&std::fs::read_to_string(report).unwrap()).unwrap();
    // It lands after its time, or has finished before.
    if !demo.has_ended(&report, &["landed", "finished", "timeout"]) {
        return;
    }
    let bridge = &report["bridge"];
    let count = |name: &str| bridge[name].as_u64().unwrap();
    assert!(count("uart_packets_out") > report["setpoints_sent"].as_u64().unwrap(), "{report:#}");
    assert!(count("net_packets_out") > 500, "{report:#}");
    for name in
        ["drop_uart_full", "drop_client_slow", "drop_not_sent", "uart_bad_checksum", "landings"]
    {
        assert_eq!(count(name), 0, "{name}: {report:#}");
    }
}
