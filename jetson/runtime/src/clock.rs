//! The clock of what goes over the network: this computer's, as [`vizflyt_sdk::host_now`], but a test that holds tokio's
//! clock holds it, too.

use vizflyt_process::monotonic_ns;
use vizflyt_protocol::time::HostTime;

/// Returns the present on this computer's clock. [ns, host]
pub fn now() -> HostTime {
    HostTime::from_ns(monotonic_ns())
}
