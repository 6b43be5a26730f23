//! Maps stamps of another computer's clock to the server's clock, from one-way packets. Sans-IO.
//!
//! arrival = stamp + offset + delay, with delay >= 0. The least `arrival - stamp` of the last seconds is the
//! sum of offset and least delay, so a mapped stamp contains only this constant delay (0.1 ms on a cable). With
//! a crystal of 50 ppm, ten seconds are 0.5 ms.

use vizflyt_protocol::time::ServerTime;

use super::slew::Slew;

/// Maps a sender's clock to the server's clock.
#[derive(Clone, Debug)]
pub struct SenderClock {
    /// Least `arrival - stamp` of each of the last seconds, with the number of the second. [ns]
    buckets: [Option<(u64, i64)>; BUCKETS],
    /// Time since which all packets have been late.
    late_since: Option<ServerTime>,
    /// Newest packet that came too late for any network: stamp, arrival, and number of such packets at even
    /// intervals.
    fallen: Option<(u64, ServerTime, u32)>,
    last: Option<ServerTime>,
    slew: Slew,
    jump_s: Option<f64>,
    /// First packet of the last seconds: stamp and arrival.
    first: Option<(u64, ServerTime)>,
    /// Power of 1000 by which the stamps advance too fast, because they are in another unit than nanoseconds.
    scale: Option<f64>,
    has_new_scale: bool,
}

impl Default for SenderClock {
    fn default() -> Self {
        Self {
            buckets: [None; BUCKETS],
            late_since: None,
            fallen: None,
            last: None,
            slew: Slew::default(),
            jump_s: None,
            first: None,
            scale: None,
            has_new_scale: false,
        }
    }
}

impl SenderClock {
    /// Maps the sender's time `sent_ns` of a packet that came at `arrival` to the server's clock. The result is
    /// never later than `arrival`; it is `arrival` while the stamps are in another unit. [ns, sender]
    pub fn map(&mut self, sent_ns: u64, arrival: ServerTime) -> ServerTime {
        // Clocks of any two computers are less than 292 years apart.
        let offset_ns = arrival.as_ns().wrapping_sub(sent_ns).cast_signed();
        let second = arrival.as_ns() / 1_000_000_000;
        let is_early = self.check_unit(sent_ns, arrival);
        if self.scale.is_some() {
            return arrival;
        }
        if let Some(least_ns) = self.least_ns(second) {
            let late_s = offset_ns.wrapping_sub(least_ns) as f64 * 1e-9;
            // A clock that was set forward makes packets arrive before they were sent. A clock that was set
            // back makes all later packets late, but a burst after a pause ends at once.
            self.late_since =
                if late_s > SLIP_S { self.late_since.or(Some(arrival)) } else { None };
            let slipped =
                self.late_since.is_some_and(|since| arrival.seconds_since(since) > SLIP_LASTS_S);
            let restarted = self.has_restarted(sent_ns, arrival, late_s);
            if slipped || restarted || late_s < -SLIP_S {
                self.slew.slip(if restarted { f64::INFINITY } else { late_s });
                // The jump of the clock equals the apparent earliness of its packets.
                self.jump_s = (!is_early).then_some(-late_s);
                self.buckets = [None; BUCKETS];
                (self.late_since, self.fallen) = (None, None);
            }
        }
        let bucket = &mut self.buckets[(second % BUCKETS as u64) as usize];
        match bucket {
            Some((at, least_ns)) if *at == second => *least_ns = (*least_ns).min(offset_ns),
            _ => *bucket = Some((second, offset_ns)),
        }
        let least_ns = self.least_ns(second).unwrap_or(offset_ns);
        let stamp = ServerTime::from_ns(sent_ns.wrapping_add_signed(least_ns)).min(arrival);
        self.slew.apply(stamp)
    }

    /// Maps like [`Self::map`], but never returns an earlier time than before.
    pub fn map_in_order(&mut self, sent_ns: u64, arrival: ServerTime) -> ServerTime {
        let mapped = self.map(sent_ns, arrival);
        let mapped = self.last.map_or(mapped, |last| mapped.max(last));
        self.last = Some(mapped);
        mapped
    }

    /// Returns the jump of the sender's clock, positive if forward; each jump once. [s]
    pub fn take_jump_s(&mut self) -> Option<f64> {
        self.jump_s.take()
    }

