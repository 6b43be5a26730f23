//! Checks that the autopilot streams messages at the requested rates.

use vizflyt_protocol::time::HostTime;

use super::dialect::Interval;

/// Stream and its rate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rate {
    /// Message id.
    pub id: u32,
    /// Requested rate. [Hz]
    pub asked_hz: f64,
    /// Received rate in the last window; 0 before the first. [Hz]
    pub achieved_hz: f64,
}

/// Action for a stream that is too slow.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum RateAction {
    /// Request it again.
    Request(Interval),
    /// The rate is still too low after the requests.
    Slow(Rate),
}

/// Duration of a counting window. [s]
const WINDOW_S: f64 = 2.0;
/// Sufficient share of the requested rate: schedulers round periods to their ticks.
const ENOUGH: f64 = 0.8;
/// Number of repeated requests before a report.
const REQUESTS: u8 = 2;

#[derive(Clone, Copy, Debug)]
struct Row {
    rate: Rate,
    interval_us: f32,
    count: u32,
    requests: u8,
    reported: bool,
}

/// Requested streams.
#[derive(Clone, Debug, Default)]
pub(super) struct Rates {
    rows: Vec<Row>,
    since: HostTime,
}

impl Rates {
    /// Monitors a stream that the autopilot has accepted.
    pub(super) fn watch(&mut self, now: HostTime, (id, interval_us): Interval) {
        self.since = now;
        for row in &mut self.rows {
            row.count = 0;
        }
        if self.rows.iter().any(|row| row.rate.id == id) {
            return;
        }
        let rate = Rate { id, asked_hz: 1e6 / f64::from(interval_us), achieved_hz: 0.0 };
        self.rows.push(Row { rate, interval_us, count: 0, requests: 0, reported: false });
    }

    /// Counts a message.
    pub(super) fn received(&mut self, id: u32) {
        if let Some(row) = self.rows.iter_mut().find(|row| row.rate.id == id) {
            row.count = row.count.saturating_add(1);
        }
    }

    /// Returns the streams with their rates.
    pub(super) fn rates(&self) -> impl Iterator<Item = Rate> + '_ {
        self.rows.iter().map(|row| row.rate)
    }

    /// Checks the rates at the end of a window; calls `act` for each necessary action.
    pub(super) fn check(&mut self, now: HostTime, mut act: impl FnMut(RateAction)) {
        let window_s = now.seconds_since(self.since);
        if window_s < WINDOW_S {
            return;
        }
        self.since = now;
        for row in &mut self.rows {
            row.rate.achieved_hz = f64::from(row.count) / window_s;
            row.count = 0;
            if row.rate.achieved_hz >= ENOUGH * row.rate.asked_hz {
                (row.requests, row.reported) = (0, false);
            } else if row.requests < REQUESTS {
                row.requests += 1;
                act(RateAction::Request((row.rate.id, row.interval_us)));
            } else if !row.reported {
                row.reported = true;
                act(RateAction::Slow(row.rate));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slow_stream_is_requested_twice_then_reported_once() {
        let mut now = HostTime::from_ns(1_000_000_000);
        let mut rates = Rates::default();
        rates.watch(now, (30, 20_000.0));
        rates.watch(now, (32, 20_000.0));
        let mut actions = Vec::new();
        for window in 0..6 {
            for tick in 0..100 {
                now = now.plus_seconds(0.02);
                rates.received(30);
                // 32 arrives at 10 Hz, and recovers in the last window.
                if tick % 5 == 0 || window == 5 {
                    rates.received(32);
                }
                rates.check(now, |action| actions.push(action));
            }
        }
        let slow = |action: &RateAction| matches!(action, RateAction::Slow(rate) if rate.id == 32);
        assert_eq!(actions.len(), 3, "{actions:?}");
        assert_eq!(actions[..2], [RateAction::Request((32, 20_000.0)); 2]);
        assert!(slow(&actions[2]));
        for rate in rates.rates() {
            assert!((rate.achieved_hz - 50.0).abs() < 1.5, "{rate:?}");
        }
    }
}
