//! Flights in the room localized only by a webcam under the vehicle over a mat of tags. The fused pose is compared with
//! the simulator's true pose, which is sent separately.

use std::fs::File;
use std::net::UdpSocket;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use glam::{DQuat, DVec3};
use serde_json::Value;
use vizflyt_e2e::{Demo, check_refused};
use vizflyt_runtime::log::read::{Entry, LogReader, RecordedPoses};

/// Timeout for a complete flight on a loaded machine.
const FLIGHT: Duration = Duration::from_mins(4);
/// Height of take-off and landing, in which no large tag is completely visible. [m]
const LOW_M: f64 = 0.4;
/// Maximum height of a standing vehicle. [m]
const STANDS_M: f64 = 0.02;

/// True poses of the vehicle, on the clock of the pose stamps.
struct Truth {
    stamps_ns: Vec<u64>,
    poses: Vec<(DVec3, DQuat)>,
}

impl Truth {
    /// Returns the pose at a time.
    fn at(&self, stamp_ns: u64) -> Option<(DVec3, DQuat)> {
        let after = self.stamps_ns.partition_point(|at| *at < stamp_ns);
        let before = after.checked_sub(1)?;
        let (from_ns, to_ns) = (self.stamps_ns[before], *self.stamps_ns.get(after)?);
        let ((p, q), (next_p, next_q)) = (self.poses[before], self.poses[after]);
        let share = (stamp_ns - from_ns) as f64 / (to_ns - from_ns) as f64;
        Some((p.lerp(next_p, share), q.slerp(next_q, share)))
    }

    /// Returns the times of take-off and landing. [ns]
    fn flight_ns(&self) -> (u64, u64) {
        let is_up = |(p, _): &(DVec3, DQuat)| p.z > STANDS_M;
        let first = self.poses.iter().position(is_up).expect("it took off");
        let last = self.poses.iter().rposition(is_up).expect("it took off");
        (self.stamps_ns[first], self.stamps_ns[last])
    }
}

/// Receives true poses until `done` is set.
fn listen(socket: &UdpSocket, done: &AtomicBool) -> Truth {
    socket.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
    let mut truth = Truth { stamps_ns: Vec::new(), poses: Vec::new() };
    let mut bytes = [0; 2048];
    while !done.load(Ordering::Relaxed) {
        let Ok(length) = socket.recv(&mut bytes) else { continue };
        let packet: Value = serde_json::from_slice(&bytes[..length]).unwrap();
        let numbers = |key: &str| -> Vec<f64> {
            packet[key].as_array().unwrap().iter().map(|value| value.as_f64().unwrap()).collect()
        };
        truth.stamps_ns.push(packet["stamp_ns"].as_u64().unwrap());
        let (p, q) = (numbers("position_m"), numbers("rotation_xyzw"));
        truth.poses.push((DVec3::from_slice(&p), DQuat::from_slice(&q)));
    }
    truth
}

/// Errors of fused poses, and their sigmas.
#[derive(Default)]
struct Errors {
    off_m: Vec<f64>,
    off_rad: Vec<f64>,
    /// Squared position errors in sigmas, summed over the axes.
    squares: Vec<f64>,
}

impl Errors {
    fn rms_mm(&self) -> f64 {
        1e3 * mean(self.off_m.iter().map(|m| m * m)).sqrt()
    }
    fn p99_mm(&self) -> f64 {
        let mut sorted = self.off_m.clone();
        sorted.sort_by(f64::total_cmp);
        1e3 * sorted[(sorted.len() * 99 / 100).min(sorted.len() - 1)]
    }
    fn rms_deg(&self) -> f64 {
        mean(self.off_rad.iter().map(|rad| rad * rad)).sqrt().to_degrees()
    }
    /// Returns the mean squared error in sigmas per axis; 1 means correct sigmas.
    fn nees_per_axis(&self) -> f64 {
        mean(self.squares.iter().copied()) / 3.0
    }
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len() as f64;
    values.sum::<f64>() / count
}

