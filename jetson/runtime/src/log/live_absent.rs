//! What stands for [`Live`] in a program built without the feature `foxglove`: there is never one.

use std::net::SocketAddr;

use super::channels::{Channel, Description};

/// A WebSocket server with the log's channels; this build has none.
#[derive(Debug)]
pub enum Live {}

/// Why there is none.
#[derive(Debug, thiserror::Error)]
#[error(
    "this program was built without it; build it with `cargo build --release --features foxglove`"
)]
pub struct Absent;

impl Live {
    /// Always fails.
    ///
    /// # Errors
    /// [`Absent`]: how to build a program that can.
    #[allow(clippy::unused_async)] // Why: it stands for one that waits.
    pub async fn start(_: SocketAddr) -> Result<Self, Absent> {
        Err(Absent)
    }

    /// Returns where it listens.
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
