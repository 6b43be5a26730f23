//! A lab for several simultaneous flights: one render server, and for each flight a simulated vehicle and a runtime,
//! all real processes. The motion capture's packets and the vehicle's MAVLink pass through this test. It therefore
//! knows the position of each vehicle independently of the runtime, and can cut both links.
//!
//! Used by `misbehave`, `linkloss` and `chain`; none uses everything.

#![allow(dead_code)]

use std::fs;
use std::io::{BufRead, BufReader};
use std::net::{SocketAddr, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use glam::DVec3;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;
use vizflyt_e2e::{Load, vizflyt};
use vizflyt_protocol::mavlink::StreamDecoder;
use vizflyt_protocol::mavlink::dialect::{MavCmd, MavMessage};
use vizflyt_trust::{Client, Fingerprint, Identity, KeysFolder, Owner, Paired, Role};

/// One render server for all flights of the test.
pub(crate) struct Lab {
    folder: tempfile::TempDir,
    server: Process,
    quic: String,
    fingerprint: Fingerprint,
    vicon: String,
    /// Packet counter of all vehicles, as in one motion capture.
    packets: Arc<AtomicU32>,
}

/// Links of the vehicle that can be cut; true means cut.
#[derive(Default)]
pub(crate) struct Cuts {
    /// Poses from the motion capture to the server.
    pub poses: AtomicBool,
    /// MAVLink in both directions.
    pub mavlink: AtomicBool,
}

/// Settings of a flight.
#[derive(Clone, Copy, Default)]
pub(crate) struct Plan<'a> {
    /// Request to the plugin.
    pub how: &'static str,
    /// Lines of jetson.toml under `[plugin]`; other tables may follow.
    pub settings: &'a str,
    /// Additional arguments for the runtime.
    pub more: &'a [&'a str],
    /// Additional arguments for the simulated vehicle, before the runtime's link.
    pub vehicle: &'a [&'a str],
    /// MAVLink goes through an emulated bridge.
    pub bridge: bool,
}

/// An emulated bridge.
struct Bridge {
    process: Process,
    /// Arguments of the process.
    args: Vec<String>,
    /// Path of its end of the serial line.
    uart: PathBuf,
}

/// Lines of the runtime, with their times of arrival.
pub(crate) type Lines = Vec<(Instant, Value)>;

/// A running flight.
pub(crate) struct Flight {
    /// Request to the plugin.
    pub how: &'static str,
    simulator: Process,
    /// `ready` line of the simulator.
    vehicle: Value,
    bridge: Option<Bridge>,
    runtime: Process,
    track: Track,
    /// Modes from the vehicle's own heartbeats.
    modes: Modes,
    /// Times of the runtime's LAND commands.
    lands: Lands,
    /// Number of poses sent by the guardian.
    guardian_poses: Arc<AtomicU32>,
    cuts: Arc<Cuts>,
    /// Link to the vehicle that bypasses the runtime.
    aside: Aside,
    report: PathBuf,
}

/// Observations of a flight.
pub(crate) struct Seen {
    /// JSON lines of the runtime, with their times.
    pub lines: Lines,
    /// Positions by motion capture, also while its poses are cut. [m, world]
    pub track: Vec<Sight>,
    /// Modes of the vehicle, with their start.
    pub modes: Vec<(Instant, u32)>,
    /// The runtime's report.
    pub report: Value,
}

/// One pose of the motion capture.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sight {
    /// Time of arrival.
    pub at: Instant,
    /// Time of the measurement on the simulator's clock. [s]
    pub stamp_s: f64,
    /// Position of the vehicle. [m, world]
    pub p_m: DVec3,
}

type Track = Arc<Mutex<Vec<Sight>>>;
type Modes = Arc<Mutex<Vec<(Instant, u32)>>>;
type Lands = Arc<Mutex<Vec<Instant>>>;

/// A link to the vehicle in parallel to the runtime's.
struct Aside {
    socket: UdpSocket,
    vehicle: Arc<Mutex<Option<SocketAddr>>>,
}

/// Default source of poses, in the format of arena.toml's last table.
pub(crate) const LOCALIZATION: &str =
    "\n[[localization]]\ndriver = \"vicon\"\naddress = \"127.0.0.1:0\"\n";
