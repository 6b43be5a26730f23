//! Images and messages between the runtime and one plugin process, over sealed memory and a socket. This
//! needs no daemon and no copy of pixels, and a plugin that dies at any instruction does not affect the runtime.
//!
//! ```text
//! runtime                                  plugin
//! RuntimeEnd ── slots: pixels ───────────▶ PluginEnd   60 Hz and more; read-only for the plugin
//!            ── board: the newest slot ──▶             newest wins
//!            ◀─ board: returned slots ────
//!            ── bell ────────────────────▶             rings for each observation, 0.05 ms
//!            ◀─ socket: messages ────────▶             start, events, stop; ready, replies, failure; never lost
//! ```
//! Slots and board are memory that neither side can resize ([`sealed`]): if a plugin truncated memory that the runtime
//! has mapped, the next access would kill the runtime. Both are passed as descriptors. They have no name that another
//! process could open, so two flights on one computer cannot interfere.
//!
//! The runtime starts a plugin with the plugin's end of the socket open ([`RuntimeEnd::connect`]) and passes the number
//! of the descriptor: `--vizflyt-service fd:N`. A plugin started by hand finds the runtime by an [`Offer`]: a socket in
//! a folder owned by the user, `--vizflyt-service PATH`.
//!
//! Each side notices at once that the other has ended, because the socket closes. Without a timeout, a runtime
//! that is stopped for an hour still counts as present.

mod board;
mod offer;
mod plugin;
mod runtime;
mod sealed;
mod socket;
#[cfg(test)]
mod tests;

use std::io;

use vizflyt_protocol::packet::PreambleError;
use vizflyt_protocol::packet::framing::FramingError;

pub use offer::{Offer, offers};
pub use plugin::{ObservationSample, PluginEnd};
pub use runtime::{LoanedObservation, PluginSocket, RuntimeEnd};

/// Command line option with the address of the runtime.
pub const SERVICE_OPTION: &str = "--vizflyt-service";

/// Maximum number of observations that a plugin may borrow: the one of the current call, one kept between calls, and
/// space to receive a third.
pub const BORROWED_OBSERVATIONS: usize = 3;

/// Maximum number of observations that the runtime writes at the same time: one, and a second one while the first gets
/// a new layout.
const LENT_OBSERVATIONS: usize = 2;
/// Lent and borrowed observations, and the newest, which is not taken yet.
const SLOTS: usize = BORROWED_OBSERVATIONS + LENT_OBSERVATIONS + 1;

/// Error of the connection to the other side.
#[derive(Debug, thiserror::Error)]
pub enum IpcError {
    /// No runtime listens at the address, or it already has a plugin.
    #[error("no runtime offers {0}; start the plugin with `vizflyt fly`")]
    NoRuntime(String),
    /// The two sides use different protocol versions.
    #[error(transparent)]
    Version(PreambleError),
    /// The socket is full: the other side does not read.
    #[error("the {0} does not read its messages")]
    QueueFull(&'static str),
    /// The other side has closed the socket, or has died.
    #[error("the {0} is gone")]
    Gone(&'static str),
    /// The maximum number of observations is in use.
    #[error("{0} observations are in use already: drop one before taking another")]
    NoSlot(usize),
    /// A message does not decode.
    #[error("invalid message on the socket: {0}")]
    Message(FramingError),
    /// A system call failed.
    #[error("{what} failed")]
    System {
        /// The failed action.
        what: &'static str,
        /// Error of the system.
        source: io::Error,
    },
}

impl From<FramingError> for IpcError {
    fn from(error: FramingError) -> Self {
        Self::Message(error)
    }
}

impl IpcError {
    /// Returns a function that converts a system error during `what`.
    fn system<E: Into<io::Error>>(what: &'static str) -> impl FnOnce(E) -> Self {
        move |source| Self::System { what, source: source.into() }
    }
}
