//! The runtime's end: creates the services, publishes observations, reads answers.

use std::time::Duration;

use iceoryx2::node::Node;
use iceoryx2::port::BackpressureAction;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::{AllocationStrategy, AttributeSpecifier, PortFactory as _};
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use nix::unistd::Uid;
use vizflyt_protocol::PROTOCOL_VERSION;
use vizflyt_protocol::messages::{FromPlugin, ToPlugin};
use vizflyt_protocol::packet::framing::MAX_FRAMED;

use super::{
    Acting, BORROWED_OBSERVATIONS, Ipc, IpcError, PROTOCOL_KEY, QUEUE_DEPTH, name, node, receive,
    send, slices, wait,
};

/// The runtime's end of the shared memory. All calls return at once, but for [`Self::wait`]; a
/// plugin that hangs never blocks them.
#[derive(Debug)]
pub struct RuntimeEnd {
    observations: Publisher<Ipc, [u8], ()>,
    to_plugin: Publisher<Ipc, [u8], ()>,
    from_plugin: Subscriber<Ipc, [u8], ()>,
    wake_plugin: Notifier<Ipc>,
    wake_runtime: Listener<Ipc>,
    to_plugin_service: PortFactory<Ipc, [u8], ()>,
    /// Whose the files are, if not ours.
    owner: Option<Uid>,
    // Last, so that ports go before the node they belong to.
    node: Node<Ipc>,
}

/// Shared memory for one observation, to be written and then published. Dropped unpublished, it
/// goes back to the pool.
#[derive(Debug)]
pub struct LoanedObservation(SampleMut<Ipc, [u8], ()>);

impl RuntimeEnd {
    /// Creates the services under `prefix`, with room for observations of `observation_len` bytes
    /// to start with.
    ///
    /// # Errors
    /// [`IpcError::Transport`], as when shared memory is full or the prefix is in use.
    pub fn create(prefix: &str, observation_len: usize) -> Result<Self, IpcError> {
        Self::create_for(prefix, observation_len, None)
    }

    /// As [`Self::create`], for a plugin that runs as the user `owner`; only root can.
    ///
    /// # Errors
    /// As [`Self::create`].
    pub fn create_for(
        prefix: &str,
        observation_len: usize,
        owner: Option<u32>,
    ) -> Result<Self, IpcError> {
        let owner = owner.map(Uid::from_raw);
        let _acting = Acting::as_user(owner);
        let node = node()?;
        let creating = "creating a service";
        let port = "creating a port";

        let version = AttributeSpecifier::new()
            .define(
                &PROTOCOL_KEY.try_into().map_err(IpcError::transport(creating))?,
                &PROTOCOL_VERSION
                    .to_string()
                    .as_str()
                    .try_into()
                    .map_err(IpcError::transport(creating))?,
            )
            .map_err(IpcError::transport(creating))?;
        // Newest wins: a buffer of one that overflows. Two readers at most: the plugin, and its
        // successor while the slot of the dead one is being reclaimed.
        let observations = slices(&node, prefix, "observation")?
            .enable_safe_overflow(true)
            .subscriber_max_buffer_size(1)
            .subscriber_max_borrowed_samples(BORROWED_OBSERVATIONS)
            .history_size(0)
            .max_publishers(1)
            .max_subscribers(2)
            .max_nodes(4)
            .create_with_attributes(&version)
            .map_err(IpcError::transport(creating))?
            .publisher_builder()
            .initial_max_slice_len(observation_len)
            // Cameras may grow while flying; the memory follows.
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .max_loaned_samples(2)
            .create()
            .map_err(IpcError::transport(port))?;

        // Nothing is lost: no overflow, and a full queue is an error at its sender.
        let queue = |suffix| {
            slices(&node, prefix, suffix)?
                .enable_safe_overflow(false)
                .subscriber_max_buffer_size(QUEUE_DEPTH)
                .subscriber_max_borrowed_samples(2)
                .history_size(0)
                .max_publishers(2)
                .max_subscribers(2)
                .max_nodes(4)
                .create()
                .map_err(IpcError::transport(creating))
        };
        let to_plugin_service = queue("to_plugin")?;
        let to_plugin = to_plugin_service
            .publisher_builder()
            .initial_max_slice_len(MAX_FRAMED)
            .set_backpressure_handler(|_| BackpressureAction::DiscardDataAndFail)
            .create()
            .map_err(IpcError::transport(port))?;
        let from_plugin = queue("from_plugin")?
            .subscriber_builder()
            .create()
            .map_err(IpcError::transport(port))?;

        let event = |suffix| {
            node.service_builder(&name(prefix, suffix)?)
                .event()
                .max_nodes(4)
                .max_listeners(2)
                .max_notifiers(2)
                .create()
                .map_err(IpcError::transport(creating))
        };
        let wake_plugin =
            event("wake_plugin")?.notifier_builder().create().map_err(IpcError::transport(port))?;
        let wake_runtime = event("wake_runtime")?
            .listener_builder()
            .create()
            .map_err(IpcError::transport(port))?;
        Ok(Self {
            observations,
            to_plugin,
            from_plugin,
            wake_plugin,
            wake_runtime,
            to_plugin_service,
            owner,
            node,
        })
    }