/// Compares the poses of a flight log with the truth: of the complete flight, and of its low part.
fn compare(log: &Path, truth: &Truth) -> (Errors, Errors) {
    let mut poses = RecordedPoses::new(LogReader::open(log).unwrap());
    let mut entries = LogReader::new(File::open(log).unwrap()).unwrap();
    let (begin_ns, end_ns) = truth.flight_ns();
    let (mut all, mut low) = (Errors::default(), Errors::default());
    while let Some(entry) = entries.next().unwrap() {
        let Entry::Message(message) = entry else { continue };
        if &*message.topic != "/motion" {
            continue;
        }
        // Each pose is followed by its velocity and its sigmas.
        let recorded = poses.next().unwrap().expect("a pose for each motion");
        assert_eq!(recorded.at_ns, message.log_time_ns);
        let motion: Value = serde_json::from_slice(&message.data).unwrap();
        let stamp_ns = motion["stamp_ns"].as_u64().unwrap();
        let Some((p, q)) = truth.at(stamp_ns) else { continue };
        if !(begin_ns..=end_ns).contains(&stamp_ns) {
            continue;
        }
        let off_m = recorded.world_from_body.translation_m - p;
        let off_rad = recorded.world_from_body.rotation.angle_between(q);
        let sigma: Vec<f64> = serde_json::from_value(motion["position_sigma_m"].clone()).unwrap();
        let square = (off_m / DVec3::from_slice(&sigma)).length_squared();
        let both = [Some(&mut all), (p.z < LOW_M).then_some(&mut low)];
        for errors in both.into_iter().flatten() {
            errors.off_m.push(off_m.length());
            errors.off_rad.push(off_rad);
            errors.squares.push(square);
        }
    }
    (all, low)
}

/// Flies the room over the mat with seeded errors of survey and mount, and checks the accuracy.
fn fly(seed: u32) {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let (report, flights, seed) = (at("report.json"), at("flights"), seed.to_string());
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let truth_to = socket.local_addr().unwrap().to_string();
    let done = Arc::new(AtomicBool::new(false));
    let truth = std::thread::spawn({
        let done = Arc::clone(&done);
        move || listen(&socket, &done)
    });
    let mut demo = Demo::start(&[
        "--localization=mat",
        "--seconds=60",
        "--seed",
        &seed,
        "--report",
        &report,
        "--log-dir",
        &flights,
        "--truth-to",
        &truth_to,
    ]);
    let code = demo.wait(FLIGHT);
    done.store(true, Ordering::Relaxed);
    let truth = truth.join().unwrap();
    let report: Value = serde_json::from_str(&std::fs::read_to_string(&report).unwrap()).unwrap();
    let (all, low) = compare(Path::new(report["log"].as_str().unwrap()), &truth);
    for (what, errors) in [("flight", &all), ("low", &low)] {
        println!(
            "seed {seed}, {what}: {} poses, {:.1} mm rms, {:.1} mm p99, {:.2} deg rms, NEES/3 {:.2}",
            errors.off_m.len(),
            errors.rms_mm(),
            errors.p99_mm(),
            errors.rms_deg(),
            errors.nees_per_axis(),
        );
    }
    println!("tags: {}", report["localization"]);
    if !demo.has_finished(&report, code) {
        return;
    }
    // From arming to standing on the other pad, each image must give a pose, on any machine; half a second without
    // poses would end the flight.
    let tags = &report["localization"];
    assert_eq!(tags["located"], tags["sets"], "{tags:#}");
    for errors in [&all, &low] {
        assert!(errors.off_m.len() > 10, "{} poses", errors.off_m.len());
        assert!(errors.rms_mm() < 6.0 && errors.p99_mm() < 26.0);
        assert!(errors.rms_deg() < 1.0);
    }
    assert!((0.5..2.0).contains(&all.nees_per_axis()), "{}", all.nees_per_axis());
}

#[test]
fn flies_the_room_with_a_mat_only() {
    let seeds: u32 =
        std::env::var("VIZFLYT_SEEDS").ok().and_then(|text| text.parse().ok()).unwrap_or(1);
    for seed in 7..7 + seeds {
        fly(seed);
    }
}

#[test]
fn rejects_a_scene_larger_than_the_mat() {
    let forest = ["demo", "--headless", "--localization=mat", "--scene=forest"];
    check_refused(&forest, &["the mat covers a hall of 11 x 4.5 m", "use --scene room or race"]);
}
