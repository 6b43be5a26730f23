//! The lab on one virtual clock: vehicle, bridge, guardian, runtime, server and motion capture. Each uses the sans-IO
//! core of its program; links between them have seeded delays.
//!
//! ```text
//! Simulation ── capture ─▶ Server ── poses, events, images ─▶ Runtime ◀──▶ Plugin (a model)
//!     ▲ │                     └───── feed ──▶ Guardian ◀── packets ──▶ │
//!     │ └── MAVLink (─ serial line ─ WifiBridge) ──▶ │
//!     └──────────────────────────────────────────────┘
//! ```
//! [`Rig::step`] advances to the next time at which any part has work. Losses follow the operating system: a killed
//! process is gone and its socket closes; a stopped process does nothing and nothing closes.

use std::sync::Arc;

use glam::{DQuat, DVec3};
use vizflyt_arena::{ArenaConfig, DistanceField};
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::mavlink::dialect::{COMMAND_LONG_DATA, MavCmd, MavMessage};
use vizflyt_protocol::mavlink::{CopterMode, MAX_PACKET, MavHeader, encode};
use vizflyt_protocol::messages::{Event, ImuReading, PoseSample};
use vizflyt_protocol::time::{HostTime, ServerTime};
use vizflyt_simulator::mocap::MocapConfig;
use vizflyt_simulator::mocap::formats::encode_object;
use vizflyt_simulator::simulation::{Simulation, SimulationConfig, TICK_HZ};

use super::bridge::WifiBridge;
use super::guardian::{Guardian, ToRuntime};
use super::runtime::{Runtime, Settings};
use super::server::Server;
use super::wire::Wire;

/// The vehicle's name in the motion capture.
pub(crate) const OBJECT: &str = "vehicle";
/// Start of the clocks, far enough from zero for earlier times. [ns]
const START_NS: u64 = 10_000_000_000;
/// Maximum delay that the simulator's process catches up after a pause, as in its driver. [s]
const CAUGHT_UP_S: f64 = 0.1;
const TICK_NS: i64 = (1_000_000_000 / TICK_HZ).cast_signed();
/// Timeout of a connection whose other end has died. [s]
const CONNECTION_LOST_S: f64 = 5.0;
/// Time until the socket of a killed process closes. [s]
const SOCKET_CLOSES_S: f64 = 0.002;
/// Minimum time of a step. [ns]
const LEAST_STEP_NS: i64 = 1000;
/// Autopilot port that the companion does not use.
const TELEMETRY_PORT: usize = 1;

/// Converts a server time to the computer's clock: they are equal.
pub(crate) fn host(stamp: ServerTime) -> HostTime {
    HostTime::from_ns(stamp.as_ns())
}

/// Converts a time of the computer to the server's clock.
pub(crate) fn server(now: HostTime) -> ServerTime {
    ServerTime::from_ns(now.as_ns())
}

/// All links.
pub(crate) struct Wires {
    /// Motion capture to server: port of the sender, and packet.
    pub(crate) capture: Wire<(u16, Vec<u8>)>,
    /// Server to runtime.
    pub(crate) poses: Wire<PoseSample>,
    /// Server to runtime.
    pub(crate) events: Wire<Event>,
    /// Server to runtime: stamps of the rendered poses.
    pub(crate) images: Wire<HostTime>,
    /// Server to guardian.
    pub(crate) feed: Wire<PoseSample>,
    /// Runtime to server.
    pub(crate) imu: Wire<ImuReading>,
    /// Runtime to server.
    pub(crate) reports: Wire<Event>,
    /// Runtime to guardian.
    pub(crate) to_guardian: Wire<Vec<u8>>,
    /// Guardian to runtime.
    pub(crate) to_runtime: Wire<ToRuntime>,
    /// Guardian to vehicle or bridge.
    pub(crate) to_vehicle: Wire<Vec<u8>>,
    /// Vehicle or bridge to guardian.
    pub(crate) from_vehicle: Wire<Vec<u8>>,
    /// Bridge to vehicle.
    pub(crate) uart_to_vehicle: Wire<Vec<u8>>,
    /// Vehicle to bridge.
    pub(crate) uart_from_vehicle: Wire<Vec<u8>>,
}

