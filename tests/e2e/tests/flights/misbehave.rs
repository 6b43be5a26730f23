//! Plugin faults with real processes in real time: a plugin that hangs, one that leaks, and one that crashes and is
//! restarted. The vehicle lands, and the student reads one clear message. The vehicle is observed from outside, by the
//! motion capture's packets. Time limits for these and all other faults are tested by `failsafe` on a virtual clock;
//! confinement and end of a process, by the runtime's `supervisor/tests.rs`.
//!
//! The plugin is `jetson/runtime/examples/misbehave.rs`; faults of Python plugins are in `tests/python`.

use std::time::Instant;

use crate::lab::{Lab, Plan, Seen};

/// A plugin fault and the expected result.
struct Case {
    how: &'static str,
    /// Settings of `[plugin]`.
    settings: &'static str,
    outcome: &'static str,
    /// Message for the student.
    sentence: &'static str,
}

const fn case(how: &'static str, settings: &'static str, sentence: &'static str) -> Case {
    Case { how, settings, outcome: "plugin_failed", sentence }
}

const CASES: [Case; 3] = [
    case("late-spin", "", "the plugin has not answered image"),
    case("late-leak", "memory_mb = 200", "more than its 200 MB of memory"),
    Case {
        outcome: "landed",
        ..case(
            "late-segfault,late-panic,late-land",
            "restart = \"in_flight\"",
            "SIGSEGV: it touched memory that is not its own; the plugin is started again",
        )
    },
];

/// Number of simultaneous flights.
const TOGETHER: usize = 3;

#[test]
fn vehicle_holds_or_lands_for_any_plugin_fault() {
    let mut lab = Lab::open(TOGETHER);
    let mut complaints = Vec::new();
    for batch in CASES.chunks(TOGETHER) {
        let start = |(index, case): (usize, &Case)| {
            lab.fly(index, Plan { how: case.how, settings: case.settings, ..Plan::default() })
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
    /// Returns the violated requirement, if any.
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
        // The vehicle must stand on the floor.
        if !(z_m < 0.3 && v_mps < 0.2) {
            return complain(format!("it ended {z_m} m high, at {v_mps} m/s"));
        }
        if seen.report["outcome"] != self.outcome {
            return complain(format!("it ended as {}", seen.report["outcome"]));
        }
        // A few messages, not a hundred.
        let count = seen.count(self.sentence);
        if !(1..=12).contains(&count) {
            return complain(format!("'{}' was reported {count} times", self.sentence));
        }
        self.particular(seen).and_then(complain)
    }

    /// Checks the requirements of single cases.
    fn particular(&self, seen: &Seen) -> Option<String> {
        let restarts = seen.report["plugin_restarts"].as_u64();
        if self.settings.contains("restart") && restarts != Some(2) {
            return Some(format!("it was started again {restarts:?} times"));
        }
        let furthest = seen.track.iter().map(|sight| sight.p_m.x).fold(0.0, f64::max);
        if !(furthest < 2.6) {
            return Some(format!("it was at x = {furthest} m, outside the fence"));
        }
        // Lines must contain the tick at which they were read.
        let lines = seen.lines.iter().filter(|(_, line)| line["plugin"].is_object());
        let stamped = lines.clone().filter(|(_, line)| line["plugin"]["tick"].is_u64()).count();
        (stamped == 0 || stamped != lines.count()).then(|| "a line has no tick".to_owned())
    }
}
