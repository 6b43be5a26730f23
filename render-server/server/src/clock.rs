//! The server's clock: CLOCK_MONOTONIC, read as [`ServerTime`].
//!
//! The only place in this crate that reads a clock for stamps; everything else takes `now`.

use nix::time::{ClockId, clock_gettime};
use vizflyt_protocol::time::ServerTime;

/// Returns the present on the server's clock.
///
/// CLOCK_MONOTONIC never jumps when the wall clock is set, and is the same for every process of
/// one machine, so that a runtime on the same machine measures an offset of zero.
///
/// # Panics
/// Never on Linux: the clock always exists.
pub fn now() -> ServerTime {
    let time = clock_gettime(ClockId::CLOCK_MONOTONIC).expect("CLOCK_MONOTONIC exists");
    ServerTime::from_ns(time.tv_sec() as u64 * 1_000_000_000 + time.tv_nsec() as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_clock_never_runs_backwards() {
        let stamps: Vec<_> = (0..1000).map(|_| now()).collect();
        assert!(stamps.is_sorted());
        assert!(stamps[0].as_ns() > 0);
    }
}
