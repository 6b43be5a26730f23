//! `vizflyt doctor vehicle` with the simulated autopilot: reports dangerous parameters, and corrects them.

use std::process::{Command, Output};
use std::time::Duration;

use vizflyt_e2e::{Demo, vizflyt};

/// Starts a simulated autopilot with these parameters; returns its address.
fn simulator(params: &[&str]) -> (Demo, String) {
    let mut command = Command::new(vizflyt());
    command.args(["sim", "--json", "--mavlink", "tcpin:127.0.0.1:0"]);
    for param in params {
        command.args(["--param", param]);
    }
    let mut simulator = Demo::spawn(&mut command);
    let ready = simulator.wait_for("\"ready\"", Duration::from_secs(30));
    let ready: serde_json::Value = serde_json::from_str(&ready).unwrap();
    let address = format!("tcpout:{}", ready["mavlink"].as_str().unwrap());
    (simulator, address)
}

fn doctor(address: &str, more: &[&str]) -> (Output, String) {
    let output = Command::new(vizflyt())
        .args(["doctor", "vehicle", "--mavlink", address])
        .args(more)
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned()
        + &String::from_utf8_lossy(&output.stderr);
    (output, text)
}

#[test]
fn reports_and_corrects_dangerous_parameters() {
    let (_simulator, address) =
        simulator(&["FS_GCS_ENABLE=1", "RTL_ALT_M=15", "BATT_MONITOR=0", "VISO_DELAY_MS=35"]);
    let (output, text) = doctor(&address, &[]);
    assert_eq!(output.status.code(), Some(1), "{text}");
    for expected in [
        "DANGER   FS_GCS_ENABLE is 1, right is 5",
        "into the ceiling",
        "DANGER   RTL_ALT_M is 15, right is 1",
        "DANGER   BATT_MONITOR is 0, right is 4: the battery is not watched",
        "tuned    VISO_DELAY_MS is 35, and stays",
        "`--apply` writes the right values",
    ] {
        assert!(text.contains(expected), "no '{expected}' in:\n{text}");
    }
    // The first run must not write anything.
    let (_, again) = doctor(&address, &[]);
    assert_eq!(again, text);

    let (output, text) = doctor(&address, &["--apply"]);
    assert!(output.status.success(), "{text}");
    let shown = text.find("DANGER   FS_GCS_ENABLE").unwrap();
    let written = text.find("written  FS_GCS_ENABLE = 5").unwrap();
    assert!(shown < written, "shown before it is written:\n{text}");

    let (output, text) = doctor(&address, &[]);
    assert!(output.status.success() && text.contains("0 dangerous, 0 other differences"), "{text}");
    assert!(
        text.contains("tuned    VISO_DELAY_MS is 35"),
        "what was tuned is not written over:\n{text}"
    );
}

#[test]
fn writes_the_arena_as_the_autopilots_fence() {
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("room");
    let made = Command::new(vizflyt())
        .args(["scene", "generate", "room", "-o", scene.to_str().unwrap()])
        .output();
    assert!(made.unwrap().status.success());
    let path = scene.join("arena.toml");
    let mut arena = std::fs::read_to_string(&path).unwrap();
    let boxes = [("pillar", "-0.5", "3.65"), ("table", "0.0", "0.9")];
    for (name, bottom, top) in boxes {
        arena = format!(
            "{arena}\n[[no_fly]]\nname = \"{name}\"\nmin_m = [6.0, 1.0, {bottom}]\nmax_m = [7.0, 1.5, {top}]\n"
        );
    }
    std::fs::write(&path, arena).unwrap();
    let (_simulator, address) = simulator(&["FENCE_TYPE=3"]);
    let arena = ["--arena", path.to_str().unwrap()];
    let (_, text) = doctor(&address, &arena);
    assert!(text.contains("DANGER   FENCE_TYPE is 3, right is 15"), "{text}");
    let (output, text) = doctor(&address, &[&arena[..], &["--apply"]].concat());
    assert!(output.status.success(), "{text}");
    for expected in [
        "written  FENCE_TYPE = 15",
        "written  FENCE_ALT_MIN = 0.1",
        "written  fence of 2 polygons",
        "does not contain the no-fly boxes at (6.5, 1.2)",
    ] {
        assert!(text.contains(expected), "no '{expected}' in:\n{text}");
    }
}

#[test]
fn reports_a_missing_peer() {
    let (output, text) = doctor("udpin:127.0.0.1:0", &[]);
    assert_eq!(output.status.code(), Some(1));
    assert!(text.contains("no heartbeat from an autopilot"), "{text}");
    let (output, text) = doctor("serial:/dev/no-such-line:57600", &[]);
    assert_eq!(output.status.code(), Some(1));
    assert!(text.contains("serial:/dev/no-such-line:57600"), "{text}");
}

#[test]
fn creates_a_signing_key_only_once() {
    let folder = tempfile::tempdir().unwrap();
    let key = folder.path().join("mavlink.key");
    let (_simulator, address) = simulator(&[]);
    let sign = || {
        let key = key.to_str().unwrap();
        let args = ["vehicle", "sign", "--mavlink", &address, "--key", key];
        Command::new(vizflyt()).args(args).output().unwrap()
    };
    let output = sign();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success() && text.contains("(new; only you can read it)"), "{output:?}");
    assert!(text.contains("sent     to system 1"), "{text}");
    let made = std::fs::read_to_string(&key).unwrap();
    let output = sign();
    assert!(output.status.success() && !String::from_utf8_lossy(&output.stdout).contains("new;"));
    assert_eq!(std::fs::read_to_string(&key).unwrap(), made);
}
