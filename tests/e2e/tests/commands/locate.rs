//! `vizflyt tags locate` as a program: receives true poses, renders webcams, sends the located pose; and its errors for
//! wrong settings.

use std::net::UdpSocket;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use glam::{DQuat, DVec3};
use nix::time::{ClockId, clock_gettime};
use serde_json::{Value, json};
use vizflyt_e2e::{Demo, vizflyt};

/// Timeout, for any load of the machine.
const PATIENCE: Duration = Duration::from_mins(1);

fn now_ns() -> u64 {
    let now = clock_gettime(ClockId::CLOCK_MONOTONIC).unwrap();
    now.tv_sec() as u64 * 1_000_000_000 + now.tv_nsec() as u64
}

/// Returns the pose of the vehicle: a slow circle in the hall's centre.
fn truth(stamp_ns: u64) -> (DVec3, DQuat) {
    let angle = (stamp_ns % 1_000_000_000_000) as f64 * 0.5e-9;
    let p_m = DVec3::new(5.5 + 0.8 * angle.cos(), 0.6 * angle.sin(), 1.2);
    (p_m, DQuat::from_rotation_z(0.3 * angle.sin()))
}

#[test]
fn simulated_webcams_locate_the_true_pose() {
    let receiver = UdpSocket::bind("127.0.0.1:0").unwrap();
    receiver.set_read_timeout(Some(PATIENCE)).unwrap();
    let to = receiver.local_addr().unwrap().to_string();
    let mut program = Demo::spawn(Command::new(vizflyt()).args([
        "tags",
        "locate",
        "--simulated",
        "--object=wasp",
        "--json",
        "--http=127.0.0.1:0",
        "--to",
        &to,
    ]));
    let ready: Value = serde_json::from_str(&program.wait_for("\"ready\"", PATIENCE)).unwrap();
    assert_eq!(ready["ready"], "tags");
    assert_eq!(ready["cameras"], json!(["west", "east"]));
    let target = ready["truth"].as_str().unwrap().to_owned();

    let done = Arc::new(AtomicBool::new(false));
    let feed = std::thread::spawn({
        let done = Arc::clone(&done);
        move || {
            let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
            while !done.load(Ordering::Relaxed) {
                let stamp_ns = now_ns();
                let (p_m, rotation) = truth(stamp_ns);
                let packet = json!({
                    "vizflyt_pose": 1, "object": "wasp", "stamp_ns": stamp_ns, "clock": "server",
                    "position_m": p_m.to_array(), "rotation_xyzw": rotation.to_array(),
                });
                socket.send_to(packet.to_string().as_bytes(), &target).unwrap();
                std::thread::sleep(Duration::from_millis(4));
            }
        }
    });

    let deadline = Instant::now() + PATIENCE;
    let (mut poses, mut errors_m) = (0, Vec::new());
    let mut bytes = [0; 4096];
    while poses < 60 {
        assert!(Instant::now() < deadline, "{poses} poses came");
        let length = receiver.recv(&mut bytes).expect("poses come");
        let pose: Value = serde_json::from_slice(&bytes[..length]).unwrap();
        assert_eq!((&pose["object"], &pose["clock"]), (&json!("wasp"), &json!("server")));
        let number = |value: &Value| value.as_f64().unwrap();
        let p: Vec<f64> = pose["position_m"].as_array().unwrap().iter().map(number).collect();
        let (true_m, _) = truth(pose["stamp_ns"].as_u64().unwrap());
        errors_m.push(DVec3::new(p[0], p[1], p[2]).distance(true_m));
        assert!(pose["position_sigma_m"][2].as_f64().unwrap() > 0.0);
        assert!(pose["quality"]["tags"].as_u64().unwrap() >= 1);
        poses += 1;
    }
    done.store(true, Ordering::Relaxed);
    feed.join().unwrap();
    // A loaded machine drops images, and a single distant camera is less accurate.
    errors_m.sort_by(f64::total_cmp);
    assert!(errors_m[poses / 2] < 0.02, "{} m in the middle", errors_m[poses / 2]);
    assert!(errors_m[poses * 9 / 10] < 0.1, "{errors_m:?}");
    let status: Value = serde_json::from_str(&program.wait_for("\"located\"", PATIENCE)).unwrap();
    assert!(status["status"]["images"].is_u64(), "{status}");
}

#[test]
fn errors_name_invalid_localization_settings() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let check = |text: &str, part: &str| {
        std::fs::write(at("lab.toml"), text).unwrap();
        let output =
            Command::new(vizflyt()).args(["tags", "locate"]).arg(at("lab.toml")).output().unwrap();
        let error = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success() && error.contains(part), "{error:?} lacks {part:?}");
    };
    check("cameras = []\nlayouts = [\"cube.toml\"]", "name 1 to 8");
    check("cameras = [\"a.toml\"]\nlayouts = [\"cube.toml\"]", "a.toml");
    let made = Command::new(vizflyt())
        .args(["tags", "print", "cube", "-o"])
        .arg(at("cube.pdf"))
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let lens = "name = \"west\"\nwidth_px = 640\nheight_px = 480\nfx_px = 600.0\nfy_px = 600.0\n\
                cx_px = 320.0\ncy_px = 240.0\n";
    std::fs::write(at("a.toml"), lens).unwrap();
    let good = "cameras = [\"a.toml\"]\nlayouts = [\"cube.toml\"]";
    check(good, "\"west\" has neither world_from_cam nor body_from_cam");
    let mounted = format!(
        "{lens}[world_from_cam]\nposition_m = [0.0, 0.0, 2.5]\nrotation_xyzw = [-0.5, 0.5, -0.5, 0.5]\n"
    );
    std::fs::write(at("a.toml"), &mounted).unwrap();
    check(good, "\"west\" has no source");
    std::fs::write(at("a.toml"), format!("source = \"/dev/no-such-camera\"\n{mounted}")).unwrap();
    check(good, "/dev/no-such-camera");
}
