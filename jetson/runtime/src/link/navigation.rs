//! External navigation: rate limit of the poses sent to the autopilot, and their latency. ArduCopter relates the clock
//! of the stamps to its own by the fastest packet. It cannot measure the minimum latency, which must therefore be set:
//! VISO_DELAY_MS.

use vizflyt_protocol::time::HostTime;

/// Allowed rates, tested with ArduCopter; its filter accepts at most 50 a second. [Hz]
pub const VISION_HZ: std::ops::RangeInclusive<f64> = 30.0..=50.0;

/// Poses older than this are not sent. [s]
const STALE_S: f64 = 0.5;
/// Number of poses for the latency measurement: 5 s.
const WINDOW: usize = 250;
/// Share of the period by which a pose may be early, because the rate of poses differs from ours.
const SLACK: f64 = 0.1;
/// Allowed difference between setting and measurement. [ms]
const CLOSE_MS: f64 = 10.0;

/// Rate limit and latency measurement.
#[derive(Clone, Debug)]
pub(super) struct Feed {
    period_s: f64,
    due_at: Option<HostTime>,
    /// Ages of the newest poses at transmission. [s]
    ages_s: Vec<f64>,
    next: usize,
    stale: u64,
}

/// Latency of external navigation: measured, and set in the autopilot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Delay {
    /// Parameter of the autopilot.
    pub parameter: &'static str,
    /// Minimum time from the measurement to the autopilot. [ms]
    pub measured_ms: f64,
    /// Value of the parameter; `None` if unknown. [ms]
    pub set_ms: Option<f64>,
}

impl Delay {
    /// Whether the setting is close enough to the measurement.
    pub fn is_close(&self) -> bool {
        self.set_ms.is_none_or(|set_ms| (set_ms - self.measured_ms).abs() <= CLOSE_MS)
    }
}

impl Feed {
    /// Creates a feed with `hz` poses a second, clamped to [`VISION_HZ`].
    pub(super) fn new(hz: f64) -> Self {
        let hz = hz.max(*VISION_HZ.start()).min(*VISION_HZ.end());
        Self { period_s: 1.0 / hz, due_at: None, ages_s: Vec::new(), next: 0, stale: 0 }
    }

    /// Whether a pose measured at `stamp` must be sent now.
    pub(super) fn take(&mut self, now: HostTime, stamp: HostTime) -> bool {
        let age_s = now.seconds_since(stamp);
        if !(age_s < STALE_S) {
            self.stale += 1;
            return false;
        }
        let early_s = SLACK * self.period_s;
        let due_at = self.due_at.unwrap_or(now);
        if now.plus_seconds(early_s) < due_at {
            return false;
        }
        // Keep a fixed grid, unless it has fallen behind.
        let next = due_at.plus_seconds(self.period_s);
        let behind = next.seconds_since(now) < early_s;
        self.due_at = Some(if behind { now.plus_seconds(self.period_s) } else { next });
        if self.ages_s.len() < WINDOW {
            self.ages_s.push(age_s);
        } else {
            self.ages_s[self.next] = age_s;
            self.next = (self.next + 1) % WINDOW;
        }
        true
    }

    /// Returns the number of poses that were too old to send.
    pub(super) fn stale(&self) -> u64 {
        self.stale
    }

    /// Returns the minimum latency from measurement to autopilot, including `link_s` on the link, once the window is
    /// full. [ms]
    pub(super) fn delay_ms(&self, link_s: f64) -> Option<f64> {
        if self.ages_s.len() < WINDOW {
            return None;
        }
        let least_s = self.ages_s.iter().copied().fold(f64::INFINITY, f64::min);
        Some((least_s.max(0.0) + link_s.max(0.0)) * 1e3)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sent(hz_in: f64, hz_out: f64) -> usize {
        let mut feed = Feed::new(hz_out);
        let start = HostTime::from_ns(1_000_000_000);
        let at = |i: usize| start.plus_seconds(i as f64 / hz_in);
        (0..(10.0 * hz_in) as usize).filter(|&i| feed.take(at(i), at(i))).count()
    }

    #[test]
    fn output_rate_is_kept_for_any_input_rate() {
        for hz_in in [100.0, 120.0, 200.0, 240.0] {
            for hz_out in [30.0, 40.0, 50.0] {
                let n = sent(hz_in, hz_out) as f64 / 10.0;
                assert!(n <= hz_out + 0.2 && n > 0.85 * hz_out, "{hz_in} to {hz_out}: {n}");
            }
        }
        assert_eq!(sent(25.0, 50.0), 250, "slower input is sent completely");
        assert_eq!(sent(100.0, 50.0), 500);
    }

    #[test]
    fn measures_the_minimum_latency() {
        let mut feed = Feed::new(50.0);
        let mut now = HostTime::from_ns(1_000_000_000);
        for i in 0..400 {
            let age_s = 0.034 + f64::from(i % 7) * 0.003;
            assert!(feed.take(now, now.plus_seconds(-age_s)));
            now = now.plus_seconds(0.02);
        }
        let measured_ms = feed.delay_ms(0.002).unwrap();
        assert!((measured_ms - 36.0).abs() < 0.1, "{measured_ms}");
        let delay = |set_ms| Delay { parameter: "VISO_DELAY_MS", measured_ms, set_ms };
        assert!(delay(None).is_close() && delay(Some(40.0)).is_close());
        assert!(!delay(Some(10.0)).is_close());
        assert!(!feed.take(now, now.plus_seconds(-0.6)) && feed.stale() == 1, "too old");
    }
}
