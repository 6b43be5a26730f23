//! Clock offset estimation from request-reply exchanges: offset, drift, and an error bound.
//!
//! An exchange shows that the remote clock was at `remote` at some time between `sent` and `received`. Because clocks
//! run forward, the offset (remote minus local) was at most `remote - sent` when the request was sent, and at least
//! `remote - received` when the reply was read. Over a window of exchanges, these are half-planes in (offset, drift).
//! The truth lies in their intersection, and its middle is the estimate. Delays need not be symmetric, and a slow
//! exchange does no harm: its bounds are only wide.
//!
//! The bound rests on two assumptions: two clocks drift by at most [`MAX_DRIFT`], and over the window the drift changes
//! by at most [`WANDER`]. Exchanges that contradict each other prove a step (a restart, a suspended computer). Then
//! only the newest one is used.

#[cfg(test)]
mod tests;

use core::marker::PhantomData;

use super::{Clock, Stamp};

/// Estimate of the offset between a remote and a local clock. See the module.
#[derive(Clone, Copy, Debug)]
pub struct OffsetFilter<Local, Remote> {
    window: [Exchange; WINDOW],
    filled: usize,
    next: usize,
    fit: Option<Fit>,
    steps: u64,
    clocks: PhantomData<fn() -> (Local, Remote)>,
}

/// One exchange. [ns]
#[derive(Clone, Copy, Debug, Default)]
struct Exchange {
    sent_ns: u64,
    remote_ns: u64,
    received_ns: u64,
}

/// Estimate from the window.
#[derive(Clone, Copy, Debug)]
struct Fit {
    /// Local time for which the offset is valid: the end of the newest exchange. [ns, local]
    at_ns: u64,
    /// Remote minus local time. [ns]
    offset_ns: i64,
    /// Bound of the offset's error at that time. [ns]
    error_ns: f64,
    /// Relative rate difference, positive if the remote clock runs faster.
    drift: f64,
    /// Bound of the drift's error.
    drift_error: f64,
}

/// Number of stored exchanges: about one minute at one per second, 1.5 KB. Twice the window would halve the error of
/// the drift, but the drift itself changes by as much in that time.
const WINDOW: usize = 64;
/// Maximum drift between two clocks. Crystals are accurate to 50 ppm or better, so two clocks differ by at most 100
/// ppm, and time services that slew slowly add as much.
const MAX_DRIFT: f64 = 200e-6;
/// Maximum deviation of the drift from its mean over the window. A crystal that warms by 5 degrees, as the computer
/// gets busy, changes by about 1 ppm.
const WANDER: f64 = 1e-6;
/// Resolution of a clock that counts microseconds, as ArduPilot's does. [ns]
const GRAIN_NS: f64 = 1_000.0;

impl<Local: Clock, Remote: Clock> Default for OffsetFilter<Local, Remote> {
    fn default() -> Self {
        Self {
            window: [Exchange::default(); WINDOW],
            filled: 0,
            next: 0,
            fit: None,
            steps: 0,
            clocks: PhantomData,
        }
    }
}

impl<Local: Clock, Remote: Clock> OffsetFilter<Local, Remote> {
    /// Adds one exchange: request sent at `sent`, answered by the remote at `remote`, reply read at `received`. An
    /// exchange that ends before it began is dropped.
    pub fn update(&mut self, sent: Stamp<Local>, remote: Stamp<Remote>, received: Stamp<Local>) {
        if received < sent {
            return;
        }
        let newest = Exchange {
            sent_ns: sent.as_ns(),
            remote_ns: remote.as_ns(),
            received_ns: received.as_ns(),
        };
        self.window[self.next] = newest;
        self.next = (self.next + 1) % WINDOW;
        self.filled = (self.filled + 1).min(WINDOW);
        self.fit = fit(&self.window[..self.filled], newest);
        if self.fit.is_none() {
            self.steps += 1;
            (self.window[0], self.filled, self.next) = (newest, 1, 1);
            self.fit = fit(&self.window[..1], newest);
        }
    }

    /// Returns the offset to add to local time at `at` to get remote time; `None` before the first exchange. [ns]
    pub fn offset_ns(&self, at: Stamp<Local>) -> Option<i64> {
        let fit = self.fit?;
        let drifted_ns = fit.drift * since(at.as_ns(), fit.at_ns);
        Some(fit.offset_ns.wrapping_add(libm::round(drifted_ns) as i64))
    }

