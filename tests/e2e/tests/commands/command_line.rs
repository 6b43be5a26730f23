//! Output of the command line for correct and wrong use.

use std::process::{Command, Stdio};

use vizflyt_e2e::{check_refused, run, vizflyt};

#[test]
fn every_command_has_help() {
    for command in [
        "demo",
        "new",
        "serve",
        "fly",
        "pair",
        "password",
        "doctor",
        "vehicle",
        "sim",
        "scene",
        "tags",
        "bench",
        "grade",
        "lab",
        "leaderboard",
        "arena",
        "evaluate",
    ] {
        let output = run(&[command, "--help"]);
        assert!(output.status.success(), "{command}");
        assert!(output.stdout.len() > 200, "{command} --help is a stub");
    }
    let help = String::from_utf8(run(&["--help"]).stdout).unwrap();
    assert!(help.contains("vizflyt demo"));
}

#[test]
fn same_seed_generates_the_same_scene() {
    let folder = tempfile::tempdir().unwrap();
    let make = |name: &str, seed: &str| {
        let path = folder.path().join(name);
        let text = path.to_str().unwrap();
        assert!(run(&["scene", "generate", "race", "--seed", seed, "-o", text]).status.success());
        ["scene.ply", "arena.toml", "truth.json"].map(|f| std::fs::read(path.join(f)).unwrap())
    };
    let first = make("a", "5");
    assert!(first == make("b", "5"), "two generations with one seed differ");
    assert!(first[0] != make("c", "6")[0], "another seed makes the same scene");
    // Existing files are not overwritten without `--force`.
    let again = folder.path().join("a");
    check_refused(
        &["scene", "generate", "race", "-o", again.to_str().unwrap()],
        &["already holds", "--force"],
    );
}

#[test]
fn errors_of_evaluate_name_the_cause() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let truth = write("truth.tum", "0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n2 2 0 0 0 0 0 1\n");
    let later = write("later.tum", "100 0 0 0 0 0 0 1\n");
    check_refused(&["evaluate", &truth, &later], &["within 0.01 s", "same clock"]);
    let short = write("short.tum", "0 0 0 0\n");
    check_refused(&["evaluate", &truth, &short], &["line 1", "4 numbers"]);
    check_refused(&["evaluate", &truth, &truth, "--align", "se3"], &["cannot be aligned", "line"]);
    check_refused(&["evaluate", &truth, &truth, "--delta", "3"], &["1m"]);
    let output = run(&["evaluate", &truth, &truth, "--json"]);
    let figures: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&figures["pairs"], &figures["ate_rmse_m"]), (&3.into(), &0.0.into()));
}

#[test]
fn errors_name_the_cause() {
    check_refused(
        &["demo", "--scene", "forrest"],
        &["forrest", "neither a generated scene (forest, race"],
    );
    check_refused(&["scene", "generate", "swamp", "-o", "x"], &["swamp", "forest"]);
    check_refused(&["serve", "/nowhere/arena.toml"], &["/nowhere/arena.toml"]);
    check_refused(&["--log-level", "loud=x=y", "demo"], &["--log-level"]);
    let folder = tempfile::tempdir().unwrap();
    let arena = folder.path().join("arena.toml");
    std::fs::write(&arena, "name = \"x\"\nscene = 5\n").unwrap();
    let output = run(&["serve", arena.to_str().unwrap()]);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(message.contains("line 2, column 9: scene: invalid type"), "{message}");
    assert_eq!(message.matches("invalid type").count(), 1, "once: {message}");
    std::fs::write(&arena, "name = \"x\"\nscen = \"a\"\nbody_radius_m = \"1\"\n").unwrap();
    check_refused(
        &["serve", arena.to_str().unwrap()],
        &["line 2, column 1: unknown key 'scen'; did you mean 'scene'?", "line 3", "body_radius_m"],
    );
    let scene = folder.path().join("room.ply");
    std::fs::write(&scene, [0xff; 64]).unwrap();
    check_refused(&["arena", "check", scene.to_str().unwrap()], &["room.ply is not an arena.toml"]);
}

#[test]
fn errors_name_their_cause_once() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a-file");
    std::fs::write(&file, "").unwrap();
    // Nothing can be created below a file, not even by root.
    let below = file.join("below");
    let (file, below) = (file.to_str().unwrap(), below.to_str().unwrap());
    let (into, made) = (format!("{below}.ply"), folder.path().join("scene"));
    let scene = made.join("scene.ply");
    let made = ["scene", "generate", "race", "-o", made.to_str().unwrap()];
    assert!(run(&made).status.success());
    let missing = "No such file or directory (os error 2)";
    let no_folder = "Not a directory (os error 20)";
    let board = format!("{below}/board.sqlite");
    let cases: [(&[&str], &str); 10] = [
        (&["scene", "convert", "/nope.ply", &into], missing),
        (&["scene", "convert", "/nope.spz", &into], missing),
        (&["scene", "convert", scene.to_str().unwrap(), &into], no_folder),
        (&["scene", "generate", "race", "-o", below], no_folder),
        (&["arena", "check", "/nope/arena.toml"], missing),
        (&["password", "--keys", below], no_folder),
        (&["pair", "127.0.0.1:9", "--keys", below], no_folder),
        (&["leaderboard", "--database", &board], no_folder),
        (&["tags", "locate", "/nope/locate.toml"], missing),
        (&["fly", "--config", "/nope/jetson.toml", file], missing),
    ];
    for (args, cause) in cases {
        let output = run(args);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success(), "{args:?} succeeded");
        assert_eq!(message.matches(cause).count(), 1, "{args:?}: {message}");
    }
}

#[test]
fn does_not_panic_if_the_reader_closes_the_pipe() {
    // Like `head -1`, but for both streams.
    for args in [["leaderboard", "--help"], ["arena", "check"], ["bench", "render"]] {
        let arena = ["--project=p5", "--seeds=3"];
        let more: &[&str] = if args == ["arena", "check"] { &arena } else { &[] };
        let mut child = Command::new(vizflyt())
            .args(args)
            .args(more)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        // Close the pipe before anything is written.
        drop(child.stdout.take());
        let output = child.wait_with_output().unwrap();
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!message.contains("panicked"), "{args:?}: {message}");
        assert_ne!(output.status.code(), Some(101), "{args:?}: a panic");
        assert!(!message.contains("Broken pipe"), "{args:?}: {message}");
    }
}

#[test]
fn writes_no_colours_to_files_and_pipes() {
    let folder = tempfile::tempdir().unwrap();
    let arena = folder.path().join("forest");
    let text = arena.to_str().unwrap();
    assert!(run(&["scene", "generate", "forest", "--seed", "1", "-o", text]).status.success());
    let output = run(&["--log-level=debug", "arena", "check", text]);
    assert!(output.status.success());
    assert!(!output.stderr.is_empty(), "it logs how the scene is loaded");
    assert!(!output.stderr.contains(&0x1b), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn demo_names_its_own_option_for_a_port_in_use() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = format!("--port={}", taken.local_addr().unwrap().port());
    check_refused(&["demo", "--headless", &port], &["give another --port"]);
}
