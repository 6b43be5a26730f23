//! `vizflyt doctor localization` while a simulated hand carries the vehicle about: it names the setting
//! that is wrong, and finds nothing where none is.

use std::net::UdpSocket;
use std::process::Command;
use std::time::Duration;

use vizflyt_e2e::{Demo, vizflyt};

/// Five motions of three seconds, twice if the first was not seen from its beginning, on a busy machine.
const CHECKED: Duration = Duration::from_mins(2);

/// Returns an address that nobody uses.
fn free() -> String {
    UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string()
}

/// Lets the hand carry the vehicle before a motion capture of this `format`, and the doctor look at it
/// as `settings` say; returns whether it finds no fault, and its output.
fn doctor(format: &str, settings: &str, within: &str) -> (bool, String) {
    let address = free();
    let mut doctor = Command::new(vizflyt());
    doctor.args(["doctor", "localization", "--within", within]);
    doctor.args(["--pose", &format!("{format}:{address}{settings}")]);
    let mut doctor = Demo::spawn(&mut doctor);
    // By then its socket is there; the hand begins with the vehicle on the floor.
    doctor.wait_for("listens", CHECKED);
    let mut simulator = Command::new(vizflyt());
    simulator.args(["sim", "--json", "--hand", "--spawn=1,2,0,20", "--mavlink=udpout:127.0.0.1:9"]);
    simulator.args(["--mocap", &format!("{format}:{address}")]);
    let _simulator = Demo::spawn(&mut simulator);
    let code = doctor.wait(CHECKED);
    (code == Some(0), doctor.seen.join("\n"))
}

/// Carries a vehicle for each case, all at once: a hand and its doctor mostly wait.
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
fn motive_s_up_axis_is_found() {
    check(&[
        ("natnet", "", &["lifted, it went along +y, not up", "set      up = \"y\""]),
        ("natnet", ",up=y", &["up is +z", "right    axes"]),
    ]);
}

#[test]
fn wrong_units_orders_and_mirrors_are_found() {
    check(&[
        ("json", ",units=mm", &["it went 0.50 mm", "set      units = \"m\""]),
        ("json", ",axes=x-yz", &["it turned right by", "set      axes = \"xyz\""]),
        ("vicon", ",euler=zyx", &["with its nose raised", "set      euler = \"xyz\""]),
        ("mavlink", ",nose=y", &["pushed the way its nose points", "set      nose = \"x\""]),
    ]);
}

/// The autopilot's gyroscope feels the hand, and the motion capture shows it later.
#[test]
fn the_delay_of_the_poses_is_measured() {
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

/// A whole flight whose poses come as Motive streams them; and its log as a source of poses.
#[test]
fn the_forest_is_flown_on_natnet_and_its_log_is_a_source() {
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
fn a_vehicle_with_another_name_is_reported() {
    let (is_content, text) = doctor("json", ",objects.vizflyt=wasp", "10");
    assert!(!is_content);
    assert!(text.contains("object 'vizflyt' streams, but 'wasp' was asked for"), "{text}");
}
