//! Trial of the stop button: delay until the runtime's receipt, its landing, and disarmed motors. Pure.

use vizflyt_protocol::messages::FlightPhase;
use vizflyt_protocol::time::ServerTime;

use super::checks::Finding;

/// Trial of one press of the stop button.
#[derive(Clone, Copy, Debug)]
pub struct StopTrial {
    /// Number of the stop event.
    seq: u64,
    pressed: ServerTime,
    received_ms: Option<f64>,
    obeyed_ms: Option<f64>,
    stands_ms: Option<f64>,
}

/// State of the vehicle at one time.
#[derive(Clone, Copy, Debug)]
pub struct Seen {
    /// Number of the last event that the runtime has received.
    pub received: u64,
    /// Phase of its newest report.
    pub phase: FlightPhase,
    /// Whether the motors are armed, from its newest report.
    pub armed: bool,
}

impl StopTrial {
    /// Starts a trial at the press, event number `seq`.
    pub fn new(seq: u64, pressed: ServerTime) -> Self {
        Self { seq, pressed, received_ms: None, obeyed_ms: None, stands_ms: None }
    }

    /// Processes the vehicle's state at `now`.
    pub fn handle(&mut self, now: ServerTime, seen: Seen) {
        let since_ms = now.seconds_since(self.pressed) * 1e3;
        if seen.received >= self.seq {
            self.received_ms.get_or_insert(since_ms);
        }
        // A report from before the receipt does not show that the order was obeyed.
        if self.received_ms.is_some()
            && matches!(seen.phase, FlightPhase::Landing | FlightPhase::Landed)
        {
            self.obeyed_ms.get_or_insert(since_ms);
            if !seen.armed {
                self.stands_ms.get_or_insert(since_ms);
            }
        }
    }

    /// Returns the result when it is final.
    pub fn result(&self, now: ServerTime) -> Option<Finding> {
        let waited_s = now.seconds_since(self.pressed);
        if self.stands_ms.is_none() && waited_s < PATIENCE_S {
            return None;
        }
        let told = |what: &str, ms: Option<f64>| match ms {
            Some(ms) => format!("{what} after {ms:.0} ms"),
            None => format!("not {what} within {waited_s:.0} s"),
        };
        let evidence = [
            told("received by the runtime", self.received_ms),
            told("landing reported", self.obeyed_ms),
            told("disarmed", self.stands_ms),
        ];
        let mut todo = Vec::new();
        let is_late = |ms: Option<f64>| ms.is_none_or(|ms| ms > MAX_MS);
        if is_late(self.received_ms) || is_late(self.obeyed_ms) {
            todo.push(format!(
                "STOP must be received and obeyed within {MAX_MS:.0} ms: do not fly; look at the network, then try \
                 again (docs/guides/failsafe.md)"
            ));
        } else if self.stands_ms.is_none() {
            todo.push(
                "it stays armed: do not fly; look at the autopilot's messages, then try again"
                    .to_owned(),
            );
        }
        Some(Finding::of(evidence.join(", "), &todo))
    }
}

/// Maximum delay of the order to the runtime, and of its report, which is sent ten times a second. [ms]
const MAX_MS: f64 = 500.0;
/// Time limit for the landing from a net's height. [s]
const PATIENCE_S: f64 = 15.0;

#[cfg(test)]
mod tests {
    use super::*;

    fn run(seen: &[(f64, u64, FlightPhase, bool)]) -> Option<Finding> {
        let start = ServerTime::from_ns(1_000_000_000);
        let mut trial = StopTrial::new(7, start);
        let mut now = start;
        for &(at_s, received, phase, armed) in seen {
            now = start.plus_seconds(at_s);
            trial.handle(now, Seen { received, phase, armed });
            if let Some(result) = trial.result(now) {
                return Some(result);
            }
        }
        trial.result(now)
    }

    #[test]
    fn measures_a_stop_on_the_ground() {
        use FlightPhase::{Landed, Waiting};
        let found =
            run(&[(0.01, 6, Waiting, false), (0.02, 7, Waiting, false), (0.12, 7, Landed, false)])
                .unwrap();
        assert!(found.ok, "{found:?}");
        assert_eq!(
            found.evidence,
            "received by the runtime after 20 ms, landing reported after 120 ms, disarmed after 120 ms"
        );
    }

    #[test]
    fn a_stop_in_flight_waits_until_disarmed() {
        use FlightPhase::{Flying, Landed, Landing};
        let seen = [
            (0.02, 7, Flying, true),
            (0.1, 7, Landing, true),
            (3.0, 7, Landing, true),
            (4.0, 7, Landed, false),
        ];
        assert_eq!(run(&seen[..3]), None);
        let found = run(&seen).unwrap();
        assert!(found.ok && found.evidence.ends_with("disarmed after 4000 ms"), "{found:?}");
    }

    #[test]
    fn an_unreceived_or_ignored_stop_fails() {
        use FlightPhase::{Flying, Landed, Landing};
        for seen in [
            &[(1.0, 6, Flying, true), (15.0, 6, Flying, true)][..],
            &[(0.7, 7, Flying, true), (0.8, 7, Landed, false)],
            &[(0.1, 7, Landing, true), (15.0, 7, Landing, true)],
            // A landing from before does not count.
            &[(0.1, 6, Landed, false), (15.0, 6, Landed, false)],
        ] {
            let found = run(seen).unwrap();
            assert!(!found.ok && found.todo.contains("do not fly"), "{found:?}");
        }
    }
}
