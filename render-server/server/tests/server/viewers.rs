//! Twenty open pages and four runtimes with two cameras each: no event is lost, memory is stable, and the runtimes keep
//! their images.
//!
//! ```text
//! VIZFLYT_STRESS_S=600 cargo test -p vizflyt-server --test server viewers -- --nocapture
//! ```
//! runs it for ten minutes and prints rates and memory; without the variable, for a few seconds. It prints rates
//! without pages, with them, and without them again; they do not decide the test.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::support::{Client, Emitter, PATIENCE, Server, Socket, send_json, write_arena};
use quinn::TransportConfig;
use vizflyt_protocol::messages::ToRuntime;

const VEHICLES: [&str; 4] = ["ant", "bee", "fly", "wasp"];
const VIEWERS: usize = 20;
/// Maximum growth in the second half of a test of minutes. [MB]
const MAX_MEMORY_GROWTH_MB: f64 = 12.0;
/// Maximum growth from the first page on: sockets, queues, threads and previews of 20 pages use half of it within
/// seconds. Images that are never freed would exceed it in two seconds. [MB]
const MAX_MEMORY_OF_PAGES_MB: f64 = 48.0;
/// Number of previews of each camera that the server keeps (`flights/recent_previews.rs`).
const KEPT_PREVIEWS: u64 = 36;

/// Messages and images that one vehicle's runtime received.
#[derive(Debug, Default)]
struct Got {
    images: [AtomicU64; 2],
    cameras_changed: AtomicU64,
}

#[test]
fn twenty_pages_and_four_runtimes_lose_no_event() {
    let seconds = std::env::var("VIZFLYT_STRESS_S").map_or(4, |s| s.parse().unwrap());
    let folder = tempfile::tempdir().unwrap();
    let second = "name = \"down\"\nwidth_px = 320\nheight_px = 240\nhorizontal_fov_deg = 90.0\n\
                  position_m = [0, 0, 0]\ntilt_deg = -30.0\nrate_hz = 15.0\n";
    let vehicles = VEHICLES.map(|name| format!("[[vehicles]]\nname = \"{name}\"\n")).concat();
    let more = format!("rate_hz = 15.0\n[[cameras]]\n{second}{vehicles}");
    let server = Server::start(&write_arena(folder.path(), &more), &["--apart"]);
    let _emitters = VEHICLES.map(|name| Emitter::along(server.vicon, name, |_| 0.0));

    let runtimes = tokio::runtime::Runtime::new().unwrap();
    let got: Vec<Arc<Got>> = VEHICLES.iter().map(|_| Arc::default()).collect();
    for (name, got) in VEHICLES.iter().zip(&got) {
        let client = runtimes.block_on(async {
            let mut quiet = TransportConfig::default();
            quiet.keep_alive_interval(Some(Duration::from_secs(1)));
            Client::welcomed_to(&server, name, quiet).await.0
        });
        runtimes.spawn(images(client.connection.clone(), got.clone()));
        runtimes.spawn(messages(client, got.clone()));
    }

    let rate = |phase: &str, seconds: u64, during: &mut dyn FnMut()| {
        let count = || -> Vec<u64> {
            let counters = got.iter().flat_map(|got| &got.images);
            counters.map(|images| images.load(Ordering::Relaxed)).collect()
        };
        let (before, start) = (count(), Instant::now());
        while start.elapsed() < Duration::from_secs(seconds) {
            std::thread::sleep(Duration::from_millis(500));
            during();
        }
        // A loaded machine may need longer for the first image of each camera.
        let got_one = || count().iter().zip(&before).all(|(now, then)| now > then);
        wait_until(&format!("{phase}: an image of each camera"), got_one);
        let passed_s = start.elapsed().as_secs_f64();
        let hz: Vec<f64> =
            count().iter().zip(&before).map(|(now, then)| (now - then) as f64 / passed_s).collect();
        let (sum, least) = (hz.iter().sum::<f64>(), hz.iter().copied().fold(f64::MAX, f64::min));
        println!("{phase:<16} {sum:6.1} images/s of 8 cameras, the slowest {least:.2} Hz");
        sum
    };
    // The first seconds open streams and fill caches. The previews for crash cards also fill with images, so wait for
    // their number, not for a time.
    rate("start", 2, &mut || {});
    wait_until("the previews of each camera", || {
        got.iter().flat_map(|got| &got.images).all(|n| n.load(Ordering::Relaxed) > KEPT_PREVIEWS)
    });
    let before = rate("no page", (seconds / 4).max(2), &mut || {});

    // Total number of changes, once it is final.
    let all = Arc::new(AtomicU64::new(u64::MAX));
    let pages: Vec<_> = (0..VIEWERS).map(|k| Page::open(&server, VEHICLES[k % 4], &all)).collect();
    let (mut memory_mb, mut changes) = (vec![rss_mb(&server)], 0);
    let watched = rate("20 pages", seconds, &mut || {
        memory_mb.push(rss_mb(&server));
        // Changes that each runtime and each page must receive.
        changes += 1;
        for name in VEHICLES {
            let tilt = format!("{{\"tilt_deg\": {}}}", changes % 2);
            let path = format!("PATCH /api/vehicles/{name}/cameras/front");
            let (status, answer) = send_json(server.http, &path, None, &tilt);
            assert_eq!(status, 200, "{answer}");
        }
    });
    all.store(changes, Ordering::Relaxed);
    let (mut pictures, mut states) = (0, 0);
    for page in pages {
        let seen = page.join().unwrap();
        assert_eq!(seen.changes, changes, "events of a page");
        (pictures, states) = (pictures + seen.pictures, states + seen.states);
    }
    for (name, got) in VEHICLES.iter().zip(&got) {
        let is_told = || got.cameras_changed.load(Ordering::Relaxed) >= changes;
        wait_until(&format!("events of {name}"), is_told);
        assert_eq!(got.cameras_changed.load(Ordering::Relaxed), changes, "events of {name}");
    }
    let after = rate("no page again", (seconds / 4).max(2), &mut || {});
    let alone = f64::midpoint(before, after);
    // In a few seconds the pages' queues only just fill; in minutes a leak shows in the second half, too.
    let tenths: Vec<f64> = (0..=10).map(|n| memory_mb[n * (memory_mb.len() - 1) / 10]).collect();
    println!(
        "with 20 pages the runtimes get {:.3} of their images; a page {:.1} pictures and {:.1} states \
         a second; {changes} events to each, none lost; memory of the server after each tenth {tenths:.1?} MB",
        watched / alone,
        pictures as f64 / VIEWERS as f64 / seconds as f64,
        states as f64 / VIEWERS as f64 / seconds as f64,
    );
    assert!(tenths[10] - tenths[0] < MAX_MEMORY_OF_PAGES_MB || seconds > 60, "{tenths:.1?} MB");
    assert!(tenths[10] - tenths[5] < MAX_MEMORY_GROWTH_MB || seconds < 60, "{tenths:.1?} MB");
}

