//! Pairing at the command line: two folders of keys represent two computers.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};

use serde_json::Value;
use vizflyt_e2e::{run, vizflyt};

/// `vizflyt serve`, killed when dropped.
struct Server {
    child: Child,
    lines: BufReader<std::process::ChildStdout>,
}

impl Server {
    fn start(arena: &Path, keys: &Path) -> Self {
        let mut child = Command::new(vizflyt())
            .args(["serve", "--leaderboard=none"])
            .arg(arena)
            .arg("--keys")
            .arg(keys)
            .args(["--json", "--quic", "127.0.0.1:0", "--http", "127.0.0.1:0"])
            .args(["--vicon", "127.0.0.1:0", "--renderer", "cpu", "--pair", "team:vizflyt"])
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap());
        Self { child, lines }
    }

    /// Returns the next line with `key`.
    fn line(&mut self, key: &str) -> Value {
        loop {
            let mut text = String::new();
            assert!(self.lines.read_line(&mut text).unwrap() > 0, "the server ended");
            let line: Value = serde_json::from_str(&text).unwrap();
            if line.get(key).is_some() {
                return line;
            }
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn text_of(output: &Output) -> String {
    let text = |bytes| String::from_utf8_lossy(bytes).into_owned();
    text(&output.stdout) + &text(&output.stderr)
}

#[test]
fn unpaired_computer_is_rejected_and_accepted_after_pairing() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (scene, server_keys, keys) = (at("scene"), at("server"), at("jetson"));
    assert!(run(&["scene", "generate", "room", "-o", &scene]).status.success());
    let mut server =
        Server::start(&folder.path().join("scene/arena.toml"), Path::new(&server_keys));
    let ready = server.line("ready");
    let code = server.line("pairing")["pairing"]["code"].as_str().unwrap().to_owned();
    let address = ready["quic"].as_str().unwrap().to_owned();
    let fingerprint = ready["fingerprint"].as_str().unwrap();
    let log = at("flights");
    let fly = |more: &[&str]| {
        let mut args = vec!["fly", "avoid", "--server", &address, "--keys", &keys];
        args.extend(["--mavlink", "udpin:127.0.0.1:0", "--ready-within", "3", "--log-dir", &log]);
        args.extend(more);
        let output = run(&args);
        assert!(!output.status.success(), "there is no vehicle to fly");
        text_of(&output)
    };

    // First without a known server, then with a server that does not know this computer.
    let advice = format!("run `vizflyt pair {address}`");
    let text = fly(&[]);
    assert!(text.contains("not paired") && text.contains(&advice), "{text}");
    let text = fly(&["--fingerprint", fingerprint]);
    assert!(text.contains("not paired with the server") && text.contains(&advice), "{text}");

    let wrong = if code == "000 000" { "111111" } else { "000000" };
    let output = run(&["pair", &address, "--keys", &keys, "--code", wrong]);
    assert!(!output.status.success() && text_of(&output).contains("wrong code, 2 of 3 tries left"));
    let output = run(&["pair", &address, "--keys", &keys, "--code", &code, "--name", "jetson-3"]);
    assert!(output.status.success(), "{}", text_of(&output));
    assert!(
        text_of(&output).contains("'jetson-3', may fly and watch 'vizflyt'"),
        "{}",
        text_of(&output)
    );
    let text = fly(&[]);
    assert!(!text.contains("paired") && text.contains("autopilot"), "{text}");

    // The identity is the same after a restart.
    drop(server);
    let mut again = Server::start(&folder.path().join("scene/arena.toml"), Path::new(&server_keys));
    let ready_again = again.line("ready");
    assert_eq!(
        (&ready_again["fingerprint"], &ready_again["paired"]),
        (&ready["fingerprint"], &1.into())
    );
}
