//! Flight logs of the real program: the example plugin gives the same replies in a replay as in flight.

use std::path::Path;
use std::time::Duration;

use serde_json::Value;
use vizflyt_e2e::{Demo, run};

fn replay(log: &str, answers: &Path, more: &[&str]) -> Value {
    let report = answers.with_extension("report.json");
    let (answers, report_path) = (answers.to_str().unwrap(), report.to_str().unwrap());
    let mut arguments = vec!["replay", log, "--answers", answers, "--report", report_path];
    arguments.extend(more);
    let done = run(&arguments);
    assert!(done.status.success(), "{done:?}");
    let text = std::fs::read_to_string(report).unwrap();
    serde_json::from_str::<Value>(&text).unwrap()["found"].clone()
}

#[test]
fn replays_a_flight_bit_by_bit() {
    let folder = tempfile::tempdir().unwrap();
    let flights = folder.path().join("flights");
    let folder_of_logs = flights.to_str().unwrap();
    let mut demo = Demo::start(&[
        "--seed",
        "7",
        "--seconds",
        "6",
        "--log",
        "full",
        "--log-dir",
        folder_of_logs,
    ]);
    demo.wait(Duration::from_mins(4));
    let log = std::fs::read_dir(&flights).unwrap().next().unwrap().unwrap().path();
    let log = log.to_str().unwrap();

    let (one, two) = (folder.path().join("one.jsonl"), folder.path().join("two.jsonl"));
    let found = replay(log, &one, &[]);
    let count = |key: &str| found[key].as_u64().unwrap();
    assert_eq!(count("images_left_out"), 0, "{found:#}");
    assert!(count("compared") > 50 && found["plugin_failed"].is_null(), "{found:#}");
    // If the log lacks images, a plugin with memory may reply differently.
    assert!(count("differ") == 0 || count("images_missing") > 0, "{found:#}");
    replay(log, &two, &[]);
    assert_eq!(std::fs::read(&one).unwrap(), std::fs::read(&two).unwrap(), "byte by byte");

    let stats = run(&["stats", log]);
    assert!(stats.status.success(), "{stats:?}");
    let stranger = run(&["replay", log, "--plugin", "./no/such/plugin"]);
    let why = String::from_utf8_lossy(&stranger.stderr).into_owned();
    assert!(!stranger.status.success() && why.contains("no plugin at"), "{why}");
}
