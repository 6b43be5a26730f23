//! `vizflyt bench bridge`: latency and packet loss that the bridge adds under the load of a flight:
//! setpoints and poses at 50 Hz up, telemetry down.
//!
//! The emulated bridge runs between a pseudo-terminal and loopback sockets; its serial line has the
//! timing of a real one. The same packets are then sent directly over loopback. The difference is
//! due to bridge and line.

use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Write};
use std::net::UdpSocket;
use std::os::fd::AsFd;
use std::os::unix::fs::OpenOptionsExt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use clap::Args;
use nix::fcntl::OFlag;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use serde_json::{Value, json};
use vizflyt_process::print_line;
use vizflyt_protocol::mavlink::dialect::{
    ATTITUDE_DATA, HEARTBEAT_DATA, LOCAL_POSITION_NED_DATA, MavAutopilot, MavMessage, MavType,
    RAW_IMU_DATA, SET_POSITION_TARGET_LOCAL_NED_DATA, VISION_POSITION_ESTIMATE_DATA,
};
use vizflyt_protocol::mavlink::{MAX_PACKET, MavHeader, StreamDecoder, encode};

use crate::bridge::{EmulateArgs, Emulation};

/// Measure the latency and packet loss of the emulated bridge
#[derive(Args, Clone, Debug)]
pub(crate) struct BridgeBenchArgs {
    /// Duration of each of the two measurements
    #[arg(long, value_name = "SECONDS", default_value_t = 20)]
    seconds: u32,
    /// Baud rate of the serial line
    #[arg(long, value_name = "BAUD", default_value_t = 921_600)]
    baud: u32,
    /// Print the results as JSON
    #[arg(long)]
    json: bool,
}

/// One end of a path: a serial line or a socket.
trait End: Send {
    /// Sends a packet; it is lost if the other end is closed, like any datagram.
    fn send(&mut self, packet: &[u8]);
    /// Waits a few milliseconds for bytes; returns the number received.
    fn receive(&mut self, bytes: &mut [u8]) -> usize;
}

impl End for File {
    fn send(&mut self, packet: &[u8]) {
        // A full line counts as a lost packet.
        let _ = self.write(packet);
    }

    fn receive(&mut self, bytes: &mut [u8]) -> usize {
        let mut fds = [PollFd::new(self.as_fd(), PollFlags::POLLIN)];
        let _ = poll(&mut fds, PollTimeout::from(5u8));
        self.read(bytes).unwrap_or(0)
    }
}

impl End for UdpSocket {
    fn send(&mut self, packet: &[u8]) {
        let _ = UdpSocket::send(self, packet);
    }

    fn receive(&mut self, bytes: &mut [u8]) -> usize {
        match self.recv(bytes) {
            Ok(len) => len,
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => 0,
            Err(_) => 0,
        }
    }
}

