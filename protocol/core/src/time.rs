//! Stamps: when a measurement was valid, in a clock that its type names. Only this module
//! converts between clocks.

use core::cmp::Ordering;
use core::fmt;
use core::marker::PhantomData;

use serde::{Deserialize, Serialize};

/// A clock domain; implemented by empty marker types only.
pub trait Clock: Copy + 'static {
    /// The clock's name in messages and documents.
    const NAME: &'static str;
}

macro_rules! clocks {
    ($($(#[$doc:meta])* $marker:ident, $alias:ident = $text:literal;)*) => {$(
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $marker {}
        impl Clock for $marker {
            const NAME: &'static str = $text;
        }
        $(#[$doc])*
        pub type $alias = Stamp<$marker>;
    )*};
}

clocks! {
    /// The monotonic clock of the computer this code runs on.
    Host, HostTime = "host";
    /// The monotonic clock of the render server's computer; stamps poses and images.
    Server, ServerTime = "server";
    /// The autopilot's time since boot.
    Autopilot, AutopilotTime = "autopilot";
    /// The motion capture system's frame clock.
    Mocap, MocapTime = "mocap";
}

/// Nanoseconds on the clock `C`.
#[derive(Serialize, Deserialize)]
#[serde(bound = "", transparent)]
pub struct Stamp<C> {
    ns: u64,
    #[serde(skip)]
    clock: PhantomData<fn() -> C>,
}

impl<C: Clock> Stamp<C> {
    /// The clock's zero.
    pub const ZERO: Self = Self::from_ns(0);

    /// Makes a stamp from nanoseconds on this clock. [ns]
    pub const fn from_ns(ns: u64) -> Self {
        Self { ns, clock: PhantomData }
    }

    /// Returns nanoseconds on this clock. [ns]
    pub const fn as_ns(self) -> u64 {
        self.ns
    }

    /// Returns `self - earlier`, negative if `earlier` is later. [s]
    pub fn seconds_since(self, earlier: Self) -> f64 {
        // Wrapping keeps the sign for any two stamps less than 292 years apart.
        self.ns.wrapping_sub(earlier.ns).cast_signed() as f64 * 1e-9
    }

    /// Returns the stamp `seconds` later (earlier if negative), held at the clock's ends. [s]
    pub fn plus_seconds(self, seconds: f64) -> Self {
        self.plus_ns((seconds * 1e9) as i64)
    }

    /// Returns the stamp `ns` later (earlier if negative), held at the clock's ends. [ns]
    pub fn plus_ns(self, ns: i64) -> Self {
        Self::from_ns(self.ns.saturating_add_signed(ns))
    }
}

// Written out because `derive` would ask the same of the clock tags.
impl<C> Clone for Stamp<C> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<C> Copy for Stamp<C> {}
impl<C> PartialEq for Stamp<C> {
    fn eq(&self, other: &Self) -> bool {
        self.ns == other.ns
    }
}
impl<C> Eq for Stamp<C> {}
impl<C> PartialOrd for Stamp<C> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}
impl<C> Ord for Stamp<C> {
    fn cmp(&self, other: &Self) -> Ordering {
        self.ns.cmp(&other.ns)
    }
}
impl<C: Clock> Default for Stamp<C> {
    fn default() -> Self {
        Self::ZERO
    }
}
impl<C: Clock> fmt::Debug for Stamp<C> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}.{:09} s", C::NAME, self.ns / 1_000_000_000, self.ns % 1_000_000_000)
    }
}

/// Relates a remote clock to a local one from request-reply exchanges, by the exchange with the
/// least round trip of a recent window (the minimum-delay filter of NTP, RFC 5905 section 10).
///
/// The error of the offset is at most half that round trip, plus drift over the window.
#[derive(Clone, Copy, Debug)]
pub struct OffsetFilter<Local, Remote> {
    window: [Option<Exchange>; WINDOW],
    next: usize,
    clocks: PhantomData<fn() -> (Local, Remote)>,
}

/// One exchange: what was added to local time to give remote time, and how long it took.
#[derive(Clone, Copy, Debug)]
struct Exchange {
    offset_ns: i64,
    round_trip_ns: u64,
}

/// Exchanges remembered. At one a second, crystal drift of 50 ppm over the window is 0.4 ms at
/// worst and is corrected as old exchanges leave.
const WINDOW: usize = 8;