impl Wires {
    fn new(seed: u64) -> Self {
        // Delays: cables within a millisecond; images with rendering, encoding, sending and decoding; the radio.
        let (local, image, socket, radio) = ((200, 1500), (20_000, 30_000), (10, 60), (300, 2500));
        Self {
            capture: Wire::new(seed, 1, local),
            poses: Wire::new(seed, 2, local),
            events: Wire::new(seed, 3, local),
            images: Wire::new(seed, 4, image),
            feed: Wire::new(seed, 5, local),
            imu: Wire::new(seed, 6, local),
            reports: Wire::new(seed, 7, local),
            to_guardian: Wire::new(seed, 8, socket),
            to_runtime: Wire::new(seed, 9, socket),
            to_vehicle: Wire::new(seed, 10, radio),
            from_vehicle: Wire::new(seed, 11, radio),
            uart_to_vehicle: Wire::new(seed, 12, (0, 0)),
            uart_from_vehicle: Wire::new(seed, 13, (0, 0)),
        }
    }

    /// Cuts MAVLink in both directions, or restores it.
    pub(crate) fn cut_mavlink(&mut self, is_cut: bool) {
        (self.to_vehicle.is_cut, self.from_vehicle.is_cut) = (is_cut, is_cut);
    }
}

/// Packets of the motion capture.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) enum Capture {
    #[default]
    Usual,
    /// The last pose again, in each frame.
    Repeats,
    /// The origin without rotation.
    Origin,
    /// A second program sends poses of the vehicle too.
    SecondSender,
}

/// One pose of the motion capture.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sight {
    /// Time since the start. [s]
    pub(crate) at_s: f64,
    /// Position of the vehicle. [m, world]
    pub(crate) p_m: DVec3,
}

/// External observations of a flight.
#[derive(Default)]
pub(crate) struct Seen {
    /// Poses of the motion capture, also while they are cut.
    pub(crate) track: Vec<Sight>,
    /// Modes of the autopilot, with their start. [s]
    pub(crate) modes: Vec<(f64, CopterMode)>,
    /// LAND orders that reached the autopilot: time and component. [s]
    pub(crate) orders: Vec<(f64, u8)>,
    /// Number of the guardian's poses that reached the autopilot.
    pub(crate) guardian_poses: u32,
    /// Maximum speed of the vehicle, and maximum speed in the server's poses. [m/s]
    pub(crate) fastest_mps: f64,
    pub(crate) fastest_pose_mps: f64,
    /// Hash of all motion, of all packets to the autopilot, and of every event.
    hash: u64,
}

impl Seen {
    fn hash(&mut self, word: u64) {
        self.hash = (self.hash ^ word).wrapping_mul(0x0000_0100_0000_01B3).rotate_left(29);
    }

    fn hash_bytes(&mut self, bytes: &[u8]) {
        for chunk in bytes.chunks(8) {
            let mut word = [0; 8];
            word[..chunk.len()].copy_from_slice(chunk);
            self.hash(u64::from_le_bytes(word));
        }
        self.hash(bytes.len() as u64);
    }

    /// Records a packet that has reached the autopilot.
    fn packet(&mut self, at_s: f64, packet: &[u8]) {
        const COMMAND_LONG: [u8; 3] = [76, 0, 0];
        const VISION_POSITION_ESTIMATE: [u8; 3] = [102, 0, 0];
        self.hash_bytes(packet);
        let [0xFD, _, _, _, _, _, component, a, b, c, payload @ ..] = packet else { return };
        match [*a, *b, *c] {
            COMMAND_LONG
                if payload.get(28..30)
                    == Some(&(MavCmd::MAV_CMD_NAV_LAND as u16).to_le_bytes()) =>
            {
                self.orders.push((at_s, *component));
            }
            VISION_POSITION_ESTIMATE if *component == vizflyt_guardian::watch::COMPONENT_ID => {
                self.guardian_poses += 1;
            }
            _ => {}
        }
    }
}

/// A place for flights, shared by several.
#[derive(Clone)]
pub(crate) struct Place {
    pub(crate) arena: ArenaConfig,
    pub(crate) obstacles: Arc<DistanceField>,
}

/// Conditions of a flight.
pub(crate) struct Plan<'a> {
    pub(crate) place: &'a Place,
    /// Parameters of the autopilot that differ from its defaults.
    pub(crate) params: Vec<(String, f32)>,
    /// A pilot's transmitter is on.
    pub(crate) radio: bool,
    /// MAVLink goes through a bridge.
    pub(crate) bridge: bool,
    /// Seed of noise and delays.
    pub(crate) seed: u64,
    pub(crate) settings: Settings<'a>,
}

