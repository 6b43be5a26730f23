//! The server's clock. The only place in this crate that reads a clock for stamps; everything else takes `now`.

use vizflyt_process::monotonic_ns;
use vizflyt_protocol::time::ServerTime;

/// Returns the present on the server's clock, CLOCK_MONOTONIC.
pub fn now() -> ServerTime {
    ServerTime::from_ns(monotonic_ns())
}