/// Runs `vizflyt bench bridge`.
pub(crate) fn run(args: &BridgeBenchArgs) -> Result<()> {
    let stop = Arc::new(AtomicBool::new(false));
    let companion = socket()?;
    let mut emulation = Emulation::open(&EmulateArgs::loopback(args.baud))?;
    companion.connect(emulation.udp.local_addr()?)?;
    let flags = OFlag::O_NONBLOCK | OFlag::O_NOCTTY;
    let line = OpenOptions::new()
        .read(true)
        .write(true)
        .custom_flags(flags.bits())
        .open(emulation.port.path())?;
    let ended = Arc::clone(&stop);
    let bridge = std::thread::spawn(move || -> Result<Value> {
        while !ended.load(Ordering::Relaxed) {
            emulation.turn()?;
            emulation.wait()?;
        }
        Ok(emulation.report())
    });
    let through = measure(Box::new(companion), Box::new(line), args.seconds);
    stop.store(true, Ordering::Relaxed);
    let report = match bridge.join() {
        Ok(report) => report?,
        Err(_) => bail!("bench: the bridge's thread panicked"),
    };
    let (near, far) = (socket()?, socket()?);
    near.connect(far.local_addr()?)?;
    far.connect(near.local_addr()?)?;
    let straight = measure(Box::new(near), Box::new(far), args.seconds);
    if args.json {
        let all = json!({
            "baud": args.baud,
            "seconds": args.seconds,
            "bridge": {"up": through.0.json(), "down": through.1.json()},
            "straight": {"up": straight.0.json(), "down": straight.1.json()},
            "counters": report,
        });
        print_line(serde_json::to_string_pretty(&all)?);
        return Ok(());
    }
    print_line(format!("{} baud, {} s each; ms from send to receive", args.baud, args.seconds));
    print_line("                          sent    lost     p50     p99     max");
    for (name, way) in [
        ("bridge, to the autopilot", &through.0),
        ("bridge, to the companion", &through.1),
        ("direct, one way", &straight.0),
        ("direct, other way", &straight.1),
    ] {
        print_line(format!(
            "{name:24} {:6} {:7} {:7.2} {:7.2} {:7.2}",
            way.sent,
            way.sent - way.times_ms.len(),
            way.quantile_ms(0.5),
            way.quantile_ms(0.99),
            way.quantile_ms(1.0)
        ));
    }
    let added =
        |with: &Direction, without: &Direction, q| with.quantile_ms(q) - without.quantile_ms(q);
    print_line(format!(
        "added at p50 / p99: {:.2} / {:.2} ms up, {:.2} / {:.2} ms down",
        added(&through.0, &straight.0, 0.5),
        added(&through.0, &straight.0, 0.99),
        added(&through.1, &straight.1, 0.5),
        added(&through.1, &straight.1, 0.99),
    ));
    Ok(())
}

fn socket() -> Result<UdpSocket> {
    let socket = UdpSocket::bind("127.0.0.1:0").context("bench: cannot open a socket")?;
    socket.set_read_timeout(Some(Duration::from_millis(5)))?;
    Ok(socket)
}

/// Packets of one direction.
#[derive(Default)]
struct Direction {
    sent: usize,
    /// Latencies, sorted. [ms]
    times_ms: Vec<f64>,
}

impl Direction {
    fn quantile_ms(&self, q: f64) -> f64 {
        let last = self.times_ms.len().saturating_sub(1);
        self.times_ms.get((last as f64 * q).round() as usize).copied().unwrap_or(f64::NAN)
    }

    fn json(&self) -> Value {
        json!({
            "sent": self.sent,
            "lost": self.sent - self.times_ms.len(),
            "p50_ms": self.quantile_ms(0.5),
            "p99_ms": self.quantile_ms(0.99),
            "max_ms": self.quantile_ms(1.0),
        })
    }
}

/// Sends in both directions for `seconds`. Returns the packets up (to the autopilot) and down.
fn measure(
    companion: Box<dyn End>,
    autopilot: Box<dyn End>,
    seconds: u32,
) -> (Direction, Direction) {
    let start = Instant::now();
    // 100 Hz in two types up; 201 Hz in four types down, the rates that the runtime requests.
    let up: MessagesAt = |tick, stamp| {
        let mut all = Vec::new();
        if tick % 4 == 0 {
            all.push(setpoint(stamp));
        }
        if tick % 4 == 2 {
            all.push(vision(stamp));
        }
        all
    };
    let down: MessagesAt = |tick, stamp| {
        let mut all = Vec::new();
        if tick % 200 == 0 {
            all.push(heartbeat());
        }
        if tick % 2 == 0 {
            all.push(imu(stamp));
        }
        if tick % 4 == 1 {
            all.push(attitude(stamp));
            all.push(position(stamp));
        }
        all
    };
    let upper = std::thread::spawn(move || exchange(companion, start, seconds, (255, 191), up));
    let lower = exchange(autopilot, start, seconds, (1, 1), down);
    let (up_sent, down_received) = upper.join().unwrap_or_default();
    let (down_sent, up_received) = lower;
    (direction(&up_sent, up_received), direction(&down_sent, down_received))
}

fn direction(sent: &[u32], mut received: Vec<(u32, f64)>) -> Direction {
    received.retain(|(stamp, _)| sent.contains(stamp));
    let mut times_ms: Vec<f64> = received.into_iter().map(|(_, ms)| ms).collect();
    times_ms.sort_by(f64::total_cmp);
    Direction { sent: sent.len(), times_ms }
}

type MessagesAt = fn(u32, u32) -> Vec<MavMessage>;

