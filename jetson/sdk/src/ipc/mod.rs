//! Shared memory between the runtime and one plugin process, over iceoryx2. No daemon, no copy
//! of pixels, and a plugin that dies at any instruction leaves the runtime undisturbed.
//!
//! ```text
//! runtime                                       plugin
//! RuntimeEnd ── PREFIX/observation ──────────▶ PluginEnd   newest wins, 60 Hz and more
//!            ── PREFIX/to_plugin ────────────▶             start, events, stop; never lost
//!            ◀─ PREFIX/from_plugin ──────────              ready, answers, failure; never lost
//!            ── PREFIX/wake_plugin ──────────▶             wakes within 0.1 ms; also a heartbeat
//!            ◀─ PREFIX/wake_runtime ─────────
//! ```
//! The runtime creates the services under a prefix of its own and hands it to the plugin as
//! `--vizflyt-service PREFIX`, so that two flights on one computer never meet.

mod offer;
mod plugin;
mod runtime;
#[cfg(test)]
mod tests;

use std::fmt::Debug;
use std::time::Duration;

use iceoryx2::node::Node;
use iceoryx2::port::SendError;
use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::{
    Alignment, Config, FileName, LogLevel, NodeBuilder, Path, SemanticString, ServiceName,
    SignalHandlingMode, ipc_threadsafe, set_log_level,
};
use iceoryx2::service::builder::publish_subscribe::Builder as PubSubBuilder;
use nix::unistd::Uid;
use serde::Serialize;
use serde::de::DeserializeOwned;
use vizflyt_protocol::packet::framing::{self, MAX_FRAMED};
use vizflyt_protocol::packet::{PLANE_ALIGN, PreambleError};

pub use offer::{Offer, offers};
pub use plugin::{ObservationSample, PluginEnd};
pub use runtime::{LoanedObservation, RuntimeEnd};

/// The command line option that carries the prefix.
pub const SERVICE_OPTION: &str = "--vizflyt-service";