    /// Whether a plugin has attached: from then on messages reach it.
    pub fn plugin_attached(&self) -> bool {
        let _acting = Acting::as_user(self.owner);
        self.to_plugin_service.dynamic_config().number_of_subscribers() > 0
    }

    /// Sends a message and wakes the plugin.
    ///
    /// # Errors
    /// [`IpcError::QueueFull`] if the plugin has left so many unread that it must be hung.
    pub fn send(&self, message: &ToPlugin) -> Result<(), IpcError> {
        let _acting = Acting::as_user(self.owner);
        send(&self.to_plugin, message, "plugin")?;
        self.heartbeat();
        Ok(())
    }

    /// Wakes the plugin. At least twice a second, so that it knows the runtime is alive.
    pub fn heartbeat(&self) {
        let _acting = Acting::as_user(self.owner);
        // A missing listener is no fault: the supervisor reports whether the plugin lives.
        let _ = self.wake_plugin.notify();
    }

    /// Lends shared memory for one observation of `len` bytes: zeros, aligned to 64. More than ever
    /// before takes longer once.
    ///
    /// # Errors
    /// [`IpcError::Transport`] if two are lent already, or there is not so much memory.
    pub fn loan(&self, len: usize) -> Result<LoanedObservation, IpcError> {
        let _acting = Acting::as_user(self.owner);
        let sample = self.observations.loan_slice(len);
        Ok(LoanedObservation(sample.map_err(IpcError::transport("lending memory"))?))
    }

    /// Publishes an observation and wakes the plugin; the one before is replaced if unread.
    pub fn publish(&self, observation: LoanedObservation) -> Result<(), IpcError> {
        let _acting = Acting::as_user(self.owner);
        observation.0.send().map_err(IpcError::transport("publishing"))?;
        self.heartbeat();
        Ok(())
    }

    /// Waits until the plugin sends something, `timeout` at most; returns whether it did.
    pub fn wait(&self, timeout: Duration) -> Result<bool, IpcError> {
        wait(&self.wake_runtime, timeout)
    }

    /// Takes the plugin's next message.
    ///
    /// # Errors
    /// [`IpcError::Message`] for one that does not decode; the next can still be read.
    pub fn receive(&self) -> Result<Option<FromPlugin>, IpcError> {
        let _acting = Acting::as_user(self.owner);
        receive(&self.from_plugin)
    }

    /// Reclaims what a dead plugin held: its subscriptions and the samples it was reading. Call
    /// after each exit of a plugin.
    pub fn clean_up(&self) {
        let _acting = Acting::as_user(self.owner);
        self.node.try_cleanup_dead_nodes();
    }
}

impl LoanedObservation {
    /// Returns what was written.
    pub fn bytes(&self) -> &[u8] {
        self.0.payload()
    }

    /// Returns the memory to write into.
    pub fn memory(&mut self) -> &mut [u8] {
        self.0.payload_mut()
    }
}
