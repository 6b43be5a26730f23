//! `vizflyt doctor localization` while a simulated hand carries the vehicle: it names a wrong setting, and reports no
//! fault if all are right.

use std::net::UdpSocket;
use std::process::Command;
use std::time::Duration;

use vizflyt_e2e::{Demo, vizflyt};

/// Timeout: five motions of three seconds, twice if a busy machine missed the start of the first.
const CHECKED: Duration = Duration::from_mins(2);

/// Returns a free address.
fn free() -> String {
    UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string()
}

/// Simulates a hand that carries the vehicle in a motion capture of this `format`, and runs the doctor with `settings`.
/// Returns whether it reports no fault, and its output.
fn doctor(format: &str, settings: &str, within: &str) -> (bool, String) {
    let address = free();
    let mut doctor = Command::new(vizflyt());
    doctor.args(["doctor", "localization", "--within", within]);
    doctor.args(["--pose", &format!("{format}:{address}{settings}")]);
    let mut doctor = Demo::spawn(&mut doctor);
    // Its socket is open now; the hand starts with the vehicle on the floor.
    doctor.wait_for("listens", CHECKED);
    let mut simulator = Command::new(vizflyt());
    simulator.args(["sim", "--json", "--hand", "--spawn=1,2,0,20", "--mavlink=udpout:127.0.0.1:9"]);
    simulator.args(["--mocap", &format!("{format}:{address}")]);
    let _simulator = Demo::spawn(&mut simulator);
    let code = doctor.wait(CHECKED);
    (code == Some(0), doctor.seen.join("\n"))
}

/// Carries a vehicle for each case, all in parallel: a hand and its doctor mostly wait.
fn check(cases: &[(&str, &str, &[&str])]) {
    std::thread::scope(|scope| {
        for (format, settings, expected) in cases {
            scope.spawn(|| check_one(format, settings, expected));
        }
    });
}

fn check_one(format: &str, settings: &str, expected: &[&str]) {
    let (is_content, text) = doctor(format, settings, "100");
    for line in expected {
        assert!(text.contains(line), "{format}{settings}: no '{line}' in:\n{text}");
    }
    assert_eq!(is_content, !text.contains("WRONG"), "{text}");
    assert_eq!(is_content, text.contains("right    axes, units and turns"), "{text}");
}

#[test]
fn finds_motives_up_axis() {
    check(&[
        ("natnet", "", &["lifted, it went along +y, not up", "set      up = \"y\""]),
        ("natnet", ",up=y", &["up is +z", "right    axes"]),
    ]);
}

#[test]
fn finds_wrong_units_orders_and_mirrors() {
    check(&[
        ("json", ",units=mm", &["it went 0.50 mm", "set      units = \"m\""]),
        ("json", ",axes=x-yz", &["it turned right by", "set      axes = \"xyz\""]),
        ("vicon", ",euler=zyx", &["with its nose raised", "set      euler = \"xyz\""]),
        ("mavlink", ",nose=y", &["pushed the way its nose points", "set      nose = \"x\""]),
    ]);
}

/// The autopilot's gyroscope measures the hand's motion, and the motion capture shows it later.
#[test]
fn measures_the_delay_of_the_poses() {
    for (delay_ms, set) in [(80, ""), (40, ",latency_ms=40")] {
        let (address, mavlink) = (free(), free());
        let mut doctor = Command::new(vizflyt());
        doctor.args(["doctor", "localization", "--within=100"]);
        doctor.arg(format!("--mavlink=udpin:{mavlink}"));
        doctor.args(["--pose", &format!("json:{address}{set}")]);
        let mut doctor = Demo::spawn(&mut doctor);
        doctor.wait_for("gyroscope", CHECKED);
        let mut simulator = Command::new(vizflyt());
        simulator.args(["sim", "--json", "--hand", "--spawn=1,2,0,20"]);
        simulator.arg(format!("--mavlink=udpout:{mavlink}"));
        simulator.args(["--mocap", &format!("json:{address}")]);
        simulator.arg(format!("--mocap-delay-ms={delay_ms}"));
        let _simulator = Demo::spawn(&mut simulator);
        let code = doctor.wait(CHECKED);
        let text = doctor.seen.join("\n");
        let found = text.split_once("show a turn ").and_then(|(_, rest)| rest.split_once(" ms"));
        let found_ms: f64 = found.expect(&text).0.parse().expect(&text);
        assert!((found_ms - f64::from(delay_ms)).abs() <= 10.0, "{text}");
        assert_eq!(text.contains("set      latency_ms = "), set.is_empty(), "{text}");
        assert_eq!(code == Some(0), !set.is_empty(), "{text}");
    }
}

/// A complete flight with poses in Motive's format; then its log is a source of poses.
#[test]
fn flies_the_forest_with_natnet_and_replays_its_poses() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let (report, log) = (at("report.json"), at("flights"));
    let mut demo = Demo::start(&[
        "--localization=natnet",
        "--seed=7",
        "--seconds=90",
        "--report",
        &report,
        "--log-dir",
        &log,
    ]);
    let code = demo.wait(Duration::from_mins(5));
    let report: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(&report).unwrap()).unwrap();
    if !demo.has_finished(&report, code) {
        return;
    }

    let log = std::fs::read_dir(&log).unwrap().next().unwrap().unwrap().path();
    let receiver = UdpSocket::bind("127.0.0.1:0").unwrap();
    receiver.set_read_timeout(Some(Duration::from_mins(1))).unwrap();
    let mut replay = Command::new(vizflyt());
    replay.arg("replay").arg(&log).args(["--object=bee", "--poses-to"]);
    let replay = Demo::spawn(replay.arg(receiver.local_addr().unwrap().to_string()));
    let (mut buffer, mut stamps) = ([0; 2048], Vec::new());
    while stamps.len() < 100 {
        let length = receiver.recv(&mut buffer).unwrap();
        let packet: serde_json::Value = serde_json::from_slice(&buffer[..length]).unwrap();
        assert_eq!((&packet["vizflyt_pose"], &packet["object"]), (&1.into(), &"bee".into()));
        stamps.push(packet["stamp_ns"].as_u64().unwrap());
    }
    assert!(stamps.is_sorted() && stamps[99] > stamps[0], "{stamps:?}");
    drop(replay);
}

#[test]
fn reports_a_vehicle_with_another_name() {
    let (is_content, text) = doctor("json", ",objects.vizflyt=wasp", "10");
    assert!(!is_content);
    assert!(text.contains("object 'vizflyt' streams, but 'wasp' was asked for"), "{text}");
}
