//! `vizflyt bench stream`: latency of an image to the plugin, over loopback and real sockets.
//!
//! ```text
//! packet  bytes handed to the transport -> QUIC -> shared memory -> plugin woken
//! tcp     the same bytes, their length first, over TCP -> shared memory -> plugin woken
//! pixels  rendered image -> encode -> QUIC -> decode -> shared memory -> plugin woken
//! ```
//! The transfers run one after the other in one process, so that their ratio is valid on a busy
//! machine too. The plugin is a thread behind the real shared memory.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow};
use bytes::Bytes;
use clap::Args;
use glam::DVec3;
use serde::Serialize;
use vizflyt_arena::config::CameraConfig;
use vizflyt_process::print_fmt;
use vizflyt_protocol::geometry::{Pose, Volume};
use vizflyt_protocol::messages::{ArenaInfo, Limits, Purpose, bounded};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_rgbd::{EncodeOptions, Encoder, RgbdView};
use vizflyt_runtime::images::ImagePublisher;
use vizflyt_runtime::stream::{
    self, DecodeStep, Mailbox, Outbox, ServerClock, Shared, StreamSettings,
};
use vizflyt_sdk::ipc::{PluginEnd, RuntimeEnd};
use vizflyt_sdk::{Observation, ObservationWriter};
use vizflyt_server::authorization::Authorizer;
use vizflyt_server::clock;
use vizflyt_server::render::rendered::RenderedImage;
use vizflyt_server::stop::Stop;
use vizflyt_server::stream::Rooms;
use vizflyt_server::stream::encode::slices::SliceEncoder;
use vizflyt_server::stream::rate_control::Adaptation;
use vizflyt_server::stream::subscriptions::Broadcast;
use vizflyt_server::stream::transport::{self, Congestion};
use vizflyt_splat::RgbdImage;
use vizflyt_studio::scene::camera::ImageSize;
use vizflyt_trust::{Client, Identity, KeysFolder, Owner, Paired, Role};

/// Measure the latency of images to a plugin over loopback
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt bench stream
  vizflyt bench stream --seconds 600 --rate 100     soak test: compare the memory at start and end")]
pub(super) struct StreamArgs {
    /// Duration of each of the three measurements
    #[arg(long, value_name = "SECONDS", default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..=86400))]
    seconds: u64,
    /// Image size
    #[arg(long, value_name = "WxH", default_value = "640x480")]
    size: ImageSize,
    /// Image rate
    #[arg(long, value_name = "HZ", default_value_t = 60, value_parser = clap::value_parser!(u32).range(1..=1000))]
    rate: u32,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// Results of one kind of transfer.
#[derive(Debug, Serialize)]
struct Transfer {
    name: &'static str,
    bytes: usize,
    sent: u64,
    delivered: usize,
    ms_p50: f64,
    ms_p99: f64,
    ms_max: f64,
}

#[derive(Debug, Serialize)]
struct Figures {
    width_px: u32,
    height_px: u32,
    rate_hz: u32,
    ways: Vec<Transfer>,
    packet_to_tcp_p50: f64,
    rss_start_mb: f64,
    rss_end_mb: f64,
}

/// Runs `vizflyt bench stream`.
pub(super) fn run(args: &StreamArgs) -> Result<()> {
    let ImageSize { width_px, height_px } = args.size;
    let bench = Bench {
        size: [width_px, height_px],
        period: Duration::from_secs(1) / args.rate,
        count: args.seconds * u64::from(args.rate),
    };
    let rss_start_mb = rss_mb();
    let payload = payload(bench.size)?;
    let ways = vec![bench.packet(&payload)?, bench.tcp(&payload)?, bench.pixels()?];
    let figures = Figures {
        width_px,
        height_px,
        rate_hz: args.rate,
        packet_to_tcp_p50: ways[0].ms_p50 / ways[1].ms_p50,
        ways,
        rss_start_mb,
        rss_end_mb: rss_mb(),
    };
    if args.json {
        print_fmt!("{}", serde_json::to_string_pretty(&figures)?);
        return Ok(());
    }
    print_fmt!(
        "{width_px}x{height_px} RGB-D at {} Hz over loopback, to the plugin's wake-up",
        args.rate
    );
    for way in &figures.ways {
        print_fmt!(
            "{:<7} {:>4} KB  p50 {:.2} ms, p99 {:.2}, max {:.2}; {} of {} arrived",
            way.name,
            way.bytes / 1000,
            way.ms_p50,
            way.ms_p99,
            way.ms_max,
            way.delivered,
            way.sent
        );
    }
    print_fmt!("packet takes {:.2} times as long as tcp", figures.packet_to_tcp_p50);
    print_fmt!(
        "memory {:.0} MB at the start, {:.0} MB at the end",
        rss_start_mb,
        figures.rss_end_mb
    );
    Ok(())
}

struct Bench {
    size: [u32; 2],
    period: Duration,
    count: u64,
}

impl Bench {
    /// Calls `send` with the number of each image, from 1, when it is due.
    fn tick(&self, mut send: impl FnMut(u64) -> Result<()>) -> Result<()> {
        let mut due = Instant::now();
        for seq in 1..=self.count {
            due += self.period;
            thread::sleep(due.saturating_duration_since(Instant::now()));
            send(seq)?;
        }
        // Wait for images that are on their way.
        thread::sleep(SETTLE);
        Ok(())
    }

