//! Converts the time stamps of vision measurements to the autopilot's clock.
//!
//! The offset of the companion's clock is unknown. Like ArduPilot, this module uses the minimum difference between
//! arrival and stamp as the offset. That removes jitter, but not the constant part of the latency, which VISO_DELAY_MS
//! compensates.

use vizflyt_protocol::time::AutopilotTime;

/// Maximum age of a measurement [ns]. An older one means that the clock jumped, not that the packet was late.
const MAX_AGE_NS: i64 = 500_000_000;
/// Number of packets after which the minimum is restarted, to follow clock drift.
const WINDOW: u32 = 100;

/// Converts remote time stamps to local ones.
#[derive(Clone, Debug, Default)]
pub(super) struct StampCorrector {
    offset_ns: Option<i64>,
    window_min_ns: Option<i64>,
    samples: u32,
}

impl StampCorrector {
    /// Returns the time of a measurement stamped `usec` by its sender and received at `now`. A stamp of 0 means that
    /// the sender sends none.
    pub(super) fn correct(&mut self, usec: u64, now: AutopilotTime) -> AutopilotTime {
        if usec == 0 {
            return now;
        }
        let stamp_ns = usec.wrapping_mul(1000);
        let difference_ns = now.as_ns().wrapping_sub(stamp_ns).cast_signed();
        let offset_ns = self.offset_ns.map_or(difference_ns, |o| o.min(difference_ns));
        self.offset_ns = Some(offset_ns);
        let least = self.window_min_ns.map_or(difference_ns, |m| m.min(difference_ns));
        self.window_min_ns = Some(least);
        self.samples += 1;
        if self.samples >= WINDOW {
            self.samples = 0;
            self.offset_ns = self.window_min_ns.take();
        }
        let age_ns = difference_ns.saturating_sub(offset_ns);
        if age_ns > MAX_AGE_NS {
            *self = Self { offset_ns: Some(difference_ns), ..Self::default() };
            return now;
        }
        now.plus_ns(-age_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn removes_jitter_and_survives_a_clock_jump() {
        let mut corrector = StampCorrector::default();
        let at = |ms: u64| AutopilotTime::from_ns(ms * 1_000_000);
        // A remote clock 1000 s ahead; transport takes 3 ms, then 8 ms.
        assert_eq!(corrector.correct(1_000_000_000 + 100_000, at(103)), at(103));
        assert_eq!(corrector.correct(1_000_000_000 + 120_000, at(128)), at(123));
        assert_eq!(corrector.correct(0, at(140)), at(140));
        // The remote restarts: its clock is near zero.
        assert_eq!(corrector.correct(5_000, at(160)), at(160));
        assert_eq!(corrector.correct(25_000, at(185)), at(180));
    }

    proptest! {
        #[test]
        fn the_result_is_never_in_the_future_or_too_old(
            packets in prop::collection::vec((any::<u64>(), 0u64..100_000_000), 1..300),
        ) {
            let mut corrector = StampCorrector::default();
            let mut now_ns = 1_000_000_000;
            for (usec, gap_ns) in packets {
                now_ns += gap_ns;
                let now = AutopilotTime::from_ns(now_ns);
                let valid = corrector.correct(usec, now);
                prop_assert!(valid <= now && now.seconds_since(valid) <= 0.5 + 1e-9);
            }
        }
    }
}