    /// Returns the unit of the stamps, if it is not the expected `unit_s`; once for each wrong unit. [s]
    pub fn take_unit(&mut self, unit_s: f64) -> Option<&'static str> {
        let scale = self.scale.filter(|_| std::mem::take(&mut self.has_new_scale))?;
        unit_name(unit_s / scale)
    }

    /// Compares the advance of the stamps with that of the arrivals. Returns whether it is too early to distinguish
    /// another unit from a clock that was set.
    fn check_unit(&mut self, sent_ns: u64, arrival: ServerTime) -> bool {
        let &mut (first_ns, first_at) = self.first.get_or_insert((sent_ns, arrival));
        let past_s = arrival.seconds_since(first_at);
        let Some(sent_s) = sent_ns.checked_sub(first_ns).map(|ns| ns as f64 * 1e-9) else {
            self.first = None;
            return false;
        };
        let rate = sent_s / past_s.max(1e-9);
        let is_usual = (1e-2..1e2).contains(&rate);
        if past_s < UNIT_S {
            return past_s > 0.0 && !is_usual;
        }
        self.first = Some((sent_ns, arrival));
        let scale = 1e3f64.powf((rate.log10() / 3.0).round());
        let is_unit = !is_usual && (0.5..2.0).contains(&(rate / scale));
        // Stamps in whole seconds advance in steps.
        let scale = if rate > 0.0 && rate < 2e-9 { Some(1e-9) } else { is_unit.then_some(scale) };
        if scale != self.scale {
            (self.scale, self.has_new_scale) = (scale, scale.is_some());
            (self.buckets, self.late_since, self.fallen) = ([None; BUCKETS], None, None);
        }
        false
    }

    /// Returns whether packets with lower stamps arrive at even intervals: the sender or its computer
    /// restarted. A burst after a pause arrives at once, and reordered packets arrive one at a time.
    fn has_restarted(&mut self, sent_ns: u64, arrival: ServerTime, late_s: f64) -> bool {
        if late_s < FALLEN_S {
            self.fallen = None;
            return false;
        }
        let count = match self.fallen {
            Some((last_ns, at, count)) if sent_ns > last_ns => {
                let (sent_s, came_s) =
                    ((sent_ns - last_ns) as f64 * 1e-9, arrival.seconds_since(at));
                if came_s > 0.5 * sent_s && came_s < 2.0 * sent_s { count + 1 } else { 1 }
            }
            _ => 1,
        };
        self.fallen = Some((sent_ns, arrival, count));
        count >= EVEN_PACKETS
    }

    fn least_ns(&self, second: u64) -> Option<i64> {
        let recent = |&&(at, _): &&(u64, i64)| second.wrapping_sub(at) < BUCKETS as u64;
        self.buckets.iter().flatten().filter(recent).map(|&(_, least_ns)| least_ns).min()
    }
}

/// Returns the name of a unit of time; `None` if there is none of this size. [s]
pub(super) fn unit_name(unit_s: f64) -> Option<&'static str> {
    let units =
        [(1e-9, "nanoseconds"), (1e-6, "microseconds"), (1e-3, "milliseconds"), (1.0, "seconds")];
    units.into_iter().find(|(s, _)| (0.5..2.0).contains(&(unit_s / s))).map(|(_, name)| name)
}