    fn way(&self, name: &'static str, bytes: usize, mut ms: Vec<f64>) -> Result<Transfer> {
        ms.sort_unstable_by(f64::total_cmp);
        let last = ms.len().checked_sub(1).ok_or_else(|| anyhow!("{name}: no image arrived"))?;
        let at = |share: f64| ms[(share * last as f64).round() as usize];
        let (delivered, sent) = (ms.len(), self.count);
        Ok(Transfer {
            name,
            bytes,
            sent,
            delivered,
            ms_p50: at(0.5),
            ms_p99: at(0.99),
            ms_max: at(1.0),
        })
    }

    fn packet(&self, payload: &Bytes) -> Result<Transfer> {
        let link = Link::start(self.size)?;
        let plugin = Plugin::start(8 + payload.len(), handed_first)?;
        let (ipc, mailbox, stop) =
            (plugin.runtime.clone(), link.shared.mailbox.clone(), plugin.stop.clone());
        let copying = thread::spawn(move || copy(&ipc, &mailbox, &stop));
        let k = link.rooms.rendering.cameras[0].newest().infos[0].intrinsics;
        let mut broadcast = Broadcast::default();
        self.tick(|seq| {
            let identity = (Pose::IDENTITY, Pose::IDENTITY);
            let now = clock::now();
            let mut header = ImageHeader::new(seq, 0, now, &k, &identity.0, &identity.1);
            header.render_end_ns = now.as_ns().into();
            link.rooms.streaming.subscriptions.begin((0, 0), header, 0, true, &mut broadcast);
            broadcast.push(payload);
            link.rooms.streaming.subscriptions.end(&mut broadcast, Some(clock::now()));
            Ok(())
        })?;
        let ms = plugin.end()?;
        copying.join().map_err(|_| anyhow!("the copying thread failed"))??;
        self.way("packet", payload.len(), ms)
    }

    fn tcp(&self, payload: &Bytes) -> Result<Transfer> {
        let listener = TcpListener::bind(("127.0.0.1", 0)).context("no loopback")?;
        let mut send = TcpStream::connect(listener.local_addr()?)?;
        send.set_nodelay(true)?;
        let mut receive = listener.accept()?.0;
        let plugin = Plugin::start(8 + payload.len(), handed_first)?;
        let ipc = plugin.runtime.clone();
        let copying = thread::spawn(move || -> Result<()> {
            let mut head = [0; 16];
            // The sender closes the connection at the end.
            while receive.read_exact(&mut head).is_ok() {
                let (handed, len) = head.split_at(8);
                let len = u64::from_le_bytes(len.try_into()?) as usize;
                let mut memory = ipc.loan(8 + len)?;
                memory.memory()[..8].copy_from_slice(handed);
                receive.read_exact(&mut memory.memory()[8..])?;
                ipc.publish(memory)?;
            }
            Ok(())
        });
        self.tick(|_| {
            let mut head = [0; 16];
            head[..8].copy_from_slice(&clock::now().as_ns().to_le_bytes());
            head[8..].copy_from_slice(&(payload.len() as u64).to_le_bytes());
            send.write_all(&head)?;
            Ok(send.write_all(payload)?)
        })?;
        drop(send);
        let ms = plugin.end()?;
        copying.join().map_err(|_| anyhow!("the copying thread failed"))??;
        self.way("tcp", payload.len(), ms)
    }

