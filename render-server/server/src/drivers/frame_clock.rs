//! Stamps frames that come with a counter but without a time. Sans-IO.
//!
//! Frames are measured at a constant rate, but arrive late by a delay that varies: the network,
//! and this computer waking up late. Over a window, arrival = offset + period * frame + delay with
//! delay >= 0. The period is the slope of a least-squares line; the offset is the least
//! `arrival - period * frame`, as in the minimum-delay filter of NTP. What remains in the stamp is
//! the constant delay only. Velocity from finite differences needs this: two packets read at the
//! same instant would otherwise be an infinite speed.

use std::collections::VecDeque;

use vizflyt_protocol::time::ServerTime;

/// Maps frame numbers to the server's clock.
#[derive(Debug, Default)]
pub struct FrameClock {
    /// (frame, arrival), oldest first, frames unwrapped relative to the first of the window.
    window: VecDeque<(u32, ServerTime)>,
    late_in_a_row: u32,
    last: Option<ServerTime>,
}

impl FrameClock {
    /// Takes a frame that arrived at `arrival`; returns when it was measured. Never later than
    /// `arrival`, never earlier than the last stamp.
    pub fn stamp(&mut self, frame: u32, arrival: ServerTime) -> ServerTime {
        let jumped = self.window.back().is_some_and(|&(last, last_arrival)| {
            let ahead = frame.wrapping_sub(last);
            ahead == 0 || ahead > MOST_GAP || arrival.seconds_since(last_arrival) > MOST_SILENCE_S
        });
        if jumped {
            self.restart();
        }
        self.window.push_back((frame, arrival));
        if self.window.len() > WINDOW {
            self.window.pop_front();
        }
        let lateness_s = self.lateness_s();
        // The counter's clock slipped against ours for good (the source paused): start over.
        self.late_in_a_row = if lateness_s > SLIP_S { self.late_in_a_row + 1 } else { 0 };
        if self.late_in_a_row > SLIP_FRAMES {
            self.restart();
            self.window.push_back((frame, arrival));
            return self.monotone(arrival, arrival);
        }
        self.monotone(arrival.plus_seconds(-lateness_s), arrival)
    }

    fn restart(&mut self) {
        self.window.clear();
        self.late_in_a_row = 0;
    }

    fn monotone(&mut self, stamp: ServerTime, arrival: ServerTime) -> ServerTime {
        let stamp = self.last.map_or(stamp, |last| stamp.max(last)).min(arrival);
        self.last = Some(stamp);
        stamp
    }

    /// Returns by how much the newest frame came later than the promptest of the window. [s]
    fn lateness_s(&self) -> f64 {
        let (Some(&(frame_0, arrival_0)), Some(&newest)) =
            (self.window.front(), self.window.back())
        else {
            return 0.0;
        };
        if self.window.len() < LEAST {
            return 0.0;
        }
        let point = |&(frame, arrival): &(u32, ServerTime)| {
            (f64::from(frame.wrapping_sub(frame_0)), arrival.seconds_since(arrival_0))
        };
        let count = self.window.len() as f64;
        let (sum_f, sum_a) =
            self.window.iter().map(point).fold((0.0, 0.0), |s, (f, a)| (s.0 + f, s.1 + a));
        let (mean_f, mean_a) = (sum_f / count, sum_a / count);
        let (cross, square) = self.window.iter().map(point).fold((0.0, 0.0), |s, (f, a)| {
            (s.0 + (f - mean_f) * (a - mean_a), s.1 + (f - mean_f).powi(2))
        });
        if !(square > 0.0) {
            return 0.0;
        }
        let period_s = cross / square;
        let offset = |(f, a): (f64, f64)| a - period_s * f;
        let least = self.window.iter().map(|p| offset(point(p))).fold(f64::INFINITY, f64::min);
        (offset(point(&newest)) - least).max(0.0)
    }
}

/// Two seconds at 200 Hz. The slope's error is then 1 us a frame for 2 ms of jitter.
const WINDOW: usize = 400;
/// Fewer frames than this give no slope worth using: stamps are arrivals.
const LEAST: usize = 20;
/// A gap in the counter beyond this is another recording: a second at 200 Hz.
const MOST_GAP: u32 = 200;
/// Silence after which the counter is trusted no more. [s]
const MOST_SILENCE_S: f64 = 1.0;
/// Lateness that no network of a lab explains for [`SLIP_FRAMES`] frames in a row. [s]
const SLIP_S: f64 = 0.010;
const SLIP_FRAMES: u32 = 20;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const PERIOD_NS: u64 = 5_000_000;

    fn truth(frame: u32) -> ServerTime {
        ServerTime::from_ns(1_000_000_000 + u64::from(frame) * PERIOD_NS)
    }

    proptest! {
        /// With jitter of up to 4 ms, stamps settle to within 1 ms of the truth (plus the least
        /// delay), where arrivals are off by up to 4.
        #[test]
        fn jitter_is_removed(delays in prop::collection::vec(0u64..4_000_000, 400..600)) {
            let mut clock = FrameClock::default();
            let mut arrival = ServerTime::ZERO;
            for (frame, delay) in delays.iter().enumerate() {
                let frame = frame as u32;
                // Packets do not overtake each other.
                arrival = arrival.max(truth(frame).plus_ns(*delay as i64));
                let stamp = clock.stamp(frame, arrival);
                prop_assert!(stamp <= arrival);
                if frame > 200 {
                    prop_assert!(stamp.seconds_since(truth(frame)).abs() < 1e-3);
                }
            }
        }

        /// Whatever comes, stamps never run backwards nor ahead of the arrival.
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

    #[test]
    fn a_source_that_paused_is_followed() {
        let mut clock = FrameClock::default();
        for frame in 0..300 {
            clock.stamp(frame, truth(frame));
        }
        // From here on every frame comes 60 ms later than its number says.
        let late = |frame| truth(frame).plus_ns(60_000_000);
        let stamps: Vec<_> = (300..400).map(|frame| clock.stamp(frame, late(frame))).collect();
        let last = *stamps.last().unwrap();
        assert!(last.seconds_since(late(399)).abs() < 1e-3, "{last:?}");
    }
}
