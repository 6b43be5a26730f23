//! Images and messages between the runtime and one plugin process: sealed memory and a socket. No daemon, no copy
//! of pixels, and a plugin that dies at any instruction leaves the runtime undisturbed.
//!
//! ```text
//! runtime                                  plugin
//! RuntimeEnd ── slots: pixels ───────────▶ PluginEnd   60 Hz and more; the plugin cannot write them
//!            ── board: the newest slot ──▶             newest wins
//!            ◀─ board: slots given back ──
//!            ── bell ────────────────────▶             rings for each observation, 0.05 ms
//!            ◀─ socket: messages ────────▶             start, events, stop; ready, replies, failure; never lost
//! ```
//! Slots and board are memory that neither side can resize ([`sealed`]): a plugin that truncated what the runtime has
//! mapped would kill it. Everything is handed over by descriptor; nothing has a name that another process could
//! open, and two flights on one computer never meet.
//!
//! The runtime starts a plugin with its end of the socket open ([`RuntimeEnd::connect`]) and says which descriptor that is:
//! `--vizflyt-service fd:N`. A plugin that a person starts finds the runtime by an [`Offer`]: a socket in a folder
//! of the user's own, `--vizflyt-service PATH`.
//!
//! Either side notices the other's end at once: the socket closes. No clock is involved; a runtime that is stopped
//! for an hour is still there.

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

/// The command line option that says where the runtime is.
pub const SERVICE_OPTION: &str = "--vizflyt-service";

/// Observations that a plugin may borrow at once: the one of the call, one that it keeps from call to
/// call, and room to receive a third.
pub const BORROWED_OBSERVATIONS: usize = 3;

/// Observations that the runtime writes at once: one, and another while the first is laid out again.
const LENT_OBSERVATIONS: usize = 2;
/// Those and the borrowed ones, and the newest, which nobody has taken yet.
const SLOTS: usize = BORROWED_OBSERVATIONS + LENT_OBSERVATIONS + 1;

/// Why the other side cannot be reached.
#[derive(Debug, thiserror::Error)]
pub enum IpcError {
    /// Nobody is there.
    #[error("no runtime offers {0}; start the plugin with `vizflyt fly`")]
    NoRuntime(String),
    /// The two sides were built from different protocols.
    #[error(transparent)]
    Version(PreambleError),
    /// The socket is full: the other side does not read.
    #[error("the {0} does not read its messages")]
    QueueFull(&'static str),
    /// The other side has closed the socket, or has died.
    #[error("the {0} is gone")]
    Gone(&'static str),
    /// All slots are in use.
    #[error("{0} observations are in use already: drop one before taking another")]
    NoSlot(usize),
    /// A message does not decode.
    #[error("the socket holds no message: {0}")]
    Message(FramingError),
    /// The system refuses something.
    #[error("{what} failed")]
    System {
        /// What was tried.
        what: &'static str,
        /// The system's reason.
        source: io::Error,
    },
}

impl From<FramingError> for IpcError {
    fn from(error: FramingError) -> Self {
        Self::Message(error)
    }
}

impl IpcError {
    /// Returns the conversion of a system error met while trying `what`.
    fn system<E: Into<io::Error>>(what: &'static str) -> impl FnOnce(E) -> Self {
        move |source| Self::System { what, source: source.into() }
    }
}