/// Timeout, for any load of the machine.
const PATIENCE: Duration = Duration::from_mins(2);

/// A child process that prints JSON lines; killed when dropped.
struct Process {
    child: Child,
    lines: Receiver<(Instant, Value)>,
}

impl Process {
    fn start(program: &Path, args: &[String]) -> Self {
        let mut child = Command::new(program)
            .args(args)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap_or_else(|error| panic!("{}: {error}", program.display()));
        let stdout = BufReader::new(child.stdout.take().unwrap());
        let (sender, lines) = channel();
        thread::spawn(move || {
            for line in stdout.lines().map_while(Result::ok) {
                let value = serde_json::from_str(&line).unwrap_or(Value::String(line));
                let _ = sender.send((Instant::now(), value));
            }
        });
        Self { child, lines }
    }

    /// Returns the `ready` line.
    fn ready(&self) -> Value {
        loop {
            let (_, line) = self.lines.recv_timeout(PATIENCE).expect("a ready line");
            if line["ready"].is_string() {
                return line;
            }
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Lab {
    /// Starts a server with a room and these vehicles.
    pub(crate) fn open(vehicles: usize) -> Self {
        Self::open_with(vehicles, LOCALIZATION)
    }

    /// Starts a server with a room and these vehicles, with additional tables in its arena.toml.
    pub(crate) fn open_with(vehicles: usize, tables: &str) -> Self {
        // Put the fence near the start: the flights are short.
        Self::open_in(vehicles, |folder| {
            let arena = folder.join("arena.toml");
            let text = fs::read_to_string(&arena).unwrap();
            let text = text
                .replace("max_m = [11.0,", "max_m = [2.6,")
                .replace("[goal]\nposition_m = [10.0,", "[goal]\nposition_m = [2.3,")
                .replace("radius_m = 0.6", "radius_m = 0.01");
            fs::write(&arena, text + tables).unwrap();
        })
    }

    /// Starts a server with a room and these vehicles; `furnish` changes the room's folder.
    pub(crate) fn open_in(vehicles: usize, furnish: impl FnOnce(&Path)) -> Self {
        let folder = tempfile::tempdir().unwrap();
        // If this is root, the plugins run as another user.
        let mode = std::os::unix::fs::PermissionsExt::from_mode(0o755);
        fs::set_permissions(folder.path(), mode).unwrap();
        let at = |name: &str| folder.path().join(name);
        let scene = at("scene").to_str().unwrap().to_owned();
        let made =
            Command::new(vizflyt()).args(["scene", "generate", "room", "-o", &scene]).output();
        assert!(made.unwrap().status.success());
        furnish(&at("scene"));
        // Small images, because several vehicles fly on one computer.
        let arena = at("scene").join("arena.toml");
        let text = fs::read_to_string(&arena).unwrap();
        let text = text
            .replace("width_px = 320", "width_px = 96")
            .replace("height_px = 240", "height_px = 72");
        let source = if text.contains("[[localization]]") { "" } else { LOCALIZATION };
        fs::write(&arena, text + source).unwrap();

        let keys = KeysFolder::open(Some(&at("server"))).unwrap();
        let fingerprint = Identity::load_or_create(&keys, Owner::Server).unwrap().fingerprint();
        let names: Vec<String> = (0..vehicles).map(name).collect();
        for name in &names {
            let own = KeysFolder::open(Some(&at(name))).unwrap();
            let fingerprint = Identity::load_or_create(&own, Owner::Runtime).unwrap().fingerprint();
            let vehicles = vec![name.clone()];
            let client = Client { name: name.clone(), fingerprint, role: Role::Team, vehicles };
            Paired::add(&keys, client).unwrap();
        }
        let mut args = words("serve --json --lifeline --quic=127.0.0.1:0 --http=127.0.0.1:0");
        args.extend(words("--renderer=cpu --max-rate=20"));
        args.push(arena.to_str().unwrap().to_owned());
        args.push(format!("--keys={}", at("server").display()));
        args.push("--leaderboard=none".into());
        // All vehicles start at one place, each in its own net.
        args.push("--apart".into());
        args.extend(names.iter().map(|name| format!("--vehicle={name}")));
        let server = Process::start(&vizflyt(), &args);
        let ready = server.ready();
        let text = |key: &str| ready[key].as_str().unwrap().to_owned();
        let (quic, vicon) = (text("quic"), text("vicon"));
        Self { folder, server, quic, fingerprint, vicon, packets: Arc::default() }
    }

    /// Flies vehicle `index`.
    pub(crate) fn fly(&self, index: usize, plan: Plan<'_>) -> Flight {
        let Plan { how, settings, more, vehicle, bridge } = plan;
        let name = name(index);
        let at = |kind: &str| self.folder.path().join(format!("{name}-{kind}"));
        let config = at("jetson.toml");
        // Remaining faults, for a plugin that is restarted; the plugin's user writes this folder.
        let left = at("left");
        let _ = fs::remove_dir_all(&left);
        fs::create_dir(&left).unwrap();
        let mode = std::os::unix::fs::PermissionsExt::from_mode(0o777);
        fs::set_permissions(&left, mode).unwrap();
        let writes = format!("write = ['{}']", left.display());
        fs::write(&config, format!("[plugin]\n{writes}\n{settings}\n")).unwrap();
        let track = Track::default();
        let cuts = Arc::new(Cuts::default());
        let capture = self.capture(Arc::clone(&track), Arc::clone(&cuts));

        let plugin = vizflyt().with_file_name("examples").join("misbehave");
        let mut args = words("--json --lifeline --mavlink=udpin:127.0.0.1:0 --ready-within=100");
        args.push(format!("--server={}", self.quic));
        args.push(format!("--fingerprint={}", self.fingerprint));
        args.push(format!("--keys={}", self.folder.path().join(&name).display()));
        args.push(format!("--vehicle={name}"));
        args.push(format!("--config={}", config.display()));
        args.push(format!("--report={}", at("report").display()));
        args.push(format!("--log-dir={}", at("log").display()));
        args.extend(more.iter().map(|&text| text.to_owned()));
        args.push(plugin.to_str().unwrap().to_owned());
        args.extend(["--".to_owned(), how.to_owned()]);
        args.push(left.join("to-do").display().to_string());
        let runtime = Process::start(&vizflyt().with_file_name("vizflyt-jetson"), &args);
        let mavlink = runtime.ready()["mavlink"].as_str().unwrap().to_owned();

        let (modes, lands) = (Modes::default(), Lands::default());
        let guardian_poses = Arc::<AtomicU32>::default();
        let seen = (Arc::clone(&modes), Arc::clone(&lands), Arc::clone(&guardian_poses));
        let (air, aside) = carry(mavlink, seen, Arc::clone(&cuts));
        let bridge = bridge.then(|| {
            let mut args = words("bridge emulate --json --lifeline --listen=127.0.0.1:0");
            args.push(format!("--client={air}"));
            args.push(format!("--uart=pty:{}", at("uart").display()));
            let process = Process::start(&vizflyt(), &args);
            process.ready();
            Bridge { process, args, uart: at("uart") }
        });
        let mut args = words("sim --json --lifeline --spawn=0.9,0,0,0");
        args.extend(vehicle.iter().map(|&text| text.to_owned()));
        args.push(match &bridge {
            Some(bridge) => format!("--serial={}", bridge.uart.display()),
            None => format!("--mavlink=udpout:{air}"),
        });
        args.push(format!("--vicon={capture}"));
        args.extend([format!("--object={name}"), format!("--seed={index}")]);
        let simulator = Process::start(&vizflyt(), &args);
        let vehicle = simulator.ready();
        Flight {
            how,
            simulator,
            vehicle,
            bridge,
            runtime,
            track,
            modes,
            lands,
            guardian_poses,
            cuts,
            aside,
            report: at("report"),
        }
    }

    /// Returns an address whose packets are recorded and forwarded to the server.
    fn capture(&self, track: Track, cuts: Arc<Cuts>) -> SocketAddr {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        let address = socket.local_addr().unwrap();
        let (server, packets) = (self.vicon.clone(), Arc::clone(&self.packets));
        thread::spawn(move || {
            let mut packet = [0; 512];
            // Runs until the process ends.
            while let Ok(len) = socket.recv(&mut packet) {
                let frame = u32::from_le_bytes(packet[..4].try_into().unwrap());
                let number = packets.fetch_add(1, Ordering::Relaxed);
                packet[..4].copy_from_slice(&number.to_le_bytes());
                if !cuts.poses.load(Ordering::Relaxed) {
                    let _ = socket.send_to(&packet[..len], &server);
                }
                // Vicon's object stream: three doubles in millimetres follow the name.
                let mm = |axis: usize| {
                    let at = 32 + 8 * axis;
                    f64::from_le_bytes(packet[at..at + 8].try_into().unwrap())
                };
                let p_m = DVec3::new(mm(0), mm(1), mm(2)) / 1000.0;
                let stamp_s = f64::from(frame) / CAPTURE_HZ;
                lock(&track).push(Sight { at: Instant::now(), stamp_s, p_m });
            }
        });
        address
    }

    /// Kills the server.
    pub(crate) fn kill_server(&mut self) {
        let _ = self.server.child.kill();
        let _ = self.server.child.wait();
    }

    /// Returns whether the server still runs.
    pub(crate) fn lives(&mut self) -> bool {
        self.server.child.try_wait().unwrap().is_none()
    }
}

impl Flight {
    /// Waits until the runtime prints a line that contains `text`; returns all lines up to it.
    pub(crate) fn until(&mut self, text: &str) -> Lines {
        let how = self.how;
        self.try_until(text)
            .unwrap_or_else(|lines| panic!("{how}: no line with {text}: {lines:#?}"))
    }

    /// Like [`Self::until`]; `None` if the machine was too busy for the flight, by the measurement `load`.
    pub(crate) fn until_unless_busy(&mut self, text: &str, load: &Load) -> Option<Lines> {
        match self.try_until(text) {
            Ok(lines) => Some(lines),
            Err(lines) => {
                assert!(load.is_too_high(), "{}: no line with {text}: {lines:#?}", self.how);
                println!(
                    "the machine is too busy: a safety rule landed the vehicle before the test began"
                );
                None
            }
        }
    }

    /// Waits for a line with `text`; returns all lines up to it, or all of the flight's if there is none.
    fn try_until(&mut self, text: &str) -> Result<Lines, Lines> {
        let mut lines = Vec::new();
        let deadline = Instant::now() + PATIENCE;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let Ok(line) = self.runtime.lines.recv_timeout(left) else {
                return Err(lines);
            };
            let is_it = line.1.to_string().contains(text);
            lines.push(line);
            if is_it {
                return Ok(lines);
            }
        }
    }

    /// Returns the links that can be cut.
    pub(crate) fn cuts(&self) -> &Cuts {
        &self.cuts
    }

    /// Kills the runtime and its plugin, but not its guardian.
    pub(crate) fn kill_runtime(&mut self) {
        let _ = self.runtime.child.kill();
    }

    /// Stops the runtime, as if it hangs.
    pub(crate) fn stop_runtime(&self) {
        let _ = kill(Pid::from_raw(self.runtime.child.id().cast_signed()), Signal::SIGSTOP);
    }

    /// Sends a signal to the guardian.
    pub(crate) fn signal_guardian(&self, signal: Signal) {
        let _ = kill(self.guardian(), signal);
    }

    /// Kills the runtime and its guardian, as if the Jetson were off.
    pub(crate) fn switch_off(&mut self) {
        self.signal_guardian(Signal::SIGKILL);
        let _ = self.runtime.child.kill();
    }

    fn guardian(&self) -> Pid {
        let runtime = self.runtime.child.id();
        let children = format!("/proc/{runtime}/task/{runtime}/children");
        let children = fs::read_to_string(children).expect("the runtime runs");
        let is_guardian = |pid: &&str| {
            let line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
            line.split(|byte| *byte == 0).nth(1) == Some(b"guardian")
        };
        let guardian = children.split_whitespace().find(is_guardian).expect("it has a guardian");
        Pid::from_raw(guardian.parse().expect("a number"))
    }

    /// Stops the bridge, as if it hangs.
    pub(crate) fn stop_bridge(&self) {
        let bridge = self.bridge.as_ref().expect("it flies through a bridge");
        let _ = kill(Pid::from_raw(bridge.process.child.id().cast_signed()), Signal::SIGSTOP);
    }

    /// Kills the bridge like a power cut, and removes its serial device.
    pub(crate) fn kill_bridge(&mut self) {
        let bridge = self.bridge.as_mut().expect("it flies through a bridge");
        let _ = bridge.process.child.kill();
        let _ = bridge.process.child.wait();
        // The kernel gives its number to the next pseudo-terminal, which belongs to another vehicle.
        let _ = fs::remove_file(&bridge.uart);
    }

    /// Restarts the bridge.
    pub(crate) fn restart_bridge(&mut self) {
        let bridge = self.bridge.as_mut().expect("it flies through a bridge");
        bridge.process = Process::start(&vizflyt(), &bridge.args);
        bridge.process.ready();
    }

    /// Returns the address or path of the vehicle's link `index`.
    pub(crate) fn link(&self, index: usize) -> &str {
        self.vehicle["links"][index].as_str().expect("the vehicle has this link")
    }

    /// Ends the simulator; returns its report.
    pub(crate) fn vehicle_report(&mut self) -> Value {
        drop(self.simulator.child.stdin.take());
        loop {
            let (_, line) = self.simulator.lines.recv_timeout(PATIENCE).expect("a report");
            if line.get("report").is_some() {
                return line["report"].clone();
            }
        }
    }

    /// Sends a packet to the vehicle, bypassing the runtime.
    pub(crate) fn tell_vehicle(&self, packet: &[u8]) {
        let vehicle = lock(&self.aside.vehicle).expect("the vehicle has sent a packet");
        self.aside.socket.send_to(packet, vehicle).unwrap();
    }

    /// Returns the time of the runtime's first LAND command, if any.
    pub(crate) fn ordered_to_land(&self) -> Option<Instant> {
        lock(&self.lands).first().copied()
    }

    /// Returns the number of poses that the guardian has sent.
    pub(crate) fn guardian_poses(&self) -> u32 {
        self.guardian_poses.load(Ordering::Relaxed)
    }

    /// Returns the newest pose.
    pub(crate) fn now(&self) -> Sight {
        *lock(&self.track).last().expect("the motion capture runs")
    }

    /// Returns the observations so far, without waiting for the runtime.
    pub(crate) fn so_far(&self) -> (Vec<Sight>, Vec<(Instant, u32)>) {
        (lock(&self.track).clone(), lock(&self.modes).clone())
    }

    /// Waits for the end of the flight; returns the observations.
    pub(crate) fn wait(mut self) -> Seen {
        let mut lines = Vec::new();
        let deadline = Instant::now() + PATIENCE;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.runtime.lines.recv_timeout(left) {
                Ok(line) => lines.push(line),
                Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => panic!("{} flies on: {lines:#?}", self.how),
            }
        }
        let _ = self.runtime.child.wait();
        let report = fs::read_to_string(&self.report).unwrap_or_else(|_| panic!("{lines:#?}"));
        let report = serde_json::from_str(&report).unwrap();
        let (track, modes) = self.so_far();
        drop(self.simulator);
        Seen { lines, track, modes, report }
    }
}

impl Seen {
    /// Returns the time of the runtime's first line that contains `text`.
    pub(crate) fn when(&self, text: &str) -> Option<Instant> {
        let line = self.lines.iter().find(|(_, line)| line.to_string().contains(text));
        line.map(|&(at, _)| at)
    }

