//! Tests of `vizflyt demo` with the real binary and child processes, on loopback and free ports.
//!
//! The tests must not fail on slow machines: limits are generous, and figures must only exist. `over_many_seeds` is the
//! acceptance test of the example plugin.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;
use vizflyt_e2e::{Demo, alive, check_refused, descendants, good};

/// Timeout for loading, baking, arming and climbing on a loaded machine.
const AIRBORNE: Duration = Duration::from_secs(90);
/// Timeout for a complete flight.
const FLIGHT: Duration = Duration::from_mins(4);
/// Line that is printed when the plugin controls the vehicle.
const FLYING: &str = "plugin flies";

/// A report file in a temporary folder.
struct ReportFile(tempfile::TempDir);

impl ReportFile {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }
    fn path(&self) -> String {
        self.0.path().join("report.json").to_str().unwrap().to_owned()
    }
    fn log(&self) -> String {
        self.0.path().join("flights").to_str().unwrap().to_owned()
    }
    fn read(&self) -> Value {
        serde_json::from_str(&std::fs::read_to_string(self.path()).unwrap()).unwrap()
    }
    fn demo(&self, args: &[&str]) -> Demo {
        let (report, log) = (self.path(), self.log());
        let mut all = vec!["--report", &report, "--log-dir", &log];
        all.extend(args);
        Demo::start(&all)
    }
}

fn signal(pid: u32, signal: Signal) {
    kill(Pid::from_raw(pid as i32), signal).unwrap();
}

/// Sends an HTTP request and returns the complete response.
fn http(url: &str, request: &str) -> String {
    http_body(url, request, "")
}

/// Sends an HTTP request with a body.
fn http_body(url: &str, request: &str, body: &str) -> String {
    let address = url.trim_start_matches("http://").trim_end_matches('/');
    let mut stream = TcpStream::connect(address).unwrap();
    let host = format!("Host: {address}\r\nOrigin: http://{address}\r\nConnection: close\r\n");
    let len = body.len();
    write!(stream, "{request} HTTP/1.1\r\n{host}Content-Length: {len}\r\n\r\n{body}").unwrap();
    let mut response = String::new();
    stream.read_to_string(&mut response).unwrap();
    response
}

fn page_url(demo: &mut Demo) -> String {
    demo.wait_for("http://", AIRBORNE).split_whitespace().last().unwrap().to_owned()
}

#[test]
fn flies_the_forest_and_writes_a_report() {
    let file = ReportFile::new();
    let mut demo = file.demo(&["--seed", "7", "--seconds", "90", "--max-rate", "120"]);
    let url = page_url(&mut demo);
    assert!(http(&url, "GET /").contains("<title>"), "the page is served");
    let code = demo.wait(FLIGHT);
    let report = file.read();
    if !demo.has_finished(&report, code) {
        return;
    }
    assert_eq!((&report["image_width"], &report["image_height"]), (&320.into(), &240.into()));
    for figure in [
        "seconds",
        "images_delivered",
        "image_hz",
        "age_ms_p50",
        "age_ms_p99",
        "render_ms_p50",
        "mean_speed_mps",
        "max_speed_mps",
        "min_clearance_m",
        "setpoints_sent",
        "mavlink_packets",
        "peak_rss_mb",
    ] {
        assert!(report[figure].as_f64().is_some_and(|value| value > 0.0), "{figure}: {report:#}");
    }
    let renderer = report["renderer"].as_str().unwrap();
    assert!(renderer.starts_with("cpu ") || renderer.starts_with("gpu "), "{renderer}");
    let log = std::fs::metadata(report["log"].as_str().unwrap()).unwrap();
    assert!(log.len() > 10_000, "the log has {} bytes", log.len());

    // The grader's verdict from the log must be the same.
    let log = report["log"].as_str().unwrap();
    let verdict: Value =
        serde_json::from_str(&good(&["grade", "judge", log, "--seed=7", "--json"])).unwrap();
    assert_eq!(verdict["outcome"], "finished", "{verdict:#}");
    let reason = report["reason"].as_str().unwrap();
    let live_s: f64 = reason.rsplit(' ').nth(1).unwrap().parse().unwrap();
    let judged_s = verdict["seconds"].as_f64().unwrap();
    assert!((live_s - judged_s).abs() < 0.11, "{reason}, and {judged_s} s");
    assert!(verdict["min_clearance_m"].as_f64().unwrap() > 0.0, "{verdict:#}");
    // In another forest the verdict must differ.
    let other = good(&["grade", "judge", log, "--seed=8", "--json"]);
    assert!(serde_json::from_str::<Value>(&other).unwrap() != verdict);
    check_refused(&["grade", "judge", log, "--project=p5"], &["p5 has moving objects"]);
}