/// Period of sending. [us]
const TICK_US: u32 = 5000;

/// Sends at every tick and receives continuously. A stamp is the time of sending, rounded to 10 us;
/// each message has a different one. Returns the stamps sent, and the stamps received with their
/// latency. [ms]
fn exchange(
    mut end: Box<dyn End>,
    start: Instant,
    seconds: u32,
    from: (u8, u8),
    messages_at: MessagesAt,
) -> (Vec<u32>, Vec<(u32, f64)>) {
    let (mut sent, mut received) = (Vec::new(), Vec::new());
    let (mut decoder, mut tick, mut sequence) = (StreamDecoder::default(), 0, 0u8);
    let ticks = seconds * 1_000_000 / TICK_US;
    let mut bytes = [0; 4096];
    // Receive for another 250 ms: packets may still be on their way.
    let until = start + Duration::from_secs(seconds.into()) + Duration::from_millis(250);
    let due = |tick: u32| start + Duration::from_micros(u64::from(tick) * u64::from(TICK_US));
    while Instant::now() < until {
        while tick < ticks && Instant::now() >= due(tick) {
            for place in 0..messages_at(tick, 0).len() {
                let stamp = (start.elapsed().as_micros() / 10) as u32 + place as u32;
                let message = messages_at(tick, stamp).swap_remove(place);
                let header = MavHeader { system_id: from.0.into(), component_id: from.1, sequence };
                end.send(encode(header, &message, &mut [0; MAX_PACKET]));
                sequence = sequence.wrapping_add(1);
                if stamp_of(&message).is_some() {
                    sent.push(stamp);
                }
            }
            tick += 1;
        }
        let len = end.receive(&mut bytes);
        let now_us = start.elapsed().as_secs_f64() * 1e6;
        decoder.push(&bytes[..len], |packet| {
            if let Some(stamp) = stamp_of(&packet.message) {
                received.push((stamp, (now_us - f64::from(stamp) * 10.0) / 1e3));
            }
        });
    }
    (sent, received)
}

/// Packets of the first ticks are not counted: the bridge has no client yet.
const SETTLED: u32 = 50_000;

fn stamp_of(message: &MavMessage) -> Option<u32> {
    let stamp = match message {
        MavMessage::SET_POSITION_TARGET_LOCAL_NED(data) => data.time_boot_ms,
        MavMessage::VISION_POSITION_ESTIMATE(data) => data.usec as u32,
        MavMessage::ATTITUDE(data) => data.time_boot_ms,
        MavMessage::LOCAL_POSITION_NED(data) => data.time_boot_ms,
        MavMessage::RAW_IMU(data) => data.time_usec as u32,
        _ => return None,
    };
    (stamp >= SETTLED).then_some(stamp)
}

fn setpoint(stamp: u32) -> MavMessage {
    MavMessage::SET_POSITION_TARGET_LOCAL_NED(SET_POSITION_TARGET_LOCAL_NED_DATA {
        time_boot_ms: stamp,
        x: 1.5,
        yaw: 0.5,
        yaw_rate: 0.1,
        target_system: 1,
        target_component: 1,
        ..Default::default()
    })
}

fn vision(stamp: u32) -> MavMessage {
    MavMessage::VISION_POSITION_ESTIMATE(VISION_POSITION_ESTIMATE_DATA {
        usec: stamp.into(),
        x: 1.5,
        covariance: [0.01; 21],
        reset_counter: 1,
        ..Default::default()
    })
}

fn heartbeat() -> MavMessage {
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        ..Default::default()
    })
}

fn imu(stamp: u32) -> MavMessage {
    MavMessage::RAW_IMU(RAW_IMU_DATA {
        time_usec: stamp.into(),
        zacc: -1000,
        zmag: 1,
        temperature: 4000,
        ..Default::default()
    })
}

fn attitude(stamp: u32) -> MavMessage {
    MavMessage::ATTITUDE(ATTITUDE_DATA { time_boot_ms: stamp, yawspeed: 0.1, ..Default::default() })
}

fn position(stamp: u32) -> MavMessage {
    MavMessage::LOCAL_POSITION_NED(LOCAL_POSITION_NED_DATA {
        time_boot_ms: stamp,
        vz: 0.1,
        ..Default::default()
    })
}
