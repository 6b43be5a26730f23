//! Whether the autopilot streams what it was asked for, as often as it was asked.

use vizflyt_protocol::time::HostTime;

use super::dialect::Interval;

/// A stream and how often it comes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rate {
    /// Message id.
    pub id: u32,
    /// Asked for. [Hz]
    pub asked_hz: f64,
    /// Came, over the last window; 0 before the first. [Hz]
    pub achieved_hz: f64,
}

/// What is to be done about a stream that comes too seldom.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Verdict {
    /// Ask again.
    Ask(Interval),
    /// Asking again did not help.
    Slow(Rate),
}

/// Counts over this long. [s]
const WINDOW_S: f64 = 2.0;
/// Share of the rate that will do: schedulers round intervals to their ticks.
const ENOUGH: f64 = 0.8;
/// Asked again this often before it is told.
const AGAIN: u8 = 2;

#[derive(Clone, Copy, Debug)]
struct Row {
    rate: Rate,
    interval_us: f32,
    count: u32,
    asked_again: u8,
    told: bool,
}

/// The streams asked for.
#[derive(Clone, Debug, Default)]
pub(super) struct Rates {
    rows: Vec<Row>,
    since: HostTime,
}

impl Rates {
    /// Watches a stream that the autopilot has agreed to.
    pub(super) fn watch(&mut self, now: HostTime, (id, interval_us): Interval) {
        self.since = now;
        for row in &mut self.rows {
            row.count = 0;
        }
        if self.rows.iter().any(|row| row.rate.id == id) {
            return;
        }
        let rate = Rate { id, asked_hz: 1e6 / f64::from(interval_us), achieved_hz: 0.0 };
        self.rows.push(Row { rate, interval_us, count: 0, asked_again: 0, told: false });
    }

    /// Counts a message.
    pub(super) fn heard(&mut self, id: u32) {
        if let Some(row) = self.rows.iter_mut().find(|row| row.rate.id == id) {
            row.count = row.count.saturating_add(1);
        }
    }

    /// Returns the streams as they came.
    pub(super) fn rates(&self) -> impl Iterator<Item = Rate> + '_ {
        self.rows.iter().map(|row| row.rate)
    }

    /// Judges once a window is over; hands what is to be done to `act`.
    pub(super) fn check(&mut self, now: HostTime, mut act: impl FnMut(Verdict)) {
        let window_s = now.seconds_since(self.since);
        if window_s < WINDOW_S {
            return;
        }
        self.since = now;
        for row in &mut self.rows {
            row.rate.achieved_hz = f64::from(row.count) / window_s;
            row.count = 0;
            if row.rate.achieved_hz >= ENOUGH * row.rate.asked_hz {
                (row.asked_again, row.told) = (0, false);
            } else if row.asked_again < AGAIN {
                row.asked_again += 1;
                act(Verdict::Ask((row.rate.id, row.interval_us)));
            } else if !row.told {
                row.told = true;
                act(Verdict::Slow(row.rate));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_stream_is_asked_for_twice_then_told_once() {
        let mut now = HostTime::from_ns(1_000_000_000);
        let mut rates = Rates::default();
        rates.watch(now, (30, 20_000.0));
        rates.watch(now, (32, 20_000.0));
        let mut told = Vec::new();
        for window in 0..6 {
            for tick in 0..100 {
                now = now.plus_seconds(0.02);
                rates.heard(30);
                // 32 comes at 10 Hz, and recovers in the end.
                if tick % 5 == 0 || window == 5 {
                    rates.heard(32);
                }
                rates.check(now, |verdict| told.push(verdict));
            }
        }
        let slow = |verdict: &Verdict| matches!(verdict, Verdict::Slow(rate) if rate.id == 32);
        assert_eq!(told.len(), 3, "{told:?}");
        assert_eq!(told[..2], [Verdict::Ask((32, 20_000.0)); 2]);
        assert!(slow(&told[2]));
        for rate in rates.rates() {
            assert!((rate.achieved_hz - 50.0).abs() < 1.5, "{rate:?}");
        }
    }
}
