//! The guardian's process between a runtime and an autopilot, both played by the test: it survives signals that end a
//! runtime, lands a flying vehicle, and ends when there is nothing left to do. Its latency is printed: `cargo test -p
//! vizflyt-e2e --test flights guardian -- --nocapture`.

use std::net::UdpSocket;
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use vizflyt_e2e::vizflyt;
use vizflyt_guardian::client::BUFFER;
use vizflyt_guardian::port::Wanted;
use vizflyt_guardian::{Guardian, Message};
use vizflyt_protocol::mavlink::dialect::{
    HEARTBEAT_DATA, MavAutopilot, MavMessage, MavModeFlag, MavType,
};
use vizflyt_protocol::mavlink::{
    GuidedMotion, GuidedSetpoint, MAX_PACKET, MavHeader, StreamDecoder, encode, guided_to_mavlink,
};
use vizflyt_protocol::messages::YawTarget;

const GUIDED: u32 = 4;
const LAND: u32 = 9;
/// Timeout, for any load of the machine.
const PATIENCE: Duration = Duration::from_mins(1);

fn packet(source: (u8, u8), message: &MavMessage) -> Vec<u8> {
    let header = MavHeader { system_id: source.0.into(), component_id: source.1, sequence: 0 };
    encode(header, message, &mut [0; MAX_PACKET]).to_vec()
}

fn heartbeat(mode: u32, armed: bool) -> Vec<u8> {
    let mut base_mode = MavModeFlag::empty();
    base_mode.set(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED, armed);
    let beat = HEARTBEAT_DATA {
        custom_mode: mode,
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode,
        ..HEARTBEAT_DATA::default()
    };
    packet((1, 1), &MavMessage::HEARTBEAT(beat))
}

fn setpoint() -> Vec<u8> {
    let motion = GuidedMotion::Velocity(glam::DVec3::X);
    let setpoint = GuidedSetpoint { motion, yaw: YawTarget::Angle(0.0) };
    let message = guided_to_mavlink(&setpoint, (1, 1), 0);
    packet((255, 191), &MavMessage::SET_POSITION_TARGET_LOCAL_NED(message))
}

/// Starts a guardian; returns it and the autopilot's end of its port.
fn start() -> (Guardian, UdpSocket) {
    let address = "udpin:127.0.0.1:0".parse().unwrap();
    let guardian = Guardian::start(&vizflyt(), &address, &Wanted::default()).unwrap();
    let autopilot = UdpSocket::bind("127.0.0.1:0").unwrap();
    autopilot.connect(guardian.local()).unwrap();
    autopilot.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
    autopilot.send(&heartbeat(GUIDED, true)).unwrap();
    let (mut buffer, deadline) = (BUFFER, Instant::now() + PATIENCE);
    while !matches!(guardian.receive(&mut buffer), Ok(Some(Message::Mavlink(_)))) {
        assert!(Instant::now() < deadline, "the autopilot's heartbeat did not come");
    }
    (guardian, autopilot)
}

/// Waits until message `id` reaches the autopilot.
fn until(autopilot: &UdpSocket, id: u32) {
    let (mut decoder, mut buffer) = (StreamDecoder::default(), [0; 2048]);
    let deadline = Instant::now() + PATIENCE;
    let mut found = false;
    while !found {
        assert!(Instant::now() < deadline, "message {id} did not come");
        let Ok(len) = autopilot.recv(&mut buffer) else { continue };
        decoder.push(&buffer[..len], |packet| {
            found |= vizflyt_protocol::mavlink::Message::message_id(&packet.message) == id;
        });
    }
}