    fn pixels(&self) -> Result<Transfer> {
        let link = Link::start(self.size)?;
        let set = link.rooms.rendering.cameras[0].newest();
        let names = vec![set.infos[0].name.clone()];
        let handed: Arc<Vec<AtomicU64>> = Arc::new((0..RING).map(|_| AtomicU64::new(0)).collect());
        let table = handed.clone();
        let read = move |bytes: &[u8]| {
            let observation = Observation::from_bytes(bytes, &names).ok()?;
            let seq = observation.cameras().next()?.seq;
            Some(table[seq as usize % RING].load(Ordering::Relaxed))
        };
        let plugin = Plugin::start(ObservationWriter::len_for(&set.infos), read)?;
        let publisher =
            ImagePublisher::new(plugin.runtime.clone(), set.infos.clone(), Arc::default());
        let (mailbox, stop) = (link.shared.mailbox.clone(), plugin.stop.clone());
        let decoding = thread::spawn(move || {
            publisher.run(&mailbox, || stop.load(Ordering::Relaxed), |_| {});
        });
        let mut encoder = SliceEncoder::new(EncodeOptions::default());
        let mut slot = RenderedImage {
            fresh: true,
            set: Some(set),
            world_from_body: Some(Pose::IDENTITY),
            image: picture(self.size),
            ..RenderedImage::default()
        };
        self.tick(|seq| {
            let now = clock::now();
            handed[seq as usize % RING].store(now.as_ns(), Ordering::Relaxed);
            (slot.seq, slot.pose, slot.render_end) = (seq, now, now);
            encoder.send(&link.rooms.streaming.subscriptions, &slot, 1)?;
            Ok(())
        })?;
        let counters = &link.rooms.streaming.vehicles[0].images;
        let sent = counters.sent.load(Ordering::Relaxed).max(1);
        let bytes = counters.bytes.load(Ordering::Relaxed) / sent;
        let ms = plugin.end()?;
        decoding.join().map_err(|_| anyhow!("the decoding thread failed"))?;
        self.way("pixels", bytes as usize, ms)
    }
}

/// Copies images from the stream to shared memory as they are, with the time at which they were
/// sent.
fn copy(ipc: &RuntimeEnd, mailbox: &Mailbox, stop: &AtomicBool) -> Result<()> {
    let mut bytes = Vec::new();
    while !stop.load(Ordering::Relaxed) {
        match mailbox.next(PATIENCE, |_| true) {
            Some((_, DecodeStep::Begin(arrival))) => {
                bytes.clear();
                bytes.extend_from_slice(&arrival.header.render_end_ns.get().to_le_bytes());
            }
            Some((_, DecodeStep::Piece(piece))) => {
                bytes.extend_from_slice(&piece);
                mailbox.recycle(piece);
            }
            Some((_, DecodeStep::End(_))) => {
                let mut memory = ipc.loan(bytes.len())?;
                memory.memory().copy_from_slice(&bytes);
                ipc.publish(memory)?;
            }
            Some((_, DecodeStep::Drop)) | None => {}
        }
    }
    Ok(())
}

fn handed_first(bytes: &[u8]) -> Option<u64> {
    Some(u64::from_le_bytes(bytes.first_chunk().copied()?))
}

/// Plugin side, on a thread.
struct Plugin {
    runtime: Arc<RuntimeEnd>,
    stop: Arc<AtomicBool>,
    thread: JoinHandle<Result<Vec<f64>>>,
}

impl Plugin {
    /// Starts the plugin. `handed` reads from an observation when its image was sent. [ns, server]
    fn start(len: usize, handed: impl Fn(&[u8]) -> Option<u64> + Send + 'static) -> Result<Self> {
        let runtime = Arc::new(RuntimeEnd::new(len));
        let plugin = PluginEnd::attach(runtime.connect()?)?;
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let thread = thread::spawn(move || {
            let mut ms = Vec::new();
            while !stopped.load(Ordering::Relaxed) {
                plugin.wait(PATIENCE)?;
                while let Some(sample) = plugin.observation()? {
                    let now_ns = clock::now().as_ns();
                    if let Some(handed_ns) = handed(sample.bytes()) {
                        ms.push(now_ns.saturating_sub(handed_ns) as f64 * 1e-6);
                    }
                }
            }
            Ok(ms)
        });
        Ok(Self { runtime, stop, thread })
    }

    /// Stops the plugin; returns the latency of each image. [ms]
    fn end(self) -> Result<Vec<f64>> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().map_err(|_| anyhow!("the plugin thread failed"))?
    }
}

/// A connected pair of server and runtime.
struct Link {
    rooms: Rooms,
    shared: Shared,
    _tokio: tokio::runtime::Runtime,
    _keys: tempfile::TempDir,
}

