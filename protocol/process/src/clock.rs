//! CLOCK_MONOTONIC, which tests can pause. It follows tokio's clock, which is the system's, except in tests that pause
//! it. There, minutes of traffic pass in seconds, and time stamps must follow.

use std::sync::OnceLock;
use std::time::Instant;

use nix::time::{ClockId, clock_gettime};

/// Returns the current time of CLOCK_MONOTONIC. [ns]
///
/// The clock does not jump if the wall clock is set. It is the same for all processes of a machine, so that a runtime
/// on the server's machine measures an offset of zero.
pub fn monotonic_ns() -> u64 {
    static ANCHOR: OnceLock<(Instant, u64)> = OnceLock::new();
    let (instant, ns) = *ANCHOR.get_or_init(anchor);
    // `Instant` is also CLOCK_MONOTONIC, but does not expose its value.
    let present = tokio::time::Instant::now().into_std();
    match present.checked_duration_since(instant) {
        Some(since) => ns + since.as_nanos() as u64,
        // The clock was paused before its first use here.
        None => ns - (instant - present).as_nanos() as u64,
    }
}

/// Returns an instant and its value on CLOCK_MONOTONIC. Of several readings, the shortest is used, because it was not
/// interrupted. [ns]
///
/// # Panics
/// Never on Linux: the clock always exists.
/// Never on Linux: the clock always exists.
fn anchor() -> (Instant, u64) {
    let read = || {
        let before = Instant::now();
        let time = clock_gettime(ClockId::CLOCK_MONOTONIC).expect("CLOCK_MONOTONIC exists");
        let took = before.elapsed();
        (took, (before + took / 2, time.tv_sec() as u64 * 1_000_000_000 + time.tv_nsec() as u64))
    };
    let first = read();
    let quickest = |best, next| std::cmp::min_by_key(best, next, |(took, _)| *took);
    std::iter::repeat_with(read).take(8).fold(first, quickest).1
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn never_runs_backwards() {
        let stamps: Vec<_> = (0..1000).map(|_| monotonic_ns()).collect();
        assert!(stamps.is_sorted());
        assert!(stamps[0] > 0);
    }

    #[test]
    fn matches_the_machines_clock() {
        let system = || {
            let time = clock_gettime(ClockId::CLOCK_MONOTONIC).unwrap();
            time.tv_sec() as u64 * 1_000_000_000 + time.tv_nsec() as u64
        };
        // A reading lies between its neighbours, even if interrupted. One microsecond allows for the anchor's error.
        for _ in 0..1000 {
            let (before, found, after) = (system(), monotonic_ns(), system());
            assert!((before - 1000..=after + 1000).contains(&found), "{before} {found} {after}");
        }
    }

    #[test]
    fn follows_tokios_paused_clock() {
        let runtime =
            tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build();
        runtime.unwrap().block_on(async {
            let before = monotonic_ns();
            assert_eq!(monotonic_ns(), before);
            tokio::time::advance(Duration::from_mins(10)).await;
            assert_eq!(monotonic_ns() - before, 600_000_000_000);
        });
    }
}