/// Time over which stamps are compared with arrivals: stamps in whole seconds advance at least once. [s]
const UNIT_S: f64 = 1.5;
/// Length of the history. [s]
const BUCKETS: usize = 10;
/// A delay above this for [`SLIP_LASTS_S`] is not caused by the network of a lab. [s]
const SLIP_S: f64 = 0.02;
const SLIP_LASTS_S: f64 = 0.3;
/// A clock restarted if it fell back by this, and at least [`EVEN_PACKETS`] packets followed at even intervals.
/// [s]
const FALLEN_S: f64 = 0.5;
const EVEN_PACKETS: u32 = 3;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The server's clock minus the sender's. [ns]
    const APART_NS: u64 = 77_000_000_000;

    fn truth(index: u64) -> ServerTime {
        ServerTime::from_ns(100_000_000_000 + index * 10_000_000)
    }

    proptest! {
        #[test]
        fn jitter_is_removed(delays in prop::collection::vec(100_000i64..8_000_000, 300..400)) {
            let mut clock = SenderClock::default();
            for (index, delay) in delays.into_iter().enumerate() {
                let sent = truth(index as u64);
                let mapped = clock.map(sent.as_ns() - APART_NS, sent.plus_ns(delay));
                // After the first fast packet, the only error is the least delay.
                if index > 200 {
                    let off_s = mapped.seconds_since(sent);
                    prop_assert!((0.0..1.5e-3).contains(&off_s), "{off_s}");
                }
            }
            prop_assert_eq!(clock.take_jump_s(), None);
        }

        #[test]
        fn no_stamp_is_in_the_future(input in prop::collection::vec((any::<u64>(), 0i64..1_000_000_000), 1..100)) {
            let (mut clock, mut now, mut last) = (SenderClock::default(), truth(0), ServerTime::ZERO);
            for (sent_ns, wait_ns) in input {
                now = now.plus_ns(wait_ns);
                let mapped = clock.map_in_order(sent_ns, now);
                prop_assert!(mapped <= now && mapped >= last);
                last = mapped;
                let _ = clock.take_jump_s();
            }
        }
    }

    #[test]
    fn follows_and_reports_a_clock_that_was_set() {
        for jump_s in [3.0, -3.0, 0.05, -0.05] {
            let mut clock = SenderClock::default();
            let shown = |index: u64, set_s: f64| {
                ServerTime::from_ns(truth(index).as_ns() - APART_NS).plus_seconds(set_s).as_ns()
            };
            for index in 0..100 {
                clock.map(shown(index, 0.0), truth(index));
            }
            let mut jumps = Vec::new();
            for index in 100..200 {
                clock.map(shown(index, jump_s), truth(index));
                jumps.extend(clock.take_jump_s());
            }
            assert_eq!(jumps.len(), 1, "{jump_s}: {jumps:?}");
            assert!((jumps[0] - jump_s).abs() < 1e-3, "{jump_s}: {jumps:?}");
            let last = clock.map(shown(200, jump_s), truth(200));
            assert!(last.seconds_since(truth(200)).abs() < 1e-3);
        }
    }

    #[test]
    fn follows_a_restarted_clock_within_three_packets() {
        for hz in [10u64, 30, 100, 200] {
            let mut clock = SenderClock::default();
            let at = |index: u64| ServerTime::from_ns(100_000_000_000 + index * 1_000_000_000 / hz);
            for index in 0..100 {
                clock.map(at(index).as_ns() - APART_NS, at(index));
            }
            let mut jumps = Vec::new();
            for index in 0..3 {
                let now = at(100 + index);
                let mapped = clock.map(index * 1_000_000_000 / hz, now);
                jumps.extend(clock.take_jump_s());
                assert!(index < 2 || now.seconds_since(mapped) < 1e-3, "{hz} Hz: {mapped:?}");
            }
            assert_eq!(jumps.len(), 1, "{hz} Hz");
        }
    }

    /// Old packets between new ones, due to a network or a recording, do not change the clock.
    #[test]
    fn ignores_old_packets_between_new_ones() {
        let mut clock = SenderClock::default();
        for index in 0..400 {
            let mapped = clock.map(truth(index).as_ns() - APART_NS, truth(index));
            assert!(mapped.seconds_since(truth(index)).abs() < 1e-6);
            if index > 100 {
                let late = truth(index).plus_ns(1_000_000);
                clock.map(truth(index - 100).as_ns() - APART_NS, late);
            }
        }
        assert_eq!(clock.take_jump_s(), None);
    }

    /// As [`super::super::frame_clock`]: a pause of the sender's clock never makes the vehicle seem faster.
    #[test]
    fn a_pause_of_the_sender_does_not_step_the_stamps() {
        for pause_ms in [30, 50, 100, 200, 400] {
            let mut clock = SenderClock::default();
            let sent = |index| truth(index).as_ns() - APART_NS;
            for index in 0..200 {
                clock.map(sent(index), truth(index));
            }
            let late = |index| truth(index).plus_ns(pause_ms * 1_000_000);
            let mut last = clock.map(sent(200), late(200));
            for index in 201..500 {
                let stamp = clock.map(sent(index), late(index));
                let periods = stamp.seconds_since(last) / 0.01;
                assert!((0.98..1.4).contains(&periods), "{pause_ms} ms, {index}: {periods}");
                last = stamp;
            }
            assert!(last.seconds_since(late(499)).abs() < 1e-3, "{pause_ms} ms: {last:?}");
        }
    }

    #[test]
    fn does_not_report_a_jump_after_a_burst() {
        let mut clock = SenderClock::default();
        for index in 0..100 {
            clock.map(truth(index).as_ns() - APART_NS, truth(index));
        }
        for index in 100..150 {
            let mapped = clock.map(truth(index).as_ns() - APART_NS, truth(150));
            assert!(mapped.seconds_since(truth(index)).abs() < 1e-6);
        }
        assert_eq!(clock.take_jump_s(), None);
    }
}
