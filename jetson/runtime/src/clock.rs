//! The clock of what goes over the network: this computer's, as [`vizflyt_sdk::host_now`], but
//! following tokio's, so that a test that holds that clock holds the stamps of the stream too.

use std::sync::OnceLock;
use std::time::Instant;

use vizflyt_protocol::time::HostTime;
use vizflyt_sdk::host_now;

/// Returns the present on this computer's clock. [ns, host]
pub fn now() -> HostTime {
    static ANCHOR: OnceLock<(Instant, HostTime)> = OnceLock::new();
    let (instant, host) = *ANCHOR.get_or_init(anchor);
    let present = tokio::time::Instant::now().into_std();
    host.plus_ns(match present.checked_duration_since(instant) {
        Some(since) => since.as_nanos() as i64,
        // A clock that was held before it was first read here.
        None => -((instant - present).as_nanos() as i64),
    })
}

/// Returns an instant and its stamp, to within the time of one reading: of a few tries that which
/// nothing interrupted.
fn anchor() -> (Instant, HostTime) {
    let read = || {
        let before = Instant::now();
        let host = host_now();
        let took = before.elapsed();
        (took, (before + took / 2, host))
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
    fn matches_the_computers_clock() {
        // Interrupted anywhere, a reading lies between its neighbours; a microsecond covers the
        // anchor's own error.
        for _ in 0..1000 {
            let (before, found, after) = (host_now(), now(), host_now());
            assert!(found.plus_ns(1000) >= before && found <= after.plus_ns(1000));
        }
    }

    #[test]
    fn follows_tokios_paused_clock() {
        let runtime =
            tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build();
        runtime.unwrap().block_on(async {
            let before = now();
            assert_eq!(now(), before);
            tokio::time::advance(Duration::from_mins(10)).await;
            assert_eq!(now().seconds_since(before), 600.0);
        });
    }
}
