//! Control stream: framed messages in both directions.

use std::ops::Range;
use std::time::Duration;

use quinn::{RecvStream, SendStream, VarInt};
use tokio::time::timeout;
use tracing::debug;
use vizflyt_protocol::messages::{ToRuntime, ToServer};
use vizflyt_protocol::packet::framing::{Deframer, FramingError, MAX_FRAMED, encode};

use super::{END, FOREIGN, SLOW};

/// End of a session: the close code and the reason as text.
pub(super) type Ending = (VarInt, String);

/// The server's half of the control stream.
pub(super) struct Outbound {
    pub(super) send: SendStream,
    buffer: [u8; MAX_FRAMED],
}

impl Outbound {
    pub(super) fn new(send: SendStream) -> Self {
        Self { send, buffer: [0; MAX_FRAMED] }
    }

    pub(super) async fn write(&mut self, message: &ToRuntime) -> Result<(), Ending> {
        let bytes = encode(message, &mut self.buffer);
        match timeout(PATIENCE, self.send.write_all(bytes)).await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(error)) => Err(gone(&error)),
            Err(_) => Err((SLOW, "the runtime has read nothing for 5 s".to_owned())),
        }
    }
}

/// The client's half of the control stream.
pub(super) struct Incoming {
    recv: RecvStream,
    deframer: Deframer,
    bytes: [u8; 2048],
    /// Part of `bytes` that the deframer has not consumed yet.
    held: Range<usize>,
}

impl Incoming {
    pub(super) fn new(recv: RecvStream) -> Self {
        Self { recv, deframer: Deframer::default(), bytes: [0; 2048], held: 0..0 }
    }

    /// Returns the next message; messages that do not decode are dropped.
    pub(super) async fn next(&mut self) -> Result<ToServer, Ending> {
        loop {
            match self.deframer.next::<ToServer>() {
                Some(Ok(message)) => return Ok(message),
                Some(Err(error @ FramingError::TooLong(_))) => {
                    return Err((FOREIGN, error.to_string()));
                }
                Some(Err(error @ FramingError::Body(_))) => {
                    debug!("{error}");
                    continue;
                }
                None => {}
            }
            if self.held.is_empty() {
                match self.recv.read(&mut self.bytes).await {
                    Ok(Some(count)) => self.held = 0..count,
                    Ok(None) => return Err((END, "the runtime ended the conversation".to_owned())),
                    Err(error) => return Err(gone(&error)),
                }
            }
            // After `None` the deframer has room for at least one byte.
            self.held.start += self.deframer.push(&self.bytes[self.held.clone()]);
        }
    }
}

pub(super) fn gone(error: &dyn std::fmt::Display) -> Ending {
    (END, error.to_string())
}

/// Maximum wait for an expected message of a runtime.
pub(super) const PATIENCE: Duration = Duration::from_secs(5);
