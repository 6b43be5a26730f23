//! Clock of the server. Stamps come only from here; all other code takes `now` as an argument.

use vizflyt_process::monotonic_ns;
use vizflyt_protocol::time::ServerTime;

/// Returns the current time on the server's clock, CLOCK_MONOTONIC.
pub fn now() -> ServerTime {
    ServerTime::from_ns(monotonic_ns())
}