impl Link {
    fn start([width_px, height_px]: [u32; 2]) -> Result<Self> {
        let keys = tempfile::tempdir()?;
        let folder = KeysFolder::open(Some(&keys.path().join("keys")))?;
        let identity = Identity::load_or_create(&folder, Owner::Runtime)?;
        let client = Client {
            name: "bench".to_owned(),
            fingerprint: identity.fingerprint(),
            role: Role::Instructor,
            vehicles: Vec::new(),
        };
        Paired::add(&folder, client)?;
        let authorizer = Arc::new(Authorizer::open(folder)?);

        let camera: CameraConfig = serde_json::from_value(serde_json::json!({
            "name": "front", "width_px": width_px, "height_px": height_px,
            "horizontal_fov_deg": 90.0, "position_m": [0.0, 0.0, 0.0],
        }))?;
        let vehicles = vec![("bench", arena(), vec![camera])];
        let rooms = Rooms::bare(vehicles, Adaptation::default(), Stop::default());
        let tokio =
            tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
        let shared = Shared {
            clock: ServerClock::default(),
            mailbox: Arc::default(),
            readings: Arc::default(),
        };
        {
            let _inside = tokio.enter();
            let congestion = Congestion::Auto;
            let endpoint =
                transport::bind(([127, 0, 0, 1], 0).into(), &authorizer.identity, congestion)?;
            let settings = StreamSettings {
                server: endpoint.local_addr()?,
                fingerprint: authorizer.identity.fingerprint(),
                identity,
                vehicle: bounded("bench"),
                purpose: Purpose::Fly,
                program: bounded("vizflyt bench"),
            };
            tokio.spawn(transport::serve(rooms.clone(), endpoint, authorizer, congestion));
            let outbox = Arc::new(Outbox::default());
            tokio.spawn(stream::run(settings, shared.clone(), outbox, |_| true));
        }
        let deadline = Instant::now() + CONNECTED_WITHIN;
        let connected = || {
            let room = rooms.streaming.subscriptions.wait_for_room(PATIENCE).fly[0][0];
            // Before the clocks are synchronized, images have no time on the runtime's clock.
            room && shared.clock.state(vizflyt_sdk::host_now()).is_some()
        };
        while !connected() {
            anyhow::ensure!(Instant::now() < deadline, "no connection over loopback for 10 s");
            thread::sleep(Duration::from_millis(10));
        }
        Ok(Self { rooms, shared, _tokio: tokio, _keys: keys })
    }
}

fn arena() -> ArenaInfo {
    let hall = Volume::aabb(DVec3::splat(-9.0), DVec3::splat(9.0));
    ArenaInfo::new("bench", hall, Limits::new(3.0, 4.0))
}

/// Returns a bitstream of 3.3 bits a pixel: 128 KB at 640x480.
fn payload([width, height]: [u32; 2]) -> Result<Bytes> {
    let pixels = (width * height) as usize;
    let rgb = vec![128; pixels * 3];
    // Weyl's sequence: noise of a few millimetres that does not compress.
    let depth_mm: Vec<u16> = (0..pixels as u32)
        .map(|n| 2000 + ((u64::from(n.wrapping_mul(0x9e37_79b9)) * 3) >> 32) as u16)
        .collect();
    let view = RgbdView { width, height, rgb: &rgb, depth_mm: &depth_mm };
    let mut payload = Vec::new();
    Encoder::new(EncodeOptions::default()).encode(&view, &mut payload)?;
    Ok(payload.into())
}

/// Returns a rendered image about as hard to encode as a captured scene: texture of every scale,
/// depth with edges.
fn picture([width_px, height_px]: [u32; 2]) -> RgbdImage {
    let pixels = (width_px * height_px) as usize;
    let mut image = RgbdImage {
        width_px,
        height_px,
        rgb: Vec::with_capacity(pixels * 3),
        alpha: vec![1.0; pixels],
        depth_expected_m: Vec::new(),
        depth_median_m: Vec::with_capacity(pixels),
        ids: vec![0; pixels],
    };
    for y in 0..height_px {
        for x in 0..width_px {
            let (u, v) = (x as f32 / width_px as f32, y as f32 / width_px as f32);
            let wave = |f: f32| (u * f).sin() * (v * f * 1.3 + 1.0).cos();
            let texture = 0.5 + 0.2 * wave(20.0) + 0.12 * wave(90.0) + 0.06 * wave(400.0);
            image.rgb.extend([texture, 0.8 * texture + 0.1, 1.0 - texture]);
            let near = wave(15.0) > 0.3;
            image.depth_median_m.push(if near { 1.5 + 0.2 * u } else { 3.0 + 2.0 * v });
        }
    }
    image.depth_expected_m = image.depth_median_m.clone();
    image
}

/// Returns the resident memory of this process. [MB]
fn rss_mb() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kb = line.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok());
    kb.unwrap_or(0.0) / 1e3
}

/// Larger than the number of images on their way at any time.
const RING: usize = 256;
const PATIENCE: Duration = Duration::from_millis(100);
const SETTLE: Duration = Duration::from_millis(300);
const CONNECTED_WITHIN: Duration = Duration::from_secs(10);
