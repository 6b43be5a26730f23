//! Durations of stages, and rates.
//!
//! Stages have the names of the tracing spans: `pose render encode send`. Each thread adds to its own
//! [`StageDurations`]; the page reads the recent samples, the report the complete run. The durations count only
//! the server's work; the runtime reports the contribution of each stage to an image's age
//! ([`vizflyt_protocol::messages::Timing`]).

use std::sync::Mutex;

use vizflyt_protocol::histogram::Histogram;
use vizflyt_protocol::messages::StageTimes;
use vizflyt_protocol::time::ServerTime;

use vizflyt_process::lock;

/// Durations of one stage.
#[derive(Debug)]
pub struct StageDurations(Mutex<Samples>);

#[derive(Debug)]
struct Samples {
    recent: [f32; RECENT],
    next: usize,
    /// Samples of the whole run.
    overall: Box<Histogram>,
}

impl Default for StageDurations {
    fn default() -> Self {
        Self(Mutex::new(Samples { recent: [0.0; RECENT], next: 0, overall: Box::default() }))
    }
}

impl StageDurations {
    /// Adds a duration. [ms]
    pub fn add_ms(&self, ms: f64) {
        let mut samples = lock(&self.0);
        let next = samples.next;
        samples.recent[next] = ms as f32;
        samples.next = (next + 1) % RECENT;
        samples.overall.add(ms);
    }

    /// Adds the time from `start` to `end`.
    pub fn add(&self, start: ServerTime, end: ServerTime) {
        self.add_ms(end.seconds_since(start) * 1e3);
    }

    /// Returns percentiles of the newest samples, a few seconds' worth.
    pub fn recent(&self) -> StageTimes {
        let (mut values, count) = {
            let samples = lock(&self.0);
            (samples.recent, samples.overall.count().min(RECENT as u64) as usize)
        };
        let values = &mut values[..count];
        values.sort_unstable_by(f32::total_cmp);
        let at = |share: f64| {
            let index = (share * (count as f64 - 1.0)).round().max(0.0) as usize;
            values.get(index).copied().unwrap_or(0.0)
        };
        StageTimes { p50: at(0.5), p90: at(0.9), p99: at(0.99), max: at(1.0) }
    }

    /// Returns percentiles of the whole run, to within 1.6 %.
    pub fn overall(&self) -> StageTimes {
        lock(&self.0).overall.times()
    }
}

/// Measures the rate of a counter.
#[derive(Debug, Default)]
pub struct RateMeter(Mutex<Option<(ServerTime, u64, f64)>>);

impl RateMeter {
    /// Returns the rate of a counter with the value `total` at `now`, updated twice a second. [1/s]
    pub fn of(&self, total: u64, now: ServerTime) -> f64 {
        let mut state = lock(&self.0);
        let (since, then, rate) = *state.get_or_insert((now, total, 0.0));
        let seconds = now.seconds_since(since);
        if !(seconds >= 0.5) {
            return rate;
        }
        let rate = total.saturating_sub(then) as f64 / seconds;
        *state = Some((now, total, rate));
        rate
    }
}

/// Number of samples for the page: 4 s at 60 Hz.
const RECENT: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_those_of_the_samples() {
        let durations = StageDurations::default();
        assert_eq!(durations.recent(), StageTimes::default());
        assert_eq!(durations.overall(), StageTimes::default());
        for value in 1..=200 {
            durations.add_ms(f64::from(value));
        }
        let recent = durations.recent();
        assert!((recent.p50 - 100.0).abs() <= 1.0 && (recent.p99 - 198.0).abs() <= 1.0);
        assert_eq!(recent.max, 200.0);
        let overall = durations.overall();
        assert!((overall.p50 / 100.0 - 1.0).abs() < 0.03, "{overall:?}");
        assert!((overall.p99 / 198.0 - 1.0).abs() < 0.03, "{overall:?}");
        // Extremes are in the end buckets.
        durations.add_ms(-1.0);
        durations.add_ms(f64::NAN);
        durations.add_ms(1e12);
    }

    #[test]
    fn a_rate_is_counted_over_half_a_second() {
        let rate = RateMeter::default();
        let at = |ms: u64| ServerTime::from_ns(ms * 1_000_000);
        assert_eq!(rate.of(100, at(0)), 0.0);
        assert_eq!(rate.of(120, at(400)), 0.0);
        assert_eq!(rate.of(160, at(1000)), 60.0);
        assert_eq!(rate.of(161, at(1010)), 60.0);
    }
}