    /// Returns the bound of the offset's error at `at`; `None` before the first exchange. With regular exchanges, it is
    /// about half the shortest round trip. During a silence it grows with the uncertainty of the drift. [ns]
    pub fn error_bound_ns(&self, at: Stamp<Local>) -> Option<u64> {
        let fit = self.fit?;
        let away_ns = since(at.as_ns(), fit.at_ns).abs();
        // For rounding of this value and of the offset.
        Some((fit.error_ns + fit.drift_error * away_ns) as u64 + 2)
    }

    /// Returns the drift (positive if the remote clock runs faster) and the bound of its error; `None` before the first
    /// exchange. [ppm]
    pub fn drift_ppm(&self) -> Option<(f64, f64)> {
        self.fit.map(|fit| (fit.drift * 1e6, fit.drift_error * 1e6))
    }

    /// Returns the number of times that exchanges contradicted each other: a clock was set or restarted.
    pub fn steps(&self) -> u64 {
        self.steps
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
        let fit = self.fit?;
        let then_ns = fit.at_ns.wrapping_add(fit.offset_ns as u64);
        let drifted_ns = since(remote.as_ns(), then_ns) * (fit.drift / (1.0 + fit.drift));
        let offset_ns = fit.offset_ns.wrapping_add(libm::round(drifted_ns) as i64);
        Some(Stamp::from_ns(remote.as_ns().wrapping_sub(offset_ns as u64)))
    }

    /// Converts a local stamp to the remote clock; `None` before the first exchange.
    pub fn to_remote(&self, local: Stamp<Local>) -> Option<Stamp<Remote>> {
        let offset_ns = self.offset_ns(local)?;
        Some(Stamp::from_ns(local.as_ns().wrapping_add(offset_ns as u64)))
    }
}

/// Returns `a - b` of two stamps of one clock less than 292 years apart. [ns]
fn since(a: u64, b: u64) -> f64 {
    a.wrapping_sub(b).cast_signed() as f64
}

/// Bounds on the offset from one exchange: at most `above` at `sent`, at least `below` at `received`; all relative to
/// the newest exchange. [ns]
#[derive(Clone, Copy, Default)]
struct Bounds {
    sent: f64,
    above: f64,
    received: f64,
    below: f64,
}

/// Returns the middle of the intersection of all bounds; `None` if it is empty.
fn fit(window: &[Exchange], newest: Exchange) -> Option<Fit> {
    let base_ns = newest.remote_ns.wrapping_sub(newest.sent_ns);
    let mut storage = [Bounds::default(); WINDOW];
    let bounds = &mut storage[..window.len()];
    for (bounds, e) in bounds.iter_mut().zip(window) {
        *bounds = Bounds {
            sent: since(e.sent_ns, newest.sent_ns),
            above: since(e.remote_ns.wrapping_sub(e.sent_ns), base_ns) + GRAIN_NS,
            received: since(e.received_ns, newest.sent_ns),
            below: since(e.remote_ns.wrapping_sub(e.received_ns), base_ns) - GRAIN_NS,
        };
    }
    // Mean drift between each pair of exchanges; with 64 exchanges, 4096 pairs per second.
    let (mut least, mut most) = (-MAX_DRIFT, MAX_DRIFT);
    for later in &*bounds {
        for earlier in &*bounds {
            let span = later.received - earlier.sent;
            if span > 0.0 {
                least = least.max((later.below - earlier.above) / span - WANDER);
            }
            let span = later.sent - earlier.received;
            if span > 0.0 {
                most = most.min((later.above - earlier.below) / span + WANDER);
            }
        }
    }
    if !(least <= most) {
        return None;
    }
    // From each exchange to the end of the newest: `span` is positive, or negative if replies overtook each other.
    let at = since(newest.received_ns, newest.sent_ns);
    let (slow, fast) = (least - WANDER, most + WANDER);
    let (mut low, mut high) = (f64::NEG_INFINITY, f64::INFINITY);
    for b in &*bounds {
        let span = at - b.sent;
        high = high.min(b.above + span * if span >= 0.0 { fast } else { slow });
        let span = at - b.received;
        low = low.max(b.below + span * if span >= 0.0 { slow } else { fast });
    }
    if !(low <= high) {
        return None;
    }
    Some(Fit {
        at_ns: newest.received_ns,
        offset_ns: base_ns.cast_signed().wrapping_add(libm::round(0.5 * (low + high)) as i64),
        error_ns: 0.5 * (high - low),
        drift: 0.5 * (least + most),
        drift_error: 0.5 * (most - least) + WANDER,
    })
}