/// The server gets a fifth of its processor time, in slices: images are late and few.
#[test]
fn starved_server_slows_the_vehicle_without_collision() {
    let file = ReportFile::new();
    let mut demo = file.demo(&["--seconds", "60", "--max-rate", "120"]);
    demo.wait_for(FLYING, AIRBORNE);
    let server = demo.descendants("vizflyt serve")[0];
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !over.load(Ordering::Relaxed) {
                let id = Pid::from_raw(server.cast_signed());
                // Shorter than the timeout for poses.
                if kill(id, Signal::SIGSTOP).is_err() {
                    return;
                }
                std::thread::sleep(Duration::from_millis(110));
                let _ = kill(id, Signal::SIGCONT);
                std::thread::sleep(Duration::from_millis(25));
            }
        });
        demo.wait(FLIGHT);
        over.store(true, Ordering::Relaxed);
    });
    let report = file.read();
    println!("{} after {} s", report["reason"], report["seconds"]);
    assert_ne!(report["outcome"], "collided", "{report:#} {:#?}", demo.seen);
    let is_told = |line: &String| line.contains("the plugin's images are") || line.contains("hold");
    assert!(demo.seen.iter().any(is_told), "{:#?}", demo.seen);
}

/// No motion capture: webcams, tags and the filter; all other parts as usual.
#[test]
fn flies_the_room_with_tags_only() {
    let file = ReportFile::new();
    let mut demo = file.demo(&["--localization", "tags", "--seconds", "120"]);
    let code = demo.wait(FLIGHT);
    let report = file.read();
    if !demo.has_finished(&report, code) {
        return;
    }
    let tags = &report["localization"];
    assert!(tags["located"].as_u64().unwrap() > 200, "{tags:#}");
}

/// At least nine of ten generated forests are flown without touching the true geometry, at a mean speed of at least 2
/// m/s. `grade.rs` flies twenty in lock-step, with the same result on every machine; these flights are in real time.
#[test]
fn over_many_seeds() {
    let seeds: u64 =
        std::env::var("VIZFLYT_SEEDS").ok().and_then(|text| text.parse().ok()).unwrap_or(5);
    let mut finished = Vec::new();
    let mut failed = Vec::new();
    for seed in 1..=seeds {
        let file = ReportFile::new();
        let mut demo = file.demo(&["--seed", &seed.to_string(), "--max-rate", "120"]);
        demo.wait(FLIGHT);
        let report = file.read();
        println!(
            "seed {seed:2}: {} {:.1} s, {:.2} m/s, clearance {} m",
            report["outcome"],
            report["seconds"].as_f64().unwrap(),
            report["mean_speed_mps"].as_f64().unwrap(),
            report["min_clearance_m"]
        );
        let touched = report["min_clearance_m"].as_f64().unwrap() <= 0.0;
        if report["outcome"] == "finished" && !touched {
            finished.push(report["mean_speed_mps"].as_f64().unwrap());
        } else {
            failed.push((seed, report["reason"].clone()));
        }
    }
    let allowed = seeds.div_ceil(10) as usize;
    assert!(failed.len() <= allowed, "{} of {seeds} failed: {failed:?}", failed.len());
    let mean_mps = finished.iter().sum::<f64>() / finished.len() as f64;
    assert!(mean_mps >= 2.0, "mean speed {mean_mps:.2} m/s");
}

#[test]
fn lands_and_reports_the_signal_if_the_plugin_is_killed() {
    let file = ReportFile::new();
    let mut demo = file.demo(&[]);
    demo.wait_for(FLYING, AIRBORNE);
    let plugin = demo.descendants("vizflyt plugin avoid");
    assert_eq!(plugin.len(), 1, "one plugin process");
    signal(plugin[0], Signal::SIGKILL);
    assert_eq!(demo.wait(FLIGHT), Some(1));
    let report = file.read();
    assert_eq!(report["outcome"], "plugin_failed", "{report:#}");
    let reason = report["reason"].as_str().unwrap();
    assert!(reason.contains("SIGKILL"), "the reason names the signal: {reason}");
    assert!(demo.seen.iter().any(|line| line.contains("on the ground")), "{:#?}", demo.seen);
}

