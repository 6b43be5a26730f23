//! Monotonic clock of the computer.

use nix::time::{ClockId, clock_gettime};
use vizflyt_protocol::time::HostTime;

/// Returns the time on this computer's monotonic clock (`CLOCK_MONOTONIC`), which all its processes share. [ns, host]
///
/// # Panics
/// Never on Linux, where this clock always exists.
pub fn host_now() -> HostTime {
    let now = clock_gettime(ClockId::CLOCK_MONOTONIC).expect("Linux has a monotonic clock");
    HostTime::from_ns(now.tv_sec() as u64 * 1_000_000_000 + now.tv_nsec() as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clock_is_monotonic() {
        let (first, second) = (host_now(), host_now());
        assert!(second >= first && first > HostTime::ZERO);
    }
}
