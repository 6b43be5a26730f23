//! What a student breaks never reaches the vehicle: each misdeed is flown in the simulated lab, and
//! the vehicle watched from outside, by the motion capture's own packets. It holds or lands within
//! the time that `docs/guides/safety.md` states, and the student reads one clear sentence.
//!
//! The plugin is `jetson/runtime/examples/misbehave.rs`; Python's own misdeeds are in `tests/python`.
//! Flights are flown several at a time, as short as they can be.

#[path = "../flights/lab.rs"]
mod lab;

use std::time::Instant;

use lab::{Lab, Plan, Seen};

/// A misdeed, and what is to come of it.
struct Case {
    how: &'static str,
    /// Settings of `[plugin]`.
    settings: &'static str,
    /// The vehicle stands, or comes straight down, at most so long after the misdeed. [s]
    holds_within_s: f64,
    /// It is on its way down at most so long after; `None` if it only holds. [s]
    lands_within_s: Option<f64>,
    outcome: &'static str,
    /// The sentence that the student reads.
    sentence: &'static str,
}

/// The plugin is gone: the runtime brakes and lands without being asked.
const AT_ONCE_S: (f64, Option<f64>) = (1.0, Some(1.5));
/// It sends nothing: half a second, braking; two seconds, landing.
const SILENT_S: (f64, Option<f64>) = (1.0, Some(2.0));
/// Why: the times are the vehicle's, but this machine may be short of processors, and lines and
/// packets late at this test.
const SLACK_S: f64 = 2.0;

const fn case(
    how: &'static str,
    settings: &'static str,
    (holds_within_s, lands_within_s): (f64, Option<f64>),
    sentence: &'static str,
) -> Case {
    Case { how, settings, holds_within_s, lands_within_s, outcome: "plugin_failed", sentence }
}

const CASES: [Case; 14] = [
    case("late-panic", "", AT_ONCE_S, "the plugin failed: panicked at"),
    case("late-spin", "", SILENT_S, "the plugin has not answered image"),
    case("late-sleep", "", SILENT_S, "the plugin has not answered image"),
    // As long as it takes to fill the memory, it flies.
    case("late-leak", "memory_mb = 200", (3.0, Some(3.5)), "more than its 200 MB of memory"),
    case("late-fork", "processes = 40", AT_ONCE_S, "more than its 40 processes and threads"),
    case("late-exit", "", AT_ONCE_S, "the plugin ended by itself (exit status 0)"),
    case("late-segfault", "", AT_ONCE_S, "SIGSEGV: it touched memory that is not its own"),
    case("late-nan", "", SILENT_S, "a number in it is not finite"),
    case("late-infinite", "", SILENT_S, "a number in it is not finite"),
    Case {
        outcome: "landed",
        // From its place to the fence at 3 m/s at most, braking.
        ..case("late-outside", "", (4.0, None), "asks to leave the geofence; the vehicle stops")
    },
    case("late-flood", "", AT_ONCE_S, "more than 400 setpoints a second"),
    case("late-types", "", AT_ONCE_S, "what it sends is no setpoint"),
    case("late-print", "", SILENT_S, "more lines in that second were dropped"),
    Case {
        outcome: "landed",
        ..case(
            "late-segfault,late-panic,late-land",
            "restart = \"in_flight\"",
            (1.0, None),
            "SIGSEGV: it touched memory that is not its own; the plugin is started again",
        )
    },
];

/// Vehicles that fly at a time.
const TOGETHER: usize = 5;

#[test]
fn vehicle_holds_or_lands_for_any_plugin_fault() {
    let mut lab = Lab::open(TOGETHER);
    let mut complaints = Vec::new();
    for batch in CASES.chunks(TOGETHER) {
        let start = |(index, case): (usize, &Case)| {
            let more: &[&str] = if case.flies_on() { &["--seconds=7"] } else { &[] };
            lab.fly(index, Plan { how: case.how, settings: case.settings, more, ..Plan::default() })
        };
        let flights: Vec<_> = batch.iter().enumerate().map(start).collect();
        for (case, flight) in batch.iter().zip(flights) {
            let seen = flight.wait();
            complaints.extend(case.complaint(&seen));
        }
    }
    assert!(lab.lives());
    assert!(complaints.is_empty(), "{complaints:#?}");
}

impl Case {
    /// Whether the flight ends only by its time: what the plugin does is no reason to land.
    fn flies_on(&self) -> bool {
        self.how == "late-outside"
    }

    /// Returns what was not as stated.
    fn complaint(&self, seen: &Seen) -> Option<String> {
        let complain = |what: String| {
            let lines: Vec<_> = seen.lines.iter().map(|(_, line)| line.to_string()).collect();
            let last = lines.len().saturating_sub(25);
            Some(format!("{}: {what}\n{}", self.how, lines[last..].join("\n")))
        };
        let Some(deed) = seen.when("now: ") else {
            return complain("it was not done".to_owned());
        };
        let after = |at: Instant| at.saturating_duration_since(deed).as_secs_f64();
        let stopped_s = seen.stopped_after(deed).map_or(f64::NAN, |after| after.as_secs_f64());
        let landing_s = seen.when("\"phase\":\"landing\"").map_or(f64::NAN, after);
        let (z_m, v_mps) = seen.end();
        println!(
            "{:36} stands after {stopped_s:.2} s, lands after {landing_s:.2} s; {}: {}",
            self.how, seen.report["outcome"], seen.report["reason"]
        );
        if !(stopped_s <= self.holds_within_s + SLACK_S) {
            return complain(format!("it stood still after {stopped_s} s"));
        }
        if let Some(within_s) = self.lands_within_s
            && !(landing_s <= within_s + SLACK_S)
        {
            return complain(format!("it landed after {landing_s} s"));
        }
        // On the floor, where it stood at first, and still.
        if !(z_m < 0.3 && v_mps < 0.2) {
            return complain(format!("it ended {z_m} m high, at {v_mps} m/s"));
        }
        if seen.report["outcome"] != self.outcome {
            return complain(format!("it ended as {}", seen.report["outcome"]));
        }
        // One sentence, not a hundred.
        let count = seen.count(self.sentence);
        if !(1..=12).contains(&count) {
            return complain(format!("'{}' was reported {count} times", self.sentence));
        }
        self.particular(seen).and_then(complain)
    }

    /// What only one of them has.
    fn particular(&self, seen: &Seen) -> Option<String> {
        let restarts = seen.report["plugin_restarts"].as_u64();
        if self.settings.contains("restart") && restarts != Some(2) {
            return Some(format!("it was started again {restarts:?} times"));
        }
        let furthest = seen.track.iter().map(|sight| sight.p_m.x).fold(0.0, f64::max);
        if !(furthest < 2.6) {
            return Some(format!("it was at x = {furthest} m, outside the fence"));
        }
        // Lines carry the tick at which they were read.
        let lines = seen.lines.iter().filter(|(_, line)| line["plugin"].is_object());
        let stamped = lines.clone().filter(|(_, line)| line["plugin"]["tick"].is_u64()).count();
        (stamped == 0 || stamped != lines.count()).then(|| "a line has no tick".to_owned())
    }
}