#[test]
fn holds_and_lands_if_the_server_is_killed() {
    let file = ReportFile::new();
    let mut demo = file.demo(&[]);
    demo.wait_for(FLYING, AIRBORNE);
    let server = demo.descendants("vizflyt serve");
    assert_eq!(server.len(), 1);
    signal(server[0], Signal::SIGKILL);
    demo.wait_for("hold", FLIGHT);
    demo.wait_for("land", FLIGHT);
    assert_eq!(demo.wait(FLIGHT), Some(1));
    assert_ne!(file.read()["outcome"], "finished");
    assert!(demo.seen.iter().any(|line| line.contains("on the ground")), "{:#?}", demo.seen);
}

#[test]
fn stop_button_lands_the_vehicle() {
    let file = ReportFile::new();
    let mut demo = file.demo(&[]);
    let url = page_url(&mut demo);
    demo.wait_for(FLYING, AIRBORNE);
    let response = http(&url, "POST /api/estop");
    assert!(response.starts_with("HTTP/1.1 2"), "{response}");
    assert_eq!(demo.wait(FLIGHT), Some(1));
    let report = file.read();
    assert_eq!(report["outcome"], "landed", "{report:#}");
    assert!(report["reason"].as_str().unwrap().contains("stop"), "{report:#}");
    // The touch-down is a motion, not a fault of the localization.
    assert!(!demo.seen.iter().any(|line| line.contains("an outlier")), "{:#?}", demo.seen);
}