/// Process that may be paused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Process {
    Simulator,
    Server,
    Bridge,
    Guardian,
    Runtime,
    /// All of them: the whole machine stalls.
    All,
}

/// Bytes of position and angles in a packet of Vicon, and of the last angle.
const POSE: std::ops::Range<usize> = 32..80;
const YAW: std::ops::Range<usize> = 72..80;

/// A running flight.
pub(crate) struct Rig {
    now: HostTime,
    tick_at: HostTime,
    /// Process that is not scheduled, and the end of its pause.
    paused: Option<(Process, HostTime)>,
    simulation: Simulation,
    pub(crate) wires: Wires,
    pub(crate) capture: Capture,
    /// Last pose that the motion capture measured.
    captured: Pose<World, Body>,
    server: Option<Server>,
    has_bridge: bool,
    bridge: Option<WifiBridge>,
    guardian: Option<Guardian>,
    runtime: Option<Runtime>,
    pub(crate) seen: Seen,
}

impl Rig {
    pub(crate) fn new(plan: &Plan<'_>) -> Self {
        let now = HostTime::from_ns(START_NS);
        let Plan { place, bridge, seed, settings, .. } = *plan;
        let config = SimulationConfig {
            spawn_m: place.arena.spawn.position_m,
            seed,
            mocap: MocapConfig { object: OBJECT.to_owned(), ..MocapConfig::default() },
            params: plan.params.clone(),
            radio: plan.radio,
            ..SimulationConfig::default()
        };
        Self {
            now,
            tick_at: now.plus_ns(TICK_NS),
            paused: None,
            simulation: Simulation::new(config).expect("the autopilot has these parameters"),
            wires: Wires::new(seed),
            capture: Capture::default(),
            captured: Pose::new(DVec3::ZERO, DQuat::IDENTITY),
            server: Some(Server::new(now, &place.arena, Arc::clone(&place.obstacles))),
            has_bridge: bridge,
            bridge: bridge.then(|| WifiBridge::new(now)),
            guardian: Some(Guardian::new(now)),
            runtime: Some(Runtime::new(now, &place.arena, settings)),
            seen: Seen::default(),
        }
    }

    /// Returns the time since the start. [s]
    pub(crate) fn now_s(&self) -> f64 {
        self.now.seconds_since(HostTime::from_ns(START_NS))
    }

    /// Returns an instant as seconds since the start.
    pub(crate) fn at_s(at: HostTime) -> f64 {
        at.seconds_since(HostTime::from_ns(START_NS))
    }

    /// Returns the newest pose of the motion capture.
    pub(crate) fn sight(&self) -> Sight {
        *self.seen.track.last().expect("the motion capture runs")
    }

    /// Returns the runtime.
    pub(crate) fn runtime(&self) -> &Runtime {
        self.runtime.as_ref().expect("the runtime runs")
    }

    /// Returns whether the autopilot is armed.
    pub(crate) fn is_armed(&self) -> bool {
        self.simulation.autopilot().is_armed()
    }

    /// Returns the hash of the flight so far.
    pub(crate) fn hash(&self) -> u64 {
        self.seen.hash
    }

    /// Continues the flight until `done` returns true.
    pub(crate) fn until(&mut self, what: &str, within_s: f64, mut done: impl FnMut(&Self) -> bool) {
        let limit_s = self.now_s() + within_s;
        while !done(self) {
            assert!(self.now_s() < limit_s, "{what}: not within {within_s} s: {}", self.story());
            self.step();
        }
    }

    /// Returns the runtime's events, for failure messages.
    pub(crate) fn story(&self) -> String {
        let events = self.runtime.iter().flat_map(|runtime| &runtime.events);
        let lines: Vec<_> =
            events.map(|(at, event)| format!("{:8.3} {}", Self::at_s(*at), event.text)).collect();
        lines.join("\n")
    }

    /// Pauses a process: it does nothing, and its input waits.
    pub(crate) fn pause(&mut self, process: Process, seconds: f64) {
        self.paused = Some((process, self.now.plus_seconds(seconds)));
    }