/// Why shared memory cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum IpcError {
    /// Nobody offers the services.
    #[error("no runtime offers {0}; start the plugin with `vizflyt fly`")]
    NoRuntime(String),
    /// The two sides were built from different protocols.
    #[error(transparent)]
    Version(PreambleError),
    /// A queue that must not lose is full: the other side does not read.
    #[error("the {0} does not read its messages: {QUEUE_DEPTH} are waiting")]
    QueueFull(&'static str),
    /// A message does not decode.
    #[error("shared memory holds no message: {0}")]
    Message(#[from] vizflyt_protocol::packet::framing::FramingError),
    /// The transport failed.
    #[error("shared memory: {what} failed: {why}")]
    Transport {
        /// What was tried.
        what: &'static str,
        /// iceoryx2's reason.
        why: String,
    },
}

impl IpcError {
    /// Returns the conversion of an iceoryx2 error met while trying `what`.
    fn transport<E: Debug>(what: &'static str) -> impl FnOnce(E) -> Self {
        move |why| Self::Transport { what, why: format!("{why:?}") }
    }
}

/// Returns a prefix that no other flight on this computer uses.
pub fn unique_service() -> String {
    format!("vizflyt/{}-{:x}", std::process::id(), crate::host_now().as_ns())
}

// `ipc_threadsafe`: ports may be used from several threads; its lock is uncontended here.
type Ipc = ipc_threadsafe::Service;

/// Messages that wait in a queue at most. A plugin that leaves as many events unread is hung.
const QUEUE_DEPTH: usize = 128;
/// Observations that a plugin may borrow at once: the one of the call, one that it keeps from call to
/// call, and room to receive a third.
pub const BORROWED_OBSERVATIONS: usize = 3;
/// Attribute of the observation service that carries the protocol version.
const PROTOCOL_KEY: &str = "vizflyt_protocol";

/// Returns the folder of this user's runtimes and plugins.
fn user_folder() -> String {
    format!("/tmp/vizflyt-{}/", acting_user())
}

/// Files of iceoryx2 live under a folder and a prefix of the user's own, so that users never trip
/// over each other's permissions. All flights of one user share them, so that the next one
/// reclaims what a killed one left behind. Where a plugin runs as another user than the runtime, they
/// are that user's.
fn config() -> Result<Config, IpcError> {
    let mut config = Config::default();
    let user = acting_user();
    let root = user_folder();
    let root = Path::new(root.as_bytes()).map_err(IpcError::transport("naming its folder"))?;
    config.global.set_root_path(&root);
    let prefix = format!("vizflyt{user}_");
    config.global.prefix =
        FileName::new(prefix.as_bytes()).map_err(IpcError::transport("naming its files"))?;
    Ok(config)
}

/// Returns whom this thread makes files as: the user it runs as, or the plugin's, see
/// [`RuntimeEnd::create_for`].
fn acting_user() -> Uid {
    // The largest number is no user: nothing is changed, and the present one returned.
    nix::unistd::setfsuid(Uid::from_raw(u32::MAX))
}

/// Until dropped, this thread makes and opens files as another user (setfsuid(2)).
struct Acting {
    former: Uid,
}

impl Acting {
    fn as_user(user: Option<Uid>) -> Option<Self> {
        user.map(|user| Self { former: nix::unistd::setfsuid(user) })
    }
}

impl Drop for Acting {
    fn drop(&mut self) {
        nix::unistd::setfsuid(self.former);
    }
}

/// Makes a node. Dead nodes of former flights are cleaned up on the way.
fn node() -> Result<Node<Ipc>, IpcError> {
    // Why: iceoryx2 reports to stderr what we return as errors anyway.
    set_log_level(LogLevel::Fatal);
    NodeBuilder::new()
        .config(&config()?)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<Ipc>()
        .map_err(IpcError::transport("joining"))
}

fn name(prefix: &str, suffix: &str) -> Result<ServiceName, IpcError> {
    ServiceName::new(&format!("{prefix}/{suffix}")).map_err(IpcError::transport("naming a service"))
}

fn alignment() -> Alignment {
    Alignment::new(PLANE_ALIGN).expect("PLANE_ALIGN is a power of two")
}

type SliceBuilder = PubSubBuilder<[u8], (), Ipc>;

/// The service as both sides name it; whoever creates it adds the settings.
fn slices(node: &Node<Ipc>, prefix: &str, suffix: &str) -> Result<SliceBuilder, IpcError> {
    let builder = node.service_builder(&name(prefix, suffix)?).publish_subscribe::<[u8]>();
    Ok(builder.payload_alignment(alignment()))
}

/// Sends one message over a queue; an error if it is full.
fn send<M: Serialize>(
    queue: &Publisher<Ipc, [u8], ()>,
    message: &M,
    reader: &'static str,
) -> Result<(), IpcError> {
    let mut buffer = [0; MAX_FRAMED];
    send_bytes(queue, framing::encode_body(message, &mut buffer), reader)
}

fn send_bytes(
    queue: &Publisher<Ipc, [u8], ()>,
    body: &[u8],
    reader: &'static str,
) -> Result<(), IpcError> {
    let sample = queue.loan_slice_uninit(body.len()).map_err(IpcError::transport("sending"))?;
    match sample.write_from_slice(body).send() {
        Ok(_) => Ok(()),
        Err(SendError::UnableToDeliver) => Err(IpcError::QueueFull(reader)),
        Err(error) => Err(IpcError::transport("sending")(error)),
    }
}

/// Takes the next message off a queue.
fn receive<M: DeserializeOwned>(queue: &Subscriber<Ipc, [u8], ()>) -> Result<Option<M>, IpcError> {
    match queue.receive().map_err(IpcError::transport("receiving"))? {
        Some(sample) => Ok(Some(framing::decode_body(sample.payload())?)),
        None => Ok(None),
    }
}

/// Waits until the other side notifies, `timeout` at most; returns whether it did. Notifications
/// that came before count, so none is missed between looking and waiting.
fn wait(listener: &Listener<Ipc>, timeout: Duration) -> Result<bool, IpcError> {
    match listener.timed_wait(|_| (), timeout) {
        Ok(woken) => Ok(woken > 0),
        // A signal, as Ctrl-C, is for whoever handles it.
        Err(ListenerWaitError::InterruptSignal) => Ok(false),
        Err(error) => Err(IpcError::transport("waiting")(error)),
    }
}
