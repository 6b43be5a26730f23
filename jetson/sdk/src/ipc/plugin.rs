//! The plugin's end: opens the services that the runtime made.

use std::time::Duration;

use iceoryx2::node::Node;
use iceoryx2::port::BackpressureAction;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::PortFactory;
use iceoryx2::sample::Sample;
use iceoryx2::service::builder::event::EventOpenError;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError;
use vizflyt_protocol::PROTOCOL_VERSION;
use vizflyt_protocol::messages::{FromPlugin, ToPlugin};
use vizflyt_protocol::packet::PreambleError;
use vizflyt_protocol::packet::framing::{self, MAX_FRAMED};

use super::{Ipc, IpcError, PROTOCOL_KEY, name, node, receive, send_bytes, slices, wait};

/// The plugin's end of the shared memory.
#[derive(Debug)]
pub struct PluginEnd {
    observations: Subscriber<Ipc, [u8], ()>,
    from_plugin: Publisher<Ipc, [u8], ()>,
    wake_runtime: Notifier<Ipc>,
    wake_plugin: Listener<Ipc>,
    to_plugin: Subscriber<Ipc, [u8], ()>,
    // Last, so that ports go before the node they belong to.
    _node: Node<Ipc>,
}

/// An observation in shared memory; as long as it lives, the runtime does not reuse the memory.
#[derive(Debug)]
pub struct ObservationSample(Sample<Ipc, [u8], ()>);

impl PluginEnd {
    /// Attaches to the runtime that made `prefix`.
    ///
    /// # Errors
    /// [`IpcError::NoRuntime`] if there is none, [`IpcError::Version`] if it speaks another
    /// protocol, [`IpcError::Transport`] if another plugin is attached.
    pub fn open(prefix: &str) -> Result<Self, IpcError> {
        let node = node()?;
        let port = "attaching";
        let open = |suffix| {
            slices(&node, prefix, suffix)?.open().map_err(|error| match error {
                PublishSubscribeOpenError::DoesNotExist => IpcError::NoRuntime(prefix.to_owned()),
                error => IpcError::transport("opening a service")(error),
            })
        };
        let event = |suffix| {
            let builder = node.service_builder(&name(prefix, suffix)?).event();
            builder.open().map_err(|error| match error {
                EventOpenError::DoesNotExist => IpcError::NoRuntime(prefix.to_owned()),
                error => IpcError::transport("opening a service")(error),
            })
        };

        let observation_service = open("observation")?;
        let key = PROTOCOL_KEY.try_into().map_err(IpcError::transport("opening a service"))?;
        let version = observation_service.attributes().key_value(&key, 0);
        check_version(version.and_then(|value| value.to_string().parse().ok()).unwrap_or(0))?;

        let observations =
            observation_service.subscriber_builder().create().map_err(IpcError::transport(port))?;
        let from_plugin = open("from_plugin")?
            .publisher_builder()
            .initial_max_slice_len(MAX_FRAMED)
            // The runtime reads within milliseconds; after a second it is gone or stopped.
            .set_backpressure_handler(|info| {
                if info.elapsed_time < Duration::from_secs(1) {
                    BackpressureAction::Retry
                } else {
                    BackpressureAction::DiscardDataAndFail
                }
            })
            .create()
            .map_err(IpcError::transport(port))?;
        let wake_runtime = event("wake_runtime")?
            .notifier_builder()
            .create()
            .map_err(IpcError::transport(port))?;
        let wake_plugin =
            event("wake_plugin")?.listener_builder().create().map_err(IpcError::transport(port))?;
        // Last: its presence shows the runtime that the plugin is complete.
        let to_plugin =
            open("to_plugin")?.subscriber_builder().create().map_err(IpcError::transport(port))?;
        Ok(Self { observations, from_plugin, wake_runtime, wake_plugin, to_plugin, _node: node })
    }

    /// Waits until the runtime notifies, `timeout` at most; returns whether it did.
    pub fn wait(&self, timeout: Duration) -> Result<bool, IpcError> {
        wait(&self.wake_plugin, timeout)
    }

    /// Takes the runtime's next message.
    pub fn receive(&self) -> Result<Option<ToPlugin>, IpcError> {
        receive(&self.to_plugin)
    }

    /// Takes the newest observation, if there is one not taken yet.
    pub fn observation(&self) -> Result<Option<ObservationSample>, IpcError> {
        let sample = self.observations.receive().map_err(IpcError::transport("receiving"))?;
        Ok(sample.map(ObservationSample))
    }

    /// Sends a message and wakes the runtime.
    ///
    /// # Errors
    /// [`IpcError::QueueFull`] if the runtime has not read for a second.
    pub fn send(&self, message: &FromPlugin) -> Result<(), IpcError> {
        let mut buffer = [0; MAX_FRAMED];
        self.send_bytes(framing::encode_body(message, &mut buffer))
    }

    /// Sends bytes as they are, and wakes the runtime: for plugins in other languages that encode
    /// messages themselves, and to test what a runtime makes of nonsense.
    ///
    /// # Errors
    /// As [`Self::send`].
    pub fn send_bytes(&self, body: &[u8]) -> Result<(), IpcError> {
        send_bytes(&self.from_plugin, body, "runtime")?;
        self.wake_runtime.notify().map_err(IpcError::transport("waking the runtime"))?;
        Ok(())
    }
}

impl ObservationSample {
    /// Returns the bytes, in the layout of [`vizflyt_protocol::packet::ObservationHeader`].
    pub fn bytes(&self) -> &[u8] {
        self.0.payload()
    }
}

/// Compares the runtime's protocol with ours.
fn check_version(theirs: u16) -> Result<(), IpcError> {
    if theirs == PROTOCOL_VERSION {
        return Ok(());
    }
    let (them, me) = ("runtime", "plugin");
    let older = if theirs < PROTOCOL_VERSION { them } else { me };
    let error = PreambleError::Version { them, theirs, me, ours: PROTOCOL_VERSION, older };
    Err(IpcError::Version(error))
}
