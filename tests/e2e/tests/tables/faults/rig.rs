//! The real server and runtime over the network in memory, with records of what arrives.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use glam::DVec3;
use quinn::{Endpoint, EndpointConfig, TokioRuntime};
use tokio::task::JoinHandle;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep_until};
use vizflyt_arena::config::CameraConfig;
use vizflyt_protocol::geometry::{Intrinsics, Pose, Volume};
use vizflyt_protocol::messages::{
    ArenaInfo, Event, EventKind, FlightPhase, Limits, PoseSample, Purpose, Telemetry, bounded,
};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::random::SplitMix64;
use vizflyt_protocol::time::ServerTime;
use vizflyt_rgbd::{EncodeOptions, Encoder, RgbdView};
use vizflyt_runtime::stream::{
    DecodeStep, Mailbox, Outbox, ServerClock, Shared, StreamEvent, StreamSettings, run_over,
};
use vizflyt_server::authorization::Authorizer;
use vizflyt_server::clock;
use vizflyt_server::flights::events::Origin;
use vizflyt_server::poses::newest::Localized;
use vizflyt_server::stop::Stop;
use vizflyt_server::stream::Rooms;
use vizflyt_server::stream::rate_control::{self, Adaptation};
use vizflyt_server::stream::subscriptions::Broadcast;
use vizflyt_server::stream::transport::{self, Congestion};
use vizflyt_trust::{Client, Identity, KeysFolder, Owner, Paired, Role};

use super::network::{Network, Socket};
use super::world::lock;

/// Depth noise that makes the bitstream of a 640x480 image 120 KB long. [mm]
const DEPTH_NOISE_MM: f64 = 6.0;
/// Number of different images per level.
const IMAGES: usize = 4;
/// Address of the server.
pub(crate) const SERVER: &str = "10.0.0.1:4433";

/// Image source.
#[derive(Clone, Debug)]
pub(crate) struct Source {
    /// Image rate. [Hz]
    pub(crate) rate_hz: u32,
    /// Encoded images, [`IMAGES`] for each level of rate control, sent in turn.
    pub(crate) payloads: Arc<Vec<Bytes>>,
    /// Size of the images. [px]
    pub(crate) size_px: [u32; 2],
    /// Interval of the server's events.
    pub(crate) event_every: Duration,
    /// What rate control may reduce on a slow link.
    pub(crate) adapt: Adaptation,
}

impl Source {
    /// Returns images of 640x480 at 60 Hz, 120 KB each.
    pub(crate) fn vga() -> Self {
        let (size_px, event_every) = ([640, 480], Duration::from_millis(300));
        Self {
            rate_hz: 60,
            payloads: payloads(size_px),
            size_px,
            event_every,
            adapt: Adaptation::None,
        }
    }

    /// Returns images of 160x120 at 100 Hz, 8 KB each, and few events, because the event log grows up to a limit.
    pub(crate) fn small() -> Self {
        let (size_px, event_every) = ([160, 120], Duration::from_secs(100));
        Self {
            rate_hz: 100,
            payloads: payloads(size_px),
            size_px,
            event_every,
            adapt: Adaptation::None,
        }
    }
}

/// Returns the image width at a level of rate control: the fraction of bytes is a fraction of columns.
fn columns(width: u32, level: usize) -> u32 {
    (f64::from(width) * rate_control::level(level).share) as u32
}

fn payloads([width, height]: [u32; 2]) -> Arc<Vec<Bytes>> {
    let mut random = SplitMix64::new(1);
    let payload = |level: usize| {
        let width = columns(width, level / IMAGES);
        // Flat colour and noisy depth need only integer coding, so every machine produces the same number of bytes.
        let rgb = vec![128; (width * height * 3) as usize];
        let noise = |_| 2000 + (random.unit() * DEPTH_NOISE_MM) as u16;
        let depth_mm: Vec<u16> = (0..width * height).map(noise).collect();
        let view = RgbdView { width, height, rgb: &rgb, depth_mm: &depth_mm };
        let mut payload = Vec::new();
        Encoder::new(EncodeOptions::default()).encode(&view, &mut payload).unwrap();
        Bytes::from(payload)
    };
    Arc::new((0..rate_control::LEVELS.len() * IMAGES).map(payload).collect())
}