    /// Returns the number of events and plugin lines that contain `text`.
    pub(crate) fn count(&self, text: &str) -> usize {
        self.lines.iter().filter(|(_, line)| line.to_string().contains(text)).count()
    }

    /// Returns the vehicle's speed after `at`, over 0.2 s. [m/s]
    fn speed_mps(&self, at: Instant) -> f64 {
        let near = |at: Instant| self.track.iter().find(|sight| sight.at >= at);
        let (Some(a), Some(b)) = (near(at), near(at + Duration::from_millis(200))) else {
            return 0.0;
        };
        let seconds = b.at.saturating_duration_since(a.at).as_secs_f64();
        if seconds > 0.0 { (b.p_m - a.p_m).length() / seconds } else { 0.0 }
    }

    /// Returns the time from `since` until the vehicle first stopped or only descended; `None` if it never did.
    pub(crate) fn stopped_after(&self, since: Instant) -> Option<Duration> {
        let level = |at: Instant| {
            let near = |at: Instant| self.track.iter().find(|sight| sight.at >= at);
            let (Some(a), Some(b)) = (near(at), near(at + Duration::from_millis(200))) else {
                return 0.0;
            };
            (b.p_m - a.p_m).truncate().length() / 0.2
        };
        (0..200).map(|n| Duration::from_millis(50) * n).find(|&after| level(since + after) < 0.15)
    }

