//! Test peers of the server: a scene, a Vicon emitter, a runtime, a browser.
//!
//! All waits are for conditions; [`PATIENCE`] only limits a failing test.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream, UdpSocket};
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::mpsc;
use std::thread::JoinHandle;
use std::time::Duration;

use glam::{Quat, Vec3};
use quinn::{ClientConfig, Connection, Endpoint, RecvStream, SendStream, TransportConfig, VarInt};
use serde_json::Value;
use tempfile::TempDir;
use vizflyt_fixtures::{TEXT, WebSocket};
use vizflyt_protocol::messages::{
    ArenaInfo, Datagram, Hello, PoseSample, Purpose, ReceivedEvents, ToRuntime, ToServer, Welcome,
    bounded,
};
use vizflyt_protocol::packet::framing::{Deframer, MAX_FRAMED, decode_body, encode};
use vizflyt_protocol::packet::{ImageHeader, ImageTrailer, PeerRole, Preamble};
use vizflyt_splat::{Splats, ply};
use vizflyt_trust::tls::Pin;
use vizflyt_trust::{ALPN, Fingerprint, Identity, KeysFolder, Owner, Paired, Role};
use zerocopy::IntoBytes;

/// Timeout of a failing test; never affects a passing one.
pub(crate) const PATIENCE: Duration = Duration::from_mins(1);

/// Writes an arena whose scene is a wall of splats at x = 5 m, and returns the path of its arena.toml.
pub(crate) fn write_arena(folder: &Path, more: &str) -> std::path::PathBuf {
    let mut means = Vec::new();
    for y in -30..=30 {
        for z in 0..=30 {
            means.push(Vec3::new(5.0, y as f32 * 0.1, z as f32 * 0.1));
        }
    }
    let count = means.len();
    let splats = Splats {
        means_m: means,
        scales_m: vec![Vec3::new(0.02, 0.08, 0.08); count],
        rotations: vec![Quat::IDENTITY; count],
        opacities: vec![0.98; count],
        sh_degree: 0,
        sh: (0..count * 3).map(|k| if k % 3 == 0 { 1.2 } else { 0.1 }).collect(),
        antialiased: false,
    };
    ply::write(folder.join("scene.ply"), &splats).unwrap();
    let path = folder.join("arena.toml");
    let text = format!(
        r#"
name = "wall"
scene = "scene.ply"
body_radius_m = 0.12
takeoff_height_m = 1.2
spawn = {{ position_m = [0, 0, 0] }}
geofence = {{ min_m = [-20, -4, -0.5], max_m = [6, 4, 4] }}
limits = {{ max_speed_mps = 6.0, max_acceleration_mps2 = 8.0 }}
[[cameras]]
name = "front"
width_px = 160
height_px = 120
horizontal_fov_deg = 90.0
position_m = [0.06, 0, 0.02]
{more}
"#
    );
    std::fs::write(&path, text).unwrap();
    path
}

/// A running server process.
pub(crate) struct Server {
    child: Child,
    stdin: Option<ChildStdin>,
    lines: mpsc::Receiver<Value>,
    pub(crate) quic: SocketAddr,
    pub(crate) http: SocketAddr,
    pub(crate) vicon: SocketAddr,
    /// The `ready` line.
    pub(crate) ready: Value,
    /// Identity of an instructor, paired before the start.
    pub(crate) instructor: Identity,
    keys: TempDir,
}

impl Server {
    /// Starts a server on free ports and waits until it is ready.
    pub(crate) fn start(arena: &Path, more: &[&str]) -> Self {
        Self::start_paired(arena, more, &[])
    }

