//! Serves the log's channels live over WebSocket, for Foxglove (`--foxglove`).
//!
//! The thread that writes the log also sends to viewers, so the flight is not delayed. A viewer that is
//! too slow misses messages. Only subscribed channels are sent.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;

use foxglove::{Context, FoxgloveError, PartialMetadata, RawChannel, WebSocketServerHandle};

use super::channels::{Channel, Description};

/// Maximum number of messages queued for a viewer.
const BACKLOG: usize = 256;

/// WebSocket server with the log's channels.
pub struct Live {
    context: Arc<Context>,
    server: WebSocketServerHandle,
    address: SocketAddr,
    channels: BTreeMap<Channel, Arc<RawChannel>>,
}

impl std::fmt::Debug for Live {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Live at {}", self.address)
    }
}

impl Live {
    /// Listens on `address`; port 0 selects a free port. Call it in the context of a tokio runtime that
    /// outlives the result.
    ///
    /// # Errors
    /// If the address cannot be listened on.
    pub async fn start(address: SocketAddr) -> Result<Self, FoxgloveError> {
        let context = Context::new();
        let server = context
            .websocket_server()
            .name("vizflyt")
            .message_backlog_size(BACKLOG)
            .tokio_runtime(&tokio::runtime::Handle::current())
            .bind(address.ip().to_string(), address.port())
            .start()
            .await?;
        let address = SocketAddr::new(address.ip(), server.port());
        Ok(Self { context, server, address, channels: BTreeMap::new() })
    }

    /// Returns the address on which it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    pub(super) fn offer(&mut self, channel: Channel, description: &Description) {
        let built = self
            .context
            .channel_builder(&description.topic)
            .message_encoding(description.encoding)
            .schema(description.schema.clone())
            .build_raw();
        match built {
            Ok(raw) => {
                self.channels.insert(channel, raw);
            }
            Err(error) => tracing::warn!("foxglove: {}: {error}", description.topic),
        }
    }

    pub(super) fn send(&self, channel: Channel, at_ns: u64, message: &[u8]) {
        if let Some(raw) = self.channels.get(&channel) {
            raw.log_with_meta(message, PartialMetadata { log_time: Some(at_ns) });
        }
    }

    pub(super) fn stop(self) {
        drop(self.server.stop());
    }
}