/// Waits until `done`.
///
/// # Panics
/// After a timeout.
fn wait_until(what: &str, done: impl Fn() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < PATIENCE, "waited for {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Counts a runtime's images.
async fn images(connection: quinn::Connection, got: Arc<Got>) {
    while let Ok(mut stream) = connection.accept_uni().await {
        let Ok(bytes) = stream.read_to_end(1 << 22).await else { continue };
        let (header, _) = vizflyt_protocol::packet::ImageHeader::parse(&bytes).unwrap();
        got.images[usize::from(header.camera)].fetch_add(1, Ordering::Relaxed);
    }
}

/// Counts a runtime's messages about changed cameras.
async fn messages(mut client: Client, got: Arc<Got>) {
    loop {
        // Without pages, no message may arrive for minutes.
        if let ToRuntime::Camera { .. } = client.next_ever().await {
            got.cameras_changed.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// Messages and images that one page received.
#[derive(Debug, Default)]
struct Seen {
    changes: u64,
    pictures: u64,
    states: u64,
}

struct Page;

impl Page {
    /// Reads until the page has received `all` changes, and some images and states.
    fn open(server: &Server, vehicle: &str, all: &Arc<AtomicU64>) -> JoinHandle<Seen> {
        let origin = format!("http://{}", server.http);
        let path = format!("/ws?vehicle={vehicle}");
        let mut socket = Socket::open_at(server.http, &origin, &path).unwrap();
        // From here on, no event may be missing.
        let history = socket.message("events");
        let mut next = 1 + history["events"].as_array().unwrap().iter().fold(0, index_of);
        let all = all.clone();
        std::thread::spawn(move || {
            let mut seen = Seen::default();
            while seen.changes < all.load(Ordering::Relaxed)
                || seen.pictures == 0
                || seen.states == 0
            {
                let (opcode, payload) = socket.next();
                if opcode == 2 {
                    seen.pictures += 1;
                    continue;
                }
                let message: serde_json::Value = serde_json::from_slice(&payload).unwrap();
                match message["type"].as_str() {
                    Some("state") => seen.states += 1,
                    Some("events") => {
                        for event in message["events"].as_array().unwrap() {
                            let index = index_of(0, event);
                            assert!(index >= next, "event {index} comes twice or late");
                            next = index + 1;
                            let text = event["text"].as_str().unwrap_or_default();
                            seen.changes += u64::from(text.starts_with("camera front is now"));
                        }
                    }
                    _ => {}
                }
            }
            seen
        })
    }
}

fn index_of(most: u64, event: &serde_json::Value) -> u64 {
    most.max(event["index"].as_u64().unwrap())
}

/// Returns the server's resident memory. [MB]
fn rss_mb(server: &Server) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{}/status", server.id())).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<f64>().unwrap() / 1024.0
}
