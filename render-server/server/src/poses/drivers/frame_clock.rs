//! Stamps for frames with a counter but without a time. Sans-IO.
//!
//! Frames are measured at a constant rate, but arrive with a varying delay of the network and of this
//! computer's wake-up. Over a window, arrival = offset + period * frame + delay with delay >= 0. The period is
//! the slope of a line through the frames with the least delay. The offset is the least `arrival - period *
//! frame`, as in the minimum-delay filter of NTP. Only the constant delay remains in the stamp. Velocities from
//! finite differences need this: two packets read at the same instant would otherwise give an infinite speed.

use std::collections::VecDeque;

use vizflyt_protocol::time::ServerTime;

use super::slew::Slew;

/// Maps frame numbers to the server's clock.
#[derive(Debug, Default)]
pub struct FrameClock {
    /// (frame, arrival), oldest first, frames unwrapped relative to the first of the window.
    window: VecDeque<(u32, ServerTime)>,
    /// Time since which all frames have been late.
    late_since: Option<ServerTime>,
    last: Option<ServerTime>,
    slew: Slew,
    /// Slope of the last window that was long enough. [s]
    period_s: Option<f64>,
    /// Scratch memory for the slope.
    points: Vec<(f64, f64)>,
}

impl FrameClock {
    /// Returns the time of measurement of a frame that arrived at `arrival`. It is never later than `arrival`,
    /// and never earlier than the last stamp.
    pub fn stamp(&mut self, frame: u32, arrival: ServerTime) -> ServerTime {
        let jumped = self.window.back().is_some_and(|&(last, last_arrival)| {
            let ahead = frame.wrapping_sub(last);
            ahead == 0 || ahead > MAX_GAP || arrival.seconds_since(last_arrival) > MAX_SILENCE_S
        });
        if jumped {
            self.restart();
            self.slew = Slew::default();
        }
        self.window.push_back((frame, arrival));
        if self.window.len() > WINDOW {
            self.window.pop_front();
        }
        let lateness_s = self.lateness_s();
        // If the frames stay late, the source paused and its counter slipped: start over. A burst after a pause
        // of this process also comes late, but ends at once.
        self.late_since =
            if lateness_s > SLIP_S { self.late_since.or(Some(arrival)) } else { None };
        if self.late_since.is_some_and(|since| arrival.seconds_since(since) > SLIP_LASTS_S) {
            self.restart();
            self.window.push_back((frame, arrival));
            self.slew.slip(lateness_s);
            let stamp = self.slew.apply(arrival);
            return self.monotone(stamp, arrival);
        }
        let stamp = self.slew.apply(arrival.plus_seconds(-lateness_s));
        self.monotone(stamp, arrival)
    }

    fn restart(&mut self) {
        self.window.clear();
        self.late_since = None;
    }

    fn monotone(&mut self, stamp: ServerTime, arrival: ServerTime) -> ServerTime {
        let stamp = self.last.map_or(stamp, |last| stamp.max(last)).min(arrival);
        self.last = Some(stamp);
        stamp
    }

    /// Returns the delay of the newest frame compared with the fastest one of the window. [s]
    fn lateness_s(&mut self) -> f64 {
        let (Some(&first), Some(&newest)) = (self.window.front(), self.window.back()) else {
            return 0.0;
        };
        let point = |(frame, arrival): (u32, ServerTime)| {
            (f64::from(frame.wrapping_sub(first.0)), arrival.seconds_since(first.1))
        };
        // The period hardly changes: an update every few frames is sufficient.
        if self.window.len() >= MIN_SAMPLES
            && (self.period_s.is_none() || newest.0.is_multiple_of(8))
        {
            self.points.clear();
            self.points.extend(self.window.iter().map(|&p| point(p)));
            self.period_s = slope_of_the_prompt(&mut self.points).or(self.period_s);
        }
        // Until there is a slope, the arrival is the stamp.
        let Some(period_s) = self.period_s else { return 0.0 };
        let offset = |(f, a): (f64, f64)| a - period_s * f;
        let least = self.window.iter().map(|&p| offset(point(p))).fold(f64::INFINITY, f64::min);
        (offset(point(newest)) - least).max(0.0)
    }
}

/// Returns the slope of a least-squares line through the faster half of (frame, arrival) points.
///
/// Delays are one-sided and come in bursts, which tilt a line through all points. So the later half, relative
/// to the previous line, is left out, in a few iterations (the concentration steps of least trimmed squares:
/// Rousseeuw and Van Driessen, 1999). Reorders the points.
fn slope_of_the_prompt(points: &mut [(f64, f64)]) -> Option<f64> {
    let mut kept = points.len();
    let mut slope = None;
    for _ in 0..STEPS {
        let count = kept as f64;
        let used = &points[..kept];
        let (sum_f, sum_a) = used.iter().fold((0.0, 0.0), |s, (f, a)| (s.0 + f, s.1 + a));
        let (mean_f, mean_a) = (sum_f / count, sum_a / count);
        let (cross, square) = used.iter().fold((0.0, 0.0), |s, (f, a)| {
            (s.0 + (f - mean_f) * (a - mean_a), s.1 + (f - mean_f).powi(2))
        });
        if !(square > 0.0) {
            return slope;
        }
        let period_s = cross / square;
        slope = Some(period_s);
        kept = points.len().div_ceil(2).max(MIN_SAMPLES / 2).min(points.len());
        points.select_nth_unstable_by(kept - 1, |p, q| {
            (p.1 - period_s * p.0).total_cmp(&(q.1 - period_s * q.0))
        });
    }
    slope
}