impl<Local: Clock, Remote: Clock> Default for OffsetFilter<Local, Remote> {
    fn default() -> Self {
        Self { window: [None; WINDOW], next: 0, clocks: PhantomData }
    }
}

impl<Local: Clock, Remote: Clock> OffsetFilter<Local, Remote> {
    /// Takes one exchange: asked at `sent`, answered by the remote at `remote`, answer read at
    /// `received`. An exchange that ends before it began is dropped.
    pub fn update(&mut self, sent: Stamp<Local>, remote: Stamp<Remote>, received: Stamp<Local>) {
        let Some(round_trip_ns) = received.as_ns().checked_sub(sent.as_ns()) else {
            return;
        };
        let middle_ns = sent.as_ns() + round_trip_ns / 2;
        let offset_ns = remote.as_ns().wrapping_sub(middle_ns).cast_signed();
        self.window[self.next] = Some(Exchange { offset_ns, round_trip_ns });
        self.next = (self.next + 1) % WINDOW;
    }

    fn best(&self) -> Option<Exchange> {
        self.window.iter().flatten().min_by_key(|exchange| exchange.round_trip_ns).copied()
    }

    /// Returns the bound of the offset's error: half the least round trip; `None` before the
    /// first exchange. [ns]
    pub fn error_bound_ns(&self) -> Option<u64> {
        self.best().map(|exchange| exchange.round_trip_ns / 2)
    }

    /// Converts a remote stamp to the local clock; `None` before the first exchange.
    ///
    /// ```
    /// use vizflyt_protocol::time::{Autopilot, AutopilotTime, Host, HostTime, OffsetFilter};
    /// let mut filter = OffsetFilter::<Host, Autopilot>::default();
    /// // Asked at 1000 ns, answered "50 000" half-way through a 200 ns round trip.
    /// filter.update(HostTime::from_ns(1_000), AutopilotTime::from_ns(50_000), HostTime::from_ns(1_200));
    /// assert_eq!(filter.to_local(AutopilotTime::from_ns(50_900)), Some(HostTime::from_ns(2_000)));
    /// assert_eq!(filter.to_remote(HostTime::from_ns(2_000)), Some(AutopilotTime::from_ns(50_900)));
    /// ```
    pub fn to_local(&self, remote: Stamp<Remote>) -> Option<Stamp<Local>> {
        self.best().map(|e| Stamp::from_ns(remote.as_ns().wrapping_sub(e.offset_ns as u64)))
    }

    /// Converts a local stamp to the remote clock; `None` before the first exchange.
    pub fn to_remote(&self, local: Stamp<Local>) -> Option<Stamp<Remote>> {
        self.best().map(|e| Stamp::from_ns(local.as_ns().wrapping_add(e.offset_ns as u64)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Whatever the two one-way delays, the error stays within the bound the filter states.
        #[test]
        fn the_error_bound_holds(
            offset in -1_000_000_000_000i64..1_000_000_000_000,
            delays in prop::collection::vec((0u64..20_000_000, 0u64..20_000_000), 1..20),
        ) {
            let mut filter = OffsetFilter::<Host, Server>::default();
            let mut now_ns = 2_000_000_000_000u64;
            for (out, back) in delays {
                let remote = ServerTime::from_ns((now_ns + out).wrapping_add_signed(offset));
                filter.update(HostTime::from_ns(now_ns), remote, HostTime::from_ns(now_ns + out + back));
                now_ns += 1_000_000_000;
            }
            let bound = filter.error_bound_ns().unwrap() as i64 + 1;
            let estimate = filter.to_remote(HostTime::from_ns(now_ns)).unwrap();
            let truth = now_ns.wrapping_add_signed(offset);
            prop_assert!((estimate.as_ns().wrapping_sub(truth) as i64).abs() <= bound);
        }
    }

    #[test]
    fn differences_keep_their_sign() {
        let (a, b) = (HostTime::from_ns(5), HostTime::from_ns(1_000_000_005));
        assert_eq!(b.seconds_since(a), 1.0);
        assert_eq!(a.seconds_since(b), -1.0);
        assert_eq!(HostTime::ZERO.plus_seconds(-1.0), HostTime::ZERO);
    }

    #[test]
    fn an_exchange_that_ends_before_it_began_is_dropped() {
        let mut filter = OffsetFilter::<Host, Server>::default();
        filter.update(HostTime::from_ns(10), ServerTime::from_ns(0), HostTime::from_ns(9));
        assert_eq!(filter.to_local(ServerTime::from_ns(0)), None);
    }
}
