//! Time stamps of measurements, with the clock in the type. Only this module converts between clocks.

mod civil;
mod offset;

use core::cmp::Ordering;
use core::fmt;
use core::marker::PhantomData;

use serde::{Deserialize, Serialize};

pub use civil::Civil;
pub use offset::OffsetFilter;

/// Clock domain. Implemented only by empty marker types.
pub trait Clock: Copy + 'static {
    /// Name of the clock in messages and documents.
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
    /// Monotonic clock of the computer that runs this code.
    Host, HostTime = "host";
    /// Monotonic clock of the render server's computer. It stamps poses and images.
    Server, ServerTime = "server";
    /// Time since boot of the autopilot.
    Autopilot, AutopilotTime = "autopilot";
    /// Frame clock of the motion capture system.
    Mocap, MocapTime = "mocap";
}

/// Time stamp on the clock `C`, in nanoseconds.
#[derive(Serialize, Deserialize)]
#[serde(bound = "", transparent)]
pub struct Stamp<C> {
    ns: u64,
    #[serde(skip)]
    clock: PhantomData<fn() -> C>,
}

impl<C: Clock> Stamp<C> {
    /// Zero of the clock.
    pub const ZERO: Self = Self::from_ns(0);

    /// Returns the stamp of a number of nanoseconds on this clock. [ns]
    pub const fn from_ns(ns: u64) -> Self {
        Self { ns, clock: PhantomData }
    }

    /// Returns the nanoseconds on this clock. [ns]
    pub const fn as_ns(self) -> u64 {
        self.ns
    }

    /// Returns `self - earlier`, negative if `earlier` is later. [s]
    pub fn seconds_since(self, earlier: Self) -> f64 {
        // Wrapping keeps the sign for any two stamps less than 292 years apart.
        self.ns.wrapping_sub(earlier.ns).cast_signed() as f64 * 1e-9
    }

    /// Returns the stamp `seconds` later (earlier if negative), clamped to the clock's range. [s]
    pub fn plus_seconds(self, seconds: f64) -> Self {
        self.plus_ns((seconds * 1e9) as i64)
    }

    /// Returns the stamp `ns` later (earlier if negative), clamped to the clock's range. [ns]
    pub fn plus_ns(self, ns: i64) -> Self {
        Self::from_ns(self.ns.saturating_add_signed(ns))
    }
}

// Implemented by hand, because `derive` would require the same traits of the marker types.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_keep_their_sign() {
        let (a, b) = (HostTime::from_ns(5), HostTime::from_ns(1_000_000_005));
        assert_eq!(b.seconds_since(a), 1.0);
        assert_eq!(a.seconds_since(b), -1.0);
        assert_eq!(HostTime::ZERO.plus_seconds(-1.0), HostTime::ZERO);
    }
}