/// Two seconds at 200 Hz. The slope's error is then 1 us a frame for 2 ms of jitter.
const WINDOW: usize = 400;
/// Minimum frames for a slope; with fewer, the last slope is kept.
const MIN_SAMPLES: usize = 20;
/// A larger gap in the counter means another recording: a second at 200 Hz.
const MAX_GAP: u32 = 200;
/// Silence after which the counter is no longer trusted. [s]
const MAX_SILENCE_S: f64 = 1.0;
/// Iterations: enough for a burst of a quarter of the window.
const STEPS: usize = 4;
/// A delay above this for [`SLIP_LASTS_S`] is not caused by the network of a lab. [s]
const SLIP_S: f64 = 0.010;
const SLIP_LASTS_S: f64 = 0.3;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const PERIOD_NS: u64 = 5_000_000;

    fn truth(frame: u32) -> ServerTime {
        ServerTime::from_ns(1_000_000_000 + u64::from(frame) * PERIOD_NS)
    }

    proptest! {
        /// With jitter of up to 4 ms, stamps settle to within 2 ms of the truth, 1 ms on average; arrivals are
        /// off by up to 4 ms, 2 ms on average.
        #[test]
        fn jitter_is_removed(delays in prop::collection::vec(0u64..4_000_000, 400..600)) {
            let mut clock = FrameClock::default();
            let (mut arrival, mut sum_s) = (ServerTime::ZERO, 0.0);
            for (frame, delay) in delays.iter().enumerate() {
                let frame = frame as u32;
                // Packets do not overtake each other.
                arrival = arrival.max(truth(frame).plus_ns(*delay as i64));
                let stamp = clock.stamp(frame, arrival);
                prop_assert!(stamp <= arrival);
                if frame > 200 {
                    let error_s = stamp.seconds_since(truth(frame)).abs();
                    prop_assert!(error_s < 2e-3, "frame {}: {} s", frame, error_s);
                    sum_s += error_s;
                }
            }
            prop_assert!(sum_s / (delays.len() as f64 - 201.0) < 1e-3);
        }

        /// For any input, stamps never run backwards and are never later than the arrival.
        #[test]
        fn stamps_are_monotone(input in prop::collection::vec((any::<u32>(), 0u64..50_000_000), 1..200)) {
            let mut clock = FrameClock::default();
            let (mut arrival, mut last) = (ServerTime::from_ns(1), ServerTime::ZERO);
            for (frame, wait) in input {
                arrival = arrival.plus_ns(wait as i64);
                let stamp = clock.stamp(frame, arrival);
                prop_assert!(stamp >= last && stamp <= arrival);
                last = stamp;
            }
        }
    }

    /// This process pauses: frames queue in the socket and are read all at once. Their stamps keep the source's
    /// rhythm; with arrival times, the vehicle would seem to jump.
    #[test]
    fn a_burst_keeps_the_rhythm_of_the_source() {
        let mut clock = FrameClock::default();
        for frame in 0..300 {
            clock.stamp(frame, truth(frame));
        }
        let read = truth(350);
        for frame in 300..350 {
            let stamp = clock.stamp(frame, read);
            assert!(stamp.seconds_since(truth(frame)).abs() < 2e-3, "frame {frame}: {stamp:?}");
        }
    }

    /// After a pause of the source, no interval of the stamps is shorter than the true one, and none is much longer.
    #[test]
    fn a_pause_of_the_source_does_not_step_the_stamps() {
        for pause_ms in [20, 50, 100, 200, 400] {
            let mut clock = FrameClock::default();
            for frame in 0..300 {
                clock.stamp(frame, truth(frame));
            }
            let late = |frame| truth(frame).plus_ns(pause_ms * 1_000_000);
            let mut last = clock.stamp(300, late(300));
            for frame in 301..800 {
                let stamp = clock.stamp(frame, late(frame));
                let periods = stamp.seconds_since(last) / (PERIOD_NS as f64 * 1e-9);
                assert!((0.98..1.4).contains(&periods), "{pause_ms} ms, {frame}: {periods}");
                last = stamp;
            }
            assert!(last.seconds_since(late(799)).abs() < 1e-3, "{pause_ms} ms: {last:?}");
        }
    }

    #[test]
    fn recovers_after_the_source_paused() {
        let mut clock = FrameClock::default();
        for frame in 0..300 {
            clock.stamp(frame, truth(frame));
        }
        // From here on every frame arrives 60 ms later than its number implies.
        let late = |frame| truth(frame).plus_ns(60_000_000);
        let stamps: Vec<_> = (300..400).map(|frame| clock.stamp(frame, late(frame))).collect();
        let last = *stamps.last().unwrap();
        assert!(last.seconds_since(late(399)).abs() < 1e-3, "{last:?}");
    }
}