/// Records of a run.
#[derive(Debug, Default)]
pub(crate) struct Notes {
    /// Stamps of rendered images.
    pub(crate) rendered: Vec<ServerTime>,
    /// Pose stamp and arrival of each received image.
    pub(crate) images: Vec<(ServerTime, ServerTime)>,
    /// Age of each pose at its arrival. [s]
    pub(crate) poses_s: Vec<f64>,
    /// For each process of the runtime: number of arrivals of each server event, by event number.
    pub(crate) events_down: Vec<BTreeMap<u32, u32>>,
    /// Number of arrivals of each runtime event, over all processes of the server.
    pub(crate) events_up: BTreeMap<u32, u32>,
    /// Number of events sent by the server.
    pub(crate) told_down: u32,
    /// Number of events sent by the runtime.
    pub(crate) told_up: u32,
    /// Reasons for which the runtime lost its connection.
    pub(crate) downs: Vec<String>,
}

/// The server's process.
pub(crate) struct Server {
    pub(crate) rooms: Rooms,
    socket: Arc<Socket>,
    tasks: Vec<JoinHandle<()>>,
}

/// Paired keys of server and runtime; they survive restarts.
pub(crate) struct Keys {
    folder: KeysFolder,
    runtime: Identity,
    _root: tempfile::TempDir,
}

impl Keys {
    /// Creates and pairs the keys.
    pub(crate) fn make() -> Self {
        let root = tempfile::tempdir().unwrap();
        let folder = KeysFolder::open(Some(&root.path().join("keys"))).unwrap();
        let runtime = Identity::load_or_create(&folder, Owner::Runtime).unwrap();
        let client = Client {
            name: "team".to_owned(),
            fingerprint: runtime.fingerprint(),
            role: Role::Team,
            vehicles: vec!["vizflyt".to_owned()],
        };
        Paired::add(&folder, client).unwrap();
        Self { folder, runtime, _root: root }
    }

    fn authorizer(&self) -> Arc<Authorizer> {
        Arc::new(Authorizer::open(self.folder.clone()).unwrap())
    }
}

impl Server {
    /// Starts the server.
    pub(crate) fn start(
        network: &Arc<Network>,
        keys: &Keys,
        congestion: Congestion,
        source: &Source,
        notes: &Arc<Mutex<Notes>>,
    ) -> Self {
        let arena = ArenaInfo::new(
            "virtual",
            Volume::aabb(DVec3::splat(-9.0), DVec3::splat(9.0)),
            Limits::new(3.0, 4.0),
        );
        let camera = CameraConfig {
            name: "front".to_owned(),
            width_px: source.size_px[0],
            height_px: source.size_px[1],
            horizontal_fov_deg: Some(90.0),
            ..serde_json::from_str(
                r#"{"name":"front","width_px":1,"height_px":1,"position_m":[0,0,0]}"#,
            )
            .unwrap()
        };
        let vehicles = vec![("vizflyt", arena, vec![camera])];
        let rooms = Rooms::bare(vehicles, source.adapt, Stop::default());
        let socket = network.socket(SERVER.parse().unwrap());
        let authorizer = keys.authorizer();
        let config = transport::server_config(&authorizer.identity, congestion).unwrap();
        let endpoint = Endpoint::new_with_abstract_socket(
            seeded(transport::endpoint_config(&authorizer.identity).unwrap(), 1),
            Some(config),
            socket.clone(),
            Arc::new(TokioRuntime),
        )
        .unwrap();
        let tasks = vec![
            tokio::spawn(transport::serve(rooms.clone(), endpoint, authorizer, congestion)),
            tokio::spawn(render(rooms.clone(), source.clone(), notes.clone())),
            tokio::spawn(localize(rooms.clone())),
            tokio::spawn(happen(rooms.clone(), source.clone(), notes.clone())),
        ];
        Self { rooms, socket, tasks }
    }

    /// Ends the server like SIGKILL, without a message.
    pub(crate) fn kill(&self, notes: &Mutex<Notes>) {
        self.note_events(notes);
        self.socket.kill();
        for task in &self.tasks {
            task.abort();
        }
    }