    /// Returns height and speed at the end. [m; m/s]
    pub(crate) fn end(&self) -> (f64, f64) {
        let Some(&Sight { at, p_m, .. }) = self.track.last() else {
            return (f64::NAN, f64::NAN);
        };
        let before = at.checked_sub(Duration::from_millis(400)).expect("the flight took longer");
        (p_m.z, self.speed_mps(before))
    }
}

/// Forwards MAVLink between a vehicle, which sends to the returned address, and the runtime at `runtime`.
fn carry(
    runtime: String,
    (modes, lands, guardian_poses): (Modes, Lands, Arc<AtomicU32>),
    cuts: Arc<Cuts>,
) -> (SocketAddr, Aside) {
    let to_vehicle = UdpSocket::bind("127.0.0.1:0").unwrap();
    let to_runtime = UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = to_vehicle.local_addr().unwrap();
    let vehicle = Arc::new(Mutex::new(None));
    let aside = Aside { socket: to_vehicle.try_clone().unwrap(), vehicle: Arc::clone(&vehicle) };
    let is_open = move |cuts: &Cuts| !cuts.mavlink.load(Ordering::Relaxed);
    let (from_runtime, up) = (to_runtime.try_clone().unwrap(), to_vehicle.try_clone().unwrap());
    let (known, open) = (Arc::clone(&vehicle), Arc::clone(&cuts));
    // Both threads run until the process ends.
    thread::spawn(move || {
        let mut packet = [0; 2048];
        let mut decoder = StreamDecoder::default();
        loop {
            // A runtime that has ended causes a connection error: continue.
            let Ok(len) = from_runtime.recv(&mut packet) else { continue };
            decoder.push(&packet[..len], |packet| match packet.message {
                MavMessage::COMMAND_LONG(command)
                    if command.command == MavCmd::MAV_CMD_NAV_LAND =>
                {
                    lock(&lands).push(Instant::now());
                }
                MavMessage::VISION_POSITION_ESTIMATE(_)
                    if packet.header.component_id == GUARDIAN =>
                {
                    guardian_poses.fetch_add(1, Ordering::Relaxed);
                }
                _ => {}
            });
            if let (true, Some(vehicle)) = (is_open(&open), *lock(&known)) {
                let _ = up.send_to(&packet[..len], vehicle);
            }
        }
    });
    thread::spawn(move || {
        let mut packet = [0; 2048];
        let mut decoder = StreamDecoder::default();
        loop {
            let Ok((len, from)) = to_vehicle.recv_from(&mut packet) else { continue };
            *lock(&vehicle) = Some(from);
            decoder.push(&packet[..len], |packet| {
                let MavMessage::HEARTBEAT(heartbeat) = packet.message else { return };
                let mut modes = lock(&modes);
                if modes.last().is_none_or(|&(_, mode)| mode != heartbeat.custom_mode) {
                    modes.push((Instant::now(), heartbeat.custom_mode));
                }
            });
            if is_open(&cuts) {
                let _ = to_runtime.send_to(&packet[..len], &runtime);
            }
        }
    });
    (address, aside)
}

/// Component id of the guardian.
const GUARDIAN: u8 = 192;
/// Rate of the simulated motion capture. [Hz]
const CAPTURE_HZ: f64 = 200.0;

fn name(index: usize) -> String {
    format!("m{index}")
}

fn words(text: &str) -> Vec<String> {
    text.split(' ').map(str::to_owned).collect()
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