#[test]
fn plugin_flies_on_if_a_camera_changes_in_flight() {
    let file = ReportFile::new();
    let mut demo = file.demo(&["--seed", "7", "--seconds", "90"]);
    let url = page_url(&mut demo);
    demo.wait_for(FLYING, AIRBORNE);
    let cameras = http(&url, "GET /api/vehicles/vizflyt/cameras");
    assert!(cameras.contains("\"name\":\"front\""), "{cameras}");
    let change = r#"{"width_px": 400, "height_px": 200, "horizontal_fov_deg": 100}"#;
    let response = http_body(&url, "PATCH /api/vehicles/vizflyt/cameras/front", change);
    assert!(response.starts_with("HTTP/1.1 200"), "{response}");
    demo.wait_for("camera front is now 400x200 px", AIRBORNE);
    let response =
        http_body(&url, "PATCH /api/vehicles/vizflyt/cameras/front", r#"{"near_m": -1}"#);
    assert!(response.starts_with("HTTP/1.1 400") && response.contains("near_m"), "{response}");
    let code = demo.wait(FLIGHT);
    let report = file.read();
    // The example plugin uses the intrinsics of each image.
    if !demo.has_finished(&report, code) {
        return;
    }
    assert_eq!((&report["image_width"], &report["image_height"]), (&400.into(), &200.into()));
}

#[test]
fn rejects_the_stop_button_of_another_site() {
    let file = ReportFile::new();
    let mut demo = file.demo(&[]);
    let url = page_url(&mut demo);
    let address = url.trim_start_matches("http://").trim_end_matches('/');
    let mut stream = TcpStream::connect(address).unwrap();
    write!(
        stream,
        "POST /api/estop HTTP/1.1\r\nHost: {address}\r\nOrigin: http://evil.example\r\n\
         Connection: close\r\nContent-Length: 0\r\n\r\n"
    )
    .unwrap();
    let mut response = String::new();
    stream.read_to_string(&mut response).unwrap();
    assert!(response.starts_with("HTTP/1.1 403"), "{response}");
}

#[test]
fn interrupt_ends_every_process() {
    let file = ReportFile::new();
    let mut demo = file.demo(&[]);
    demo.wait_for(FLYING, AIRBORNE);
    let family = descendants(demo.pid());
    assert!(family.len() >= 4, "server, runtime, simulator, plugin: {family:?}");
    let start = Instant::now();
    signal(demo.pid(), Signal::SIGINT);
    demo.wait(Duration::from_secs(20));
    println!("ended {:.2} s after the interrupt", start.elapsed().as_secs_f64());
    // The guardian ends after the vehicle is silent.
    let deadline = Instant::now() + Duration::from_secs(20);
    let is_guardian = |pid: u32| {
        let line = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        line.split(|byte| *byte == 0).nth(1) == Some(b"guardian")
    };
    let left = || family.iter().copied().filter(|&pid| alive(pid));
    let others: Vec<_> = left().filter(|&pid| !is_guardian(pid)).collect();
    assert!(others.is_empty(), "still alive: {others:?}");
    while left().next().is_some() {
        assert!(Instant::now() < deadline, "the guardian stays");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn no_process_outlives_a_killed_demo() {
    let file = ReportFile::new();
    let mut demo = file.demo(&[]);
    demo.wait_for(FLYING, AIRBORNE);
    let family = descendants(demo.pid());
    signal(demo.pid(), Signal::SIGKILL);
    let deadline = Instant::now() + Duration::from_secs(30);
    while family.iter().any(|&pid| alive(pid)) {
        assert!(Instant::now() < deadline, "a child outlives the killed demo");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn two_demos_fly_side_by_side() {
    let (first, second) = (ReportFile::new(), ReportFile::new());
    let mut one = first.demo(&["--seed", "3", "--seconds", "8"]);
    let mut two = second.demo(&["--seed", "4", "--seconds", "8"]);
    let (a, b) = (page_url(&mut one), page_url(&mut two));
    assert_ne!(a, b);
    one.wait_for(FLYING, AIRBORNE);
    two.wait_for(FLYING, AIRBORNE);
    one.wait(FLIGHT);
    two.wait(FLIGHT);
    for file in [first, second] {
        let report = file.read();
        let images = report["images_delivered"].as_u64().unwrap();
        assert!(images > 10, "each demo flies its own plugin: {report:#}");
    }
}

#[test]
fn renders_a_captured_scene() {
    let scene = vizflyt_e2e::root().join("../shared/scenes/room.ply");
    if !scene.exists() {
        println!("skipped: the captured room is not next to the repository");
        return;
    }
    let file = ReportFile::new();
    let mut demo = file.demo(&["--scene", scene.to_str().unwrap(), "--seconds", "10"]);
    demo.wait(FLIGHT);
    let report = file.read();
    assert!(report["images_delivered"].as_u64().unwrap() > 10, "{report:#}");
    assert_ne!(report["outcome"], "error", "{report:#}");
}

/// Small model of a scene larger than memory: rendered from the disk, with the trees in their places.
#[test]
fn flies_in_a_packed_scene() {
    let file = ReportFile::new();
    let at = |name: &str| file.0.path().join(name).to_str().unwrap().to_owned();
    let (forest, packed) = (at("forest"), at("forest/forest.packed"));
    good(&["scene", "generate", "forest", "--seed", "7", "-o", &forest]);
    let arena = at("forest/arena.toml");
    let in_memory = good(&["arena", "check", &arena]);
    good(&["scene", "pack", &arena, &packed]);
    std::fs::remove_file(at("forest/scene.ply")).unwrap();
    let text = std::fs::read_to_string(&arena).unwrap();
    let name = |scene: &str| {
        let named = text.replacen(r#"scene = "scene.ply""#, scene, 1);
        std::fs::write(&arena, named).unwrap();
    };
    name(r#"scene = { file = "forest.packed", up = "-y" }"#);
    check_refused(&["arena", "check", &arena], &["a packed scene lies where it was packed"]);
    name(r#"scene = "forest.packed""#);
    // The obstacles are the same: the shortest path around them has the same length.
    assert_eq!(good(&["arena", "check", &arena]), in_memory);
    check_refused(&["scene", "inspect", &packed], &["a packed scene", "that it was packed from"]);

    let mut demo = file.demo(&["--scene", &forest, "--seconds", "8"]);
    demo.wait(FLIGHT);
    let report = file.read();
    assert!(report["renderer"].as_str().unwrap().ends_with("streamed"), "{report:#}");
    assert!(report["images_delivered"].as_u64().unwrap() > 100, "{report:#}");
    assert_ne!(report["outcome"], "error", "{report:#}");
    // The grader judges the log by the generated forest.
    let log = report["log"].as_str().unwrap();
    let verdict: Value =
        serde_json::from_str(&good(&["grade", "judge", log, "--seed=7", "--json"])).unwrap();
    assert!(verdict["min_clearance_m"].as_f64().unwrap() > 0.0, "{verdict:#}");
    assert_eq!(verdict["outcome"], report["outcome"], "{report:#} {verdict:#}");
}