    /// As [`Self::start`], with other paired clients in addition to the instructor.
    pub(crate) fn start_paired(
        arena: &Path,
        more: &[&str],
        others: &[vizflyt_trust::Client],
    ) -> Self {
        let keys = tempfile::tempdir().unwrap();
        let folder = KeysFolder::open(Some(&keys.path().join("keys"))).unwrap();
        let instructor = Identity::ephemeral().unwrap();
        let client = client(&instructor, Role::Instructor, &[]);
        for client in others.iter().cloned().chain([client]) {
            Paired::add(&folder, client).unwrap();
        }
        // A test may set another keys folder.
        let own_keys = (!more.iter().any(|option| option.starts_with("--keys")))
            .then(|| format!("--keys={}", keys.path().join("keys").display()));
        let nowhere = (!more.iter().any(|option| option.starts_with("--leaderboard")))
            .then_some("--leaderboard=none");
        let free = "127.0.0.1:0";
        let mut child = Command::new(env!("CARGO_BIN_EXE_vizflyt-server"))
            .arg(arena)
            .args(["--json", "--lifeline", "--quic", free, "--http", free, "--vicon", free])
            .args(more)
            .args(own_keys)
            .args(nowhere)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let (sender, lines) = mpsc::channel();
        let stdout = BufReader::new(child.stdout.take().unwrap());
        std::thread::spawn(move || {
            for line in stdout.lines().map_while(Result::ok) {
                let value: Value = serde_json::from_str(&line).expect("every line is JSON");
                if sender.send(value).is_err() {
                    break;
                }
            }
        });
        let ready = lines.recv_timeout(PATIENCE).expect("the server is ready");
        let at = |key: &str| ready[key].as_str().unwrap().to_owned();
        assert_eq!(at("ready"), "server");
        Self {
            stdin: child.stdin.take(),
            child,
            lines,
            quic: at("quic").parse().unwrap(),
            http: at("http").split_once("://").unwrap().1.parse().unwrap(),
            vicon: at("vicon").parse().unwrap(),
            ready,
            instructor,
            keys,
        }
    }

    /// Returns the process id.
    pub(crate) fn id(&self) -> u32 {
        self.child.id()
    }

    /// Returns the server's keys folder.
    pub(crate) fn keys(&self) -> KeysFolder {
        KeysFolder::open(Some(&self.keys.path().join("keys"))).unwrap()
    }

    /// Returns the server's fingerprint.
    pub(crate) fn fingerprint(&self) -> Fingerprint {
        Identity::load_or_create(&self.keys(), Owner::Server).unwrap().fingerprint()
    }

    /// Returns the next line of standard output for which `wanted` yields something.
    pub(crate) fn line<T>(&self, mut wanted: impl FnMut(&Value) -> Option<T>) -> T {
        loop {
            let line = self.lines.recv_timeout(PATIENCE).expect("a line of standard output");
            if let Some(found) = wanted(&line) {
                return found;
            }
        }
    }

    /// Closes standard input (the lifeline) and returns the report; the server must then end.
    pub(crate) fn finish(mut self) -> Value {
        drop(self.stdin.take());
        let report = self.line(|line| line.get("report").cloned());
        assert!(self.child.wait().unwrap().success());
        report
    }

    pub(crate) fn terminate(&self) {
        let done = Command::new("kill").arg(self.child.id().to_string()).status().unwrap();
        assert!(done.success());
    }

