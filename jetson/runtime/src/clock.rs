//! Clock for everything that goes over the network: this computer's monotonic clock, as [`vizflyt_sdk::host_now`]. In
//! tests with a paused tokio clock it stops, too.

use vizflyt_process::monotonic_ns;
use vizflyt_protocol::time::HostTime;

/// Returns the current time of this computer's clock. [ns, host]
pub fn now() -> HostTime {
    HostTime::from_ns(monotonic_ns())
}