    /// Records how often each event of the runtime arrived.
    pub(crate) fn note_events(&self, notes: &Mutex<Notes>) {
        let mut cursor = 0;
        let found = self.rooms.flights.vehicles[0].events.read(&mut cursor).unwrap();
        let mut notes = lock(notes);
        for entry in found.iter().filter(|entry| entry.origin == Origin::Page) {
            if let Some(number) = number(&entry.event) {
                *notes.events_up.entry(number).or_default() += 1;
            }
        }
    }
}

fn seeded(mut config: EndpointConfig, seed: u8) -> EndpointConfig {
    config.rng_seed(Some([seed; 32]));
    config
}

/// Renders and sends images like the render and encode threads: the newest image wins, none while K are in flight.
async fn render(rooms: Rooms, source: Source, notes: Arc<Mutex<Notes>>) {
    let period = Duration::from_secs(1) / source.rate_hz;
    let mut due = Instant::now();
    let (mut seq, mut newest, mut broadcast) = (0, None, Broadcast::default());
    // The encode thread waits for a condition; this task polls every millisecond.
    let mut look = interval(Duration::from_millis(1));
    look.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        if Instant::now() >= due {
            due += period;
            seq += 1;
            let now = clock::now();
            lock(&notes).rendered.push(now);
            rooms.streaming.vehicles[0].images.cameras[0].count_rendered();
            if seq % u64::from(rooms.streaming.vehicles[0].level().keep_one_in) == 0 {
                newest = Some((seq, now));
            }
        }
        let room = rooms.streaming.subscriptions.wait_for_room(Duration::ZERO).fly[0][0];
        if room && let Some((seq, pose)) = newest.take() {
            let level = rooms.streaming.vehicles[0].level.load(Ordering::Relaxed);
            let [width, height] = source.size_px;
            let k = Intrinsics::from_horizontal_fov(columns(width, level), height, 1.5);
            let identity = (Pose::IDENTITY, Pose::IDENTITY);
            let header = ImageHeader::new(seq, 0, pose, &k, &identity.0, &identity.1);
            rooms.streaming.subscriptions.begin((0, 0), header, 0, true, &mut broadcast);
            broadcast.push(&source.payloads[level * IMAGES + seq as usize % IMAGES]);
            rooms.streaming.subscriptions.end(&mut broadcast, Some(clock::now()));
        }
        tokio::select! {
            biased;
            () = sleep_until(due) => {}
            _ = look.tick(), if newest.is_some() => {}
        }
    }
}

/// Sends poses at 200 Hz.
async fn localize(rooms: Rooms) {
    let mut tick = interval(Duration::from_millis(5));
    loop {
        tick.tick().await;
        let sample = PoseSample::still(clock::now(), Pose::IDENTITY);
        rooms.localization.vehicles[0].newest.send_replace(Some(Localized::still(sample)));
    }
}

/// Sends events from the first connection of a runtime on: earlier events are not delivered.
async fn happen(rooms: Rooms, source: Source, notes: Arc<Mutex<Notes>>) {
    let mut tick = interval(source.event_every);
    let mut flown = false;
    loop {
        tick.tick().await;
        flown |= rooms.flights.vehicles[0].runtime().is_some();
        if !flown {
            continue;
        }
        let number = {
            let mut notes = lock(&notes);
            notes.told_down += 1;
            notes.told_down - 1
        };
        rooms.flights.vehicles[0].publish(EventKind::Note, &text(number));
    }
}

fn text(number: u32) -> String {
    format!("event {number}")
}

fn number(event: &Event) -> Option<u32> {
    event.text.strip_prefix("event ")?.parse().ok()
}

/// The runtime's process.
pub(crate) struct Runtime {
    pub(crate) socket: Arc<Mutex<Option<Arc<Socket>>>>,
    tasks: Vec<JoinHandle<()>>,
}