    /// Kills the process, like a power cut.
    pub(crate) fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Waits for the end and returns the exit status.
    pub(crate) fn wait(mut self) -> std::process::ExitStatus {
        self.child.wait().unwrap()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Sends poses at about 200 Hz: level, nose along x.
pub(crate) struct Emitter {
    stop: Arc<AtomicBool>,
    paused: Arc<AtomicBool>,
    pub(crate) sent: Arc<AtomicU32>,
    thread: Option<JoinHandle<()>>,
}

/// Distance that the emitter's vehicle moves back per frame. [m]
pub(crate) const STEP_M: f64 = 0.001;
/// Height of the emitter's vehicle. [m]
pub(crate) const HEIGHT_M: f64 = 1.5;

impl Emitter {
    /// Starts; frame n is at x = -n * `STEP_M`.
    pub(crate) fn start(to: SocketAddr, object: &'static str) -> Self {
        Self::along(to, object, |frame| -f64::from(frame) * STEP_M)
    }

    /// Starts; frame n is at x = `x_m(n)`.
    pub(crate) fn along(to: SocketAddr, object: &'static str, x_m: fn(u32) -> f64) -> Self {
        let (stop, paused) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
        let sent = Arc::new(AtomicU32::new(0));
        let (stop2, paused2, sent2) = (stop.clone(), paused.clone(), sent.clone());
        let thread = std::thread::spawn(move || {
            let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
            let mut frame = 0u32;
            while !stop2.load(Ordering::Relaxed) {
                if !paused2.load(Ordering::Relaxed) {
                    frame += 1;
                    // Measurements in the air never repeat.
                    let noise_mm = 1e-6 * f64::from(frame % 3);
                    let values = [x_m(frame) * 1e3, noise_mm, HEIGHT_M * 1e3, 0.0, 0.0, 0.0];
                    let _ = socket.send_to(&vicon_packet(frame, object, values), to);
                    sent2.store(frame, Ordering::Relaxed);
                }
                std::thread::sleep(Duration::from_millis(5));
            }
        });
        Self { stop, paused, sent, thread: Some(thread) }
    }

    pub(crate) fn pause(&self, paused: bool) {
        self.paused.store(paused, Ordering::Relaxed);
    }
}

impl Drop for Emitter {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Returns a packet of Vicon Tracker's UDP object stream with one object. [mm, rad]
pub(crate) fn vicon_packet(frame: u32, object: &str, values: [f64; 6]) -> Vec<u8> {
    let mut bytes = frame.to_le_bytes().to_vec();
    bytes.extend_from_slice(&[1, 0, 72, 0]);
    let mut name = [0u8; 24];
    name[..object.len()].copy_from_slice(object.as_bytes());
    bytes.extend_from_slice(&name);
    bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    bytes
}

pub(crate) struct Client {
    pub(crate) connection: Connection,
    pub(crate) send: SendStream,
    pub(crate) recv: RecvStream,
    deframer: Deframer,
    endpoint: Endpoint,
}

/// Returns an entry of `paired.toml`.
pub(crate) fn client(identity: &Identity, role: Role, vehicles: &[&str]) -> vizflyt_trust::Client {
    vizflyt_trust::Client {
        name: format!("{role:?}").to_lowercase(),
        fingerprint: identity.fingerprint(),
        role,
        vehicles: vehicles.iter().map(ToString::to_string).collect(),
    }
}

/// Returns the first message of a client that has just started.
pub(crate) fn hello(vehicle: &str, purpose: Purpose) -> Hello {
    static BOOTS: AtomicU64 = AtomicU64::new(1);
    Hello {
        vehicle: bounded(vehicle),
        purpose,
        program: bounded("test 1"),
        boot: BOOTS.fetch_add(1, Ordering::Relaxed),
        received_events: ReceivedEvents::default(),
    }
}

/// Connects, without sending a message.
pub(crate) async fn connect(
    server: &Server,
    transport: TransportConfig,
) -> Result<Connection, String> {
    connect_as(server, &server.instructor, transport).await.map(|(_, connection)| connection)
}

/// As [`connect`], with another identity.
pub(crate) async fn connect_as(
    server: &Server,
    identity: &Identity,
    transport: TransportConfig,
) -> Result<(Endpoint, Connection), String> {
    let tls = Pin::to(server.fingerprint()).client_config(identity, ALPN).unwrap();
    let quic = quinn::crypto::rustls::QuicClientConfig::try_from(tls).unwrap();
    let mut config = ClientConfig::new(Arc::new(quic));
    config.transport_config(Arc::new(transport));
    let endpoint = Endpoint::client("127.0.0.1:0".parse().unwrap()).unwrap();
    let connecting = endpoint.connect_with(config, server.quic, "vizflyt").unwrap();
    let connection = connecting.await.map_err(|error| error.to_string())?;
    Ok((endpoint, connection))
}

impl Client {
    /// Connects, exchanges preambles and sends a hello for `vehicle`, as a runtime that has just started.
    pub(crate) async fn hello(server: &Server, vehicle: &str, transport: TransportConfig) -> Self {
        Self::hello_as(server, &server.instructor, vehicle, transport).await
    }

    /// As [`Self::hello`], with another paired identity.
    pub(crate) async fn hello_as(
        server: &Server,
        identity: &Identity,
        vehicle: &str,
        transport: TransportConfig,
    ) -> Self {
        Self::greet_as(server, identity, hello(vehicle, Purpose::Fly), transport).await
    }

    /// Connects, exchanges preambles and sends `hello`.
    pub(crate) async fn greet(server: &Server, hello: Hello, transport: TransportConfig) -> Self {
        Self::greet_as(server, &server.instructor, hello, transport).await
    }

    async fn greet_as(
        server: &Server,
        identity: &Identity,
        hello: Hello,
        transport: TransportConfig,
    ) -> Self {
        let (endpoint, connection) = connect_as(server, identity, transport).await.unwrap();
        let (mut send, mut recv) = connection.open_bi().await.unwrap();
        send.write_all(Preamble::of(PeerRole::Runtime).as_bytes()).await.unwrap();
        let mut theirs = [0; Preamble::SIZE];
        recv.read_exact(&mut theirs).await.unwrap();
        assert_eq!(Preamble::check(&theirs, PeerRole::Runtime), Ok(PeerRole::Server));
        let mut client = Self { connection, send, recv, deframer: Deframer::default(), endpoint };
        client.send(&ToServer::Hello(hello)).await;
        client
    }

    /// Connects and is welcomed.
    pub(crate) async fn welcomed(server: &Server, transport: TransportConfig) -> (Self, ArenaInfo) {
        Self::welcomed_to(server, "vizflyt", transport).await
    }

    /// As [`Self::welcomed`], to another vehicle.
    pub(crate) async fn welcomed_to(
        server: &Server,
        vehicle: &str,
        transport: TransportConfig,
    ) -> (Self, ArenaInfo) {
        let mut client = Self::hello(server, vehicle, transport).await;
        let arena = client.welcome().await.arena;
        (client, arena)
    }

    /// Connects as a watcher and is welcomed.
    pub(crate) async fn watching(server: &Server, transport: TransportConfig) -> Self {
        let hello = hello("vizflyt", Purpose::Watch);
        let mut client = Self::greet(server, hello, transport).await;
        client.welcome().await;
        client
    }

    pub(crate) async fn welcome(&mut self) -> Welcome {
        match self.next().await {
            ToRuntime::Welcome(welcome) => welcome,
            other => panic!("not welcomed: {other:?}"),
        }
    }

    /// Returns the next pose.
    pub(crate) async fn pose(&self) -> PoseSample {
        let datagram = tokio::time::timeout(PATIENCE, self.connection.read_datagram());
        let bytes = datagram.await.expect("a pose").expect("the connection lives");
        let Datagram::Pose(pose) = decode_body(&bytes).unwrap();
        pose
    }

    pub(crate) async fn send(&mut self, message: &ToServer) {
        self.send.write_all(encode(message, &mut [0; MAX_FRAMED])).await.unwrap();
    }

    /// Returns the next message of the control stream.
    pub(crate) async fn next(&mut self) -> ToRuntime {
        tokio::time::timeout(PATIENCE, self.next_ever()).await.expect("a message")
    }

    /// As [`Self::next`], without a timeout.
    pub(crate) async fn next_ever(&mut self) -> ToRuntime {
        loop {
            if let Some(message) = self.deframer.next::<ToRuntime>() {
                return message.unwrap();
            }
            // One byte at a time never overruns the deframer.
            let mut byte = [0; 1];
            self.recv.read_exact(&mut byte).await.expect("the control stream goes on");
            self.deframer.push(&byte);
        }
    }

    /// Returns the first message for which `wanted` yields something.
    pub(crate) async fn until<T>(&mut self, mut wanted: impl FnMut(ToRuntime) -> Option<T>) -> T {
        tokio::time::timeout(PATIENCE, async {
            loop {
                if let Some(found) = wanted(self.next().await) {
                    return found;
                }
            }
        })
        .await
        .expect("the message that is waited for")
    }

    /// Returns the next complete image that was not reset.
    pub(crate) async fn image(&self) -> (ImageHeader, Vec<u8>) {
        let (header, payload, _) = self.whole_image().await;
        (header, payload)
    }

    /// As [`Self::image`], with its trailer.
    pub(crate) async fn whole_image(&self) -> (ImageHeader, Vec<u8>, ImageTrailer) {
        tokio::time::timeout(PATIENCE, async {
            loop {
                let mut stream = self.connection.accept_uni().await.expect("an image stream");
                let Ok(bytes) = stream.read_to_end(1 << 22).await else { continue };
                let (header, rest) = ImageHeader::parse(&bytes).unwrap();
                let (payload, trailer) = rest.split_last_chunk().unwrap();
                let trailer = ImageTrailer::parse(trailer, payload.len() as u64).unwrap();
                return (header, payload.to_vec(), trailer);
            }
        })
        .await
        .expect("an image")
    }

    /// Closes the connection and waits until the server has received it.
    pub(crate) async fn close(self) {
        self.connection.close(VarInt::from_u32(0), b"bye");
        self.endpoint.wait_idle().await;
    }
}

/// Sends one HTTP request and returns the status and the rest of the answer.
pub(crate) fn http(address: SocketAddr, head: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    write!(stream, "{head}\r\nHost: {address}\r\nConnection: close\r\n\r\n").unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let answer = String::from_utf8_lossy(&answer).into_owned();
    (status(&answer), answer)
}

/// Sends JSON as this server's page would, or a page of `origin`; returns status and body.
pub(crate) fn send_json(
    address: SocketAddr,
    request: &str,
    origin: Option<&str>,
    body: &str,
) -> (u16, String) {
    let own = format!("http://{address}");
    let (origin, len) = (origin.unwrap_or(&own), body.len());
    let head = format!(
        "{request} HTTP/1.1\r\nOrigin: {origin}\r\nContent-Type: application/json\r\n\
         Content-Length: {len}"
    );
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    // A server that rejects a long body answers before it has read all of it, and closes. Sending and reading may then
    // fail; only the answer counts.
    let request = format!("{head}\r\nHost: {address}\r\nConnection: close\r\n\r\n{body}");
    let sent = stream.write_all(request.as_bytes());
    let mut answer = Vec::new();
    let read = stream.read_to_end(&mut answer);
    let answer = String::from_utf8(answer).unwrap();
    let Some((_, body)) = answer.split_once("\r\n\r\n") else {
        panic!("no answer: {sent:?}, {read:?}");
    };
    (status(&answer), body.to_owned())
}

fn status(answer: &str) -> u16 {
    answer.split(' ').nth(1).and_then(|code| code.parse().ok()).expect("a status line")
}

/// The page's WebSocket.
pub(crate) struct Socket(WebSocket);

impl Socket {
    /// Opens a WebSocket as a page of `origin` would; returns the status if the server rejects it.
    pub(crate) fn open(address: SocketAddr, origin: &str) -> Result<Self, u16> {
        Self::open_at(address, origin, "/ws")
    }

    /// As [`Self::open`], with another path and query.
    pub(crate) fn open_at(address: SocketAddr, origin: &str, path: &str) -> Result<Self, u16> {
        WebSocket::open(address, path, &format!("Origin: {origin}\r\n")).map(Self)
    }

    /// Returns the next message: opcode (1 text, 2 binary) and payload.
    pub(crate) fn next(&mut self) -> (u8, Vec<u8>) {
        self.0.receive()
    }

    /// Returns the next JSON message of a type.
    pub(crate) fn message(&mut self, kind: &str) -> Value {
        loop {
            let (opcode, payload) = self.next();
            if opcode == TEXT {
                let value: Value = serde_json::from_slice(&payload).unwrap();
                if value["type"] == kind {
                    return value;
                }
            }
        }
    }
}