#[test]
fn survives_signals_and_ends_after_the_landing() {
    let (guardian, autopilot) = start();
    let pid = Pid::from_raw(guardian.pid().cast_signed());
    for _ in 0..20 {
        guardian.send(&setpoint());
        std::thread::sleep(Duration::from_millis(10));
    }
    for signal in [Signal::SIGTERM, Signal::SIGINT, Signal::SIGHUP, Signal::SIGQUIT] {
        kill(pid, signal).unwrap();
        guardian.send(&setpoint());
    }
    until(&autopilot, 84);
    // The runtime ends in flight: the guardian sends LAND at once, and continues.
    guardian.leave();
    // After `leave`, the end of the guardian is not an error.
    let mut buffer = BUFFER;
    assert!(matches!(guardian.receive(&mut buffer), Ok(None)));
    until(&autopilot, 76);
    autopilot.send(&heartbeat(LAND, true)).unwrap();
    assert!(!guardian.has_left(), "it waits for the vehicle to stand");
    autopilot.send(&heartbeat(LAND, false)).unwrap();
    let deadline = Instant::now() + PATIENCE;
    while !guardian.has_left() {
        assert!(Instant::now() < deadline, "it does not leave");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// The runtime takes the port of a guardian that has failed: LAND passes, setpoints do not. A stopped guardian is killed.
#[test]
fn runtime_sends_land_itself_if_the_guardian_fails() {
    for signal in [Signal::SIGKILL, Signal::SIGSTOP] {
        let (guardian, autopilot) = start();
        kill(Pid::from_raw(guardian.pid().cast_signed()), signal).unwrap();
        let (mut buffer, deadline) = (BUFFER, Instant::now() + PATIENCE);
        while !matches!(guardian.receive(&mut buffer).unwrap(), Some(Message::Failed(_))) {
            assert!(Instant::now() < deadline, "{signal}: the failure is not reported");
        }
        while !guardian.has_left() {
            assert!(Instant::now() < deadline, "{signal}: it still runs");
        }
        guardian.send(&setpoint());
        let land = vizflyt_protocol::failsafe::land((1, 1), 0);
        guardian.send(&packet((255, 191), &MavMessage::COMMAND_LONG(land)));
        autopilot.set_read_timeout(Some(PATIENCE)).unwrap();
        let len = autopilot.recv(&mut buffer).unwrap();
        assert_eq!(buffer[7..len][0], 76, "{signal}: only LAND passes");
        autopilot.send(&heartbeat(LAND, true)).unwrap();
        while !matches!(guardian.receive(&mut buffer).unwrap(), Some(Message::Mavlink(_))) {
            assert!(Instant::now() < deadline, "{signal}: nothing comes from the autopilot");
        }
    }
}

#[test]
fn reports_a_port_in_use_and_leaves_no_process() {
    let taken = UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = format!("udpin:{}", taken.local_addr().unwrap()).parse().unwrap();
    let error = Guardian::start(&vizflyt(), &address, &Wanted::default()).unwrap_err().to_string();
    assert!(error.contains("in use") && error.contains("guardian of an earlier flight"), "{error}");
}

/// Prints the latency, without a limit.
#[test]
fn measures_its_latency() {
    const PACKETS: usize = 2000;
    let (guardian, autopilot) = start();
    let direct = UdpSocket::bind("127.0.0.1:0").unwrap();
    let other = UdpSocket::bind("127.0.0.1:0").unwrap();
    direct.connect(other.local_addr().unwrap()).unwrap();
    other.set_read_timeout(Some(PATIENCE)).unwrap();
    autopilot.set_read_timeout(Some(PATIENCE)).unwrap();
    let bytes = setpoint();
    let mut buffer = [0; 2048];
    let (mut through, mut without) = (Vec::new(), Vec::new());
    for _ in 0..PACKETS {
        std::thread::sleep(Duration::from_millis(1));
        let sent = Instant::now();
        guardian.send(&bytes);
        autopilot.recv(&mut buffer).unwrap();
        through.push(sent.elapsed().as_secs_f64() * 1e3);
        let sent = Instant::now();
        direct.send(&bytes).unwrap();
        other.recv(&mut buffer).unwrap();
        without.push(sent.elapsed().as_secs_f64() * 1e3);
    }
    let mut back = Vec::new();
    let mut message = BUFFER;
    for _ in 0..PACKETS {
        std::thread::sleep(Duration::from_millis(1));
        let sent = Instant::now();
        autopilot.send(&bytes).unwrap();
        while !matches!(guardian.receive(&mut message), Ok(Some(Message::Mavlink(_)))) {}
        back.push(sent.elapsed().as_secs_f64() * 1e3);
    }
    for (name, times) in
        [("through the guardian", &mut through), ("back", &mut back), ("without", &mut without)]
    {
        times.sort_by(f64::total_cmp);
        let (p50, p99) = (times[PACKETS / 2], times[PACKETS * 99 / 100]);
        println!("{name}: p50 {p50:.3} ms, p99 {p99:.3} ms");
    }
    autopilot.send(&heartbeat(GUIDED, false)).unwrap();
}