    fn is_paused(&self, process: Process) -> bool {
        self.paused.is_some_and(|(paused, _)| paused == process || paused == Process::All)
    }

    // ---- losses ----

    /// Kills the runtime and its plugin, but not its guardian.
    pub(crate) fn kill_runtime(&mut self) {
        self.runtime = None;
        if let Some(guardian) = &mut self.guardian {
            guardian.socket_closes_at = Some(self.now.plus_seconds(SOCKET_CLOSES_S));
        }
    }

    /// Stops the runtime, as if it hangs.
    pub(crate) fn stop_runtime(&mut self) {
        self.runtime.as_mut().expect("it runs").is_stopped = true;
    }

    /// Kills the guardian.
    pub(crate) fn kill_guardian(&mut self) {
        self.guardian = None;
        self.wires.to_runtime.send(self.now, ToRuntime::Closed);
    }

    /// Stops the guardian, as if it hangs, or continues it.
    pub(crate) fn stop_guardian(&mut self, is_stopped: bool) {
        if let Some(guardian) = &mut self.guardian {
            guardian.is_stopped = is_stopped;
        }
    }

    /// Switches the vehicle's computer off: runtime and guardian.
    pub(crate) fn switch_off(&mut self) {
        (self.runtime, self.guardian) = (None, None);
    }

    /// Kills the server.
    pub(crate) fn kill_server(&mut self) {
        self.server = None;
        let lost_at = self.now.plus_seconds(CONNECTION_LOST_S);
        self.runtime.as_mut().expect("it runs").server_lost_at = Some(lost_at);
    }

    /// Stops the bridge, as if it hangs.
    pub(crate) fn hang_bridge(&mut self) {
        self.bridge.as_mut().expect("it flies through a bridge").is_hung = true;
    }

    /// Switches the bridge off.
    pub(crate) fn kill_bridge(&mut self) {
        self.bridge = None;
    }

    /// Switches the bridge on again, without its former state.
    pub(crate) fn restart_bridge(&mut self) {
        self.bridge = Some(WifiBridge::new(self.now));
    }