impl Runtime {
    /// Starts the runtime at an address; each new connection uses the next port.
    pub(crate) fn start(
        network: &Arc<Network>,
        keys: &Keys,
        address: SocketAddr,
        notes: &Arc<Mutex<Notes>>,
    ) -> Self {
        let shared = Shared {
            clock: ServerClock::default(),
            mailbox: Arc::new(Mailbox::default()),
            readings: Arc::default(),
        };
        lock(notes).events_down.push(BTreeMap::new());
        let outbox = Arc::new(Outbox::default());
        let settings = StreamSettings {
            server: SERVER.parse().unwrap(),
            fingerprint: keys.authorizer().identity.fingerprint(),
            identity: keys.runtime.clone(),
            vehicle: bounded("vizflyt"),
            purpose: Purpose::Fly,
            program: bounded("faults"),
        };
        let socket = Arc::new(Mutex::new(None));
        let (network, opened, port) = (network.clone(), socket.clone(), Mutex::new(address.port()));
        let open = move |_| {
            *lock(&port) += 1;
            let at = SocketAddr::new(address.ip(), *lock(&port));
            let socket = network.socket(at);
            *lock(&opened) = Some(socket.clone());
            let config = seeded(EndpointConfig::default(), 2);
            Endpoint::new_with_abstract_socket(config, None, socket, Arc::new(TokioRuntime))
        };
        let noted = notes.clone();
        let handle = move |event| {
            let mut notes = lock(&noted);
            match event {
                StreamEvent::Pose(sample, _) => {
                    notes.poses_s.push(clock::now().seconds_since(sample.stamp));
                }
                StreamEvent::Event(event) => {
                    if let Some(number) = number(&event) {
                        let newest = notes.events_down.last_mut().unwrap();
                        *newest.entry(number).or_default() += 1;
                    }
                }
                StreamEvent::Down(why) => notes.downs.push(why),
                StreamEvent::Refused(why) => panic!("refused: {why}"),
                StreamEvent::Welcome(_)
                | StreamEvent::Camera(..)
                | StreamEvent::Sensor(..)
                | StreamEvent::Feed(..) => {}
            }
            true
        };
        let tasks = vec![
            tokio::spawn(run_over(open, settings, shared.clone(), outbox.clone(), handle)),
            tokio::spawn(take(shared, notes.clone())),
            tokio::spawn(report(outbox, notes.clone())),
        ];
        Self { socket, tasks }
    }

    /// Changes the address.
    pub(crate) fn move_to(&self, address: SocketAddr) {
        if let Some(socket) = &*lock(&self.socket) {
            socket.move_to(address);
        }
    }

    /// Ends the runtime like SIGKILL, without a message.
    pub(crate) fn kill(&self) {
        if let Some(socket) = &*lock(&self.socket) {
            socket.kill();
        }
        for task in &self.tasks {
            task.abort();
        }
    }
}

/// Takes images like the decoder.
async fn take(shared: Shared, notes: Arc<Mutex<Notes>>) {
    let mut look = interval(Duration::from_millis(1));
    let mut rendered = ServerTime::ZERO;
    loop {
        look.tick().await;
        while let Some((_, step)) = shared.mailbox.next(Duration::ZERO, |_| true) {
            match step {
                // The decoder drops images that a newer one has overtaken.
                DecodeStep::Begin(arrival) if arrival.header.pose_stamp() <= rendered => {
                    shared.mailbox.give_up(0);
                }
                DecodeStep::Begin(arrival) => rendered = arrival.header.pose_stamp(),
                DecodeStep::Piece(piece) => shared.mailbox.recycle(piece),
                DecodeStep::End(whole) => {
                    let received = ServerTime::from_ns(whole.received.as_ns());
                    lock(&notes).images.push((rendered, received));
                }
                DecodeStep::Drop => {}
            }
        }
    }
}

/// Sends telemetry at 10 Hz and an event every 700 ms.
async fn report(outbox: Arc<Outbox>, notes: Arc<Mutex<Notes>>) {
    let mut tick = interval(Duration::from_millis(100));
    for count in 0_u64.. {
        tick.tick().await;
        outbox.report(Telemetry { phase: FlightPhase::Flying, ..Telemetry::default() });
        if count % 7 == 6 {
            let number = {
                let mut notes = lock(&notes);
                notes.told_up += 1;
                notes.told_up - 1
            };
            let (stamp, text) = (clock::now(), bounded(&text(number)));
            outbox.send_event(Event { stamp, kind: EventKind::Note, text });
        }
    }
}
