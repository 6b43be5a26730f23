//! The log's channels live over WebSocket, for Foxglove (`--foxglove`).
//!
//! Fed by the thread that writes the log, so it costs the flight nothing; a viewer that is too
//! slow misses messages. Only what a viewer subscribes to travels.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;

use foxglove::{Context, FoxgloveError, PartialMetadata, RawChannel, WebSocketServerHandle};

use super::channels::{Channel, Description};

/// Messages that wait for a viewer at most.
const BACKLOG: usize = 256;

/// A WebSocket server with the log's channels.
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
    /// Listens on `address`; port 0 takes a free one. Needs the context of a tokio runtime that
    /// lives as long.
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

    /// Returns where it listens.
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