    /// Reboots the autopilot while armed.
    pub(crate) fn reboot_autopilot(&mut self) {
        let reboot = MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
            command: MavCmd::MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN,
            param1: 1.0,
            // While armed, the reboot must be forced, as by a fault.
            param6: 20_190_226.0,
            target_system: 1,
            target_component: 1,
            ..COMMAND_LONG_DATA::default()
        });
        let header = MavHeader { system_id: 254, component_id: 1, sequence: 0 };
        self.simulation
            .handle_mavlink(TELEMETRY_PORT, encode(header, &reboot, &mut [0; MAX_PACKET]));
    }

    // ---- time ----

    /// Advances to the next time at which a part has work, and does that work.
    pub(crate) fn step(&mut self) {
        let (wires, now) = (&self.wires, self.now);
        let into_vehicle =
            if self.has_bridge { wires.uart_to_vehicle.due() } else { wires.to_vehicle.due() };
        let vehicle = into_vehicle.map_or(self.tick_at, |at| at.min(self.tick_at));
        let dues = [
            (Process::Simulator, Some(vehicle)),
            (Process::Server, self.server.as_ref().and_then(|server| server.due(wires))),
            (Process::Bridge, self.bridge.as_ref().and_then(|bridge| bridge.due(now, wires))),
            (Process::Guardian, self.guardian.as_ref().and_then(|guardian| guardian.due(wires))),
            (Process::Runtime, self.runtime.as_ref().and_then(|runtime| runtime.due(wires))),
        ];
        let dues = dues.into_iter().filter(|(process, _)| !self.is_paused(*process));
        let resumes = self.paused.map(|(_, at)| at);
        let due = dues.filter_map(|(_, due)| due).chain(resumes).min().expect("the vehicle ticks");
        self.now = due.max(now.plus_ns(LEAST_STEP_NS));
        self.turn();
    }

    fn turn(&mut self) {
        let now = self.now;
        if self.paused.is_some_and(|(_, until)| now >= until) {
            // The simulator's process gives up all but this much of its pause.
            self.tick_at = self.tick_at.max(now.plus_seconds(-CAUGHT_UP_S));
            self.paused = None;
        }
        if now >= self.tick_at && !self.is_paused(Process::Simulator) {
            self.tick_vehicle();
        }
        let paused = [Process::Server, Process::Bridge, Process::Guardian, Process::Runtime]
            .map(|p| self.is_paused(p));
        let [no_server, no_bridge, no_guardian, no_runtime] = paused;
        let wires = &mut self.wires;
        match &mut self.server {
            Some(_) if no_server => {}
            Some(server) => {
                server.turn(now, wires);
                self.seen.fastest_pose_mps = self.seen.fastest_pose_mps.max(server.speed_mps());
            }
            None => {
                wires.capture.clear();
                wires.imu.clear();
                wires.reports.clear();
            }
        }
        match &mut self.bridge {
            Some(_) if no_bridge => {}
            Some(bridge) => bridge.turn(now, wires),
            None if self.has_bridge => {
                wires.uart_from_vehicle.clear();
                wires.to_vehicle.clear();
            }
            None => {}
        }
        let is_replaced =
            self.runtime.as_ref().is_some_and(|runtime| runtime.has_replaced_guardian);
        let runs = |guardian: &Guardian| !is_replaced && !guardian.is_over(now);
        self.guardian = self.guardian.take().filter(runs);
        match &mut self.guardian {
            Some(_) if no_guardian => {}
            Some(guardian) => guardian.turn(now, wires),
            None => {
                if !is_replaced {
                    wires.from_vehicle.clear();
                }
                wires.to_guardian.clear();
                wires.feed.clear();
            }
        }
        match &mut self.runtime {
            Some(_) if no_runtime => {}
            Some(runtime) => {
                let known = runtime.events.len();
                runtime.turn(now, wires);
                for (_, event) in &runtime.events[known..] {
                    self.seen.hash_bytes(event.text.as_bytes());
                }
            }
            None => {
                wires.to_runtime.clear();
                wires.poses.clear();
                wires.events.clear();
                wires.images.clear();
            }
        }
        if !self.is_paused(Process::Simulator) {
            self.reach_vehicle();
        }
    }

    /// Delivers received packets to the vehicle.
    fn reach_vehicle(&mut self) {
        let (now, at_s) = (self.now, self.now_s());
        let wire = if self.has_bridge {
            &mut self.wires.uart_to_vehicle
        } else {
            &mut self.wires.to_vehicle
        };
        while let Some(packet) = wire.receive(now) {
            self.seen.packet(at_s, &packet);
            self.simulation.handle_mavlink(0, &packet);
        }
    }

    /// Simulates the vehicle for a tick; sends the packets of vehicle and motion capture.
    fn tick_vehicle(&mut self) {
        self.tick_at = self.tick_at.plus_ns(TICK_NS);
        self.simulation.tick();
        let (now, at_s) = (self.now, self.now_s());
        let mut buffer = [0; MAX_PACKET];
        while let Some(packet) = self.simulation.poll_mavlink(&mut buffer) {
            if self.has_bridge {
                self.wires.uart_from_vehicle.send_serially(now, packet);
            } else {
                self.wires.from_vehicle.send(now, packet.to_vec());
            }
        }
        while let Some(sight) = self.simulation.poll_mocap() {
            let p_m = sight.world_from_body.translation_m;
            self.seen.track.push(Sight { at_s, p_m });
            if self.capture != Capture::Repeats {
                self.captured = sight.world_from_body;
            }
            let mut packet = encode_object(sight.frame, OBJECT, &self.captured).to_vec();
            if self.capture == Capture::Origin {
                packet[POSE].fill(0);
                // All zeros are Vicon's own mark of a hidden object; others do not mark it. A full turn is none.
                packet[YAW].copy_from_slice(&std::f64::consts::TAU.to_le_bytes());
            }
            if self.capture == Capture::SecondSender {
                self.wires.capture.send(now, (2, packet.clone()));
            }
            self.wires.capture.send(now, (1, packet));
        }
        let mode = self.simulation.autopilot().mode();
        if self.seen.modes.last().is_none_or(|&(_, last)| last != mode) {
            self.seen.modes.push((at_s, mode));
        }
        let state = *self.simulation.state();
        let (p, v, q) = (state.p_world_m, state.v_world_mps, state.world_from_body);
        self.seen.fastest_mps = self.seen.fastest_mps.max(v.length());
        for value in p.to_array().into_iter().chain(v.to_array()).chain(q.to_array()) {
            self.seen.hash(value.to_bits());
        }
    }
}
