//! Replacement for [`Live`] in a program built without the feature `foxglove`.

use std::net::SocketAddr;

use super::channels::{Channel, Description};

/// WebSocket server with the log's channels; not available in this build.
#[derive(Debug)]
pub enum Live {}

/// Error of a build without [`Live`].
#[derive(Debug, thiserror::Error)]
#[error(
    "this program was built without the feature foxglove; build it with `cargo build --release --features \
     foxglove`"
)]
pub struct Absent;

impl Live {
    /// Always fails.
    ///
    /// # Errors
    /// [`Absent`], with the build command.
    #[allow(clippy::unused_async)] // Why: same signature as the real one.
    pub async fn start(_: SocketAddr) -> Result<Self, Absent> {
        Err(Absent)
    }

    pub fn address(&self) -> SocketAddr {
        match *self {}
    }

    pub(super) fn offer(&mut self, _: Channel, _: &Description) {
        match *self {}
    }

    pub(super) fn send(&self, _: Channel, _: u64, _: &[u8]) {
        match *self {}
    }

    pub(super) fn stop(self) {
        match self {}
    }
}
