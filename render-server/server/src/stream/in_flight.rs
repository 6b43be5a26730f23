//! Buffer slot for one image between the encoder and one subscriber's connection.
//!
//! The encode thread fills it slice by slice, and a transport task empties it concurrently. It is free again
//! when both have released it. Slots are allocated when a subscriber connects, a few per camera, so that no
//! memory is allocated per image. A slice is a reference-counted part of the encoder's buffer: all subscribers
//! share one copy of the bytes.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard};
use vizflyt_process::lock;

use bytes::Bytes;
use tokio::sync::Notify;
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::time::ServerTime;

/// Next step of the transport.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Part {
    /// Send these bytes of bitstream.
    Bytes(Bytes),
    /// Finish the image.
    End {
        /// End of encoding.
        encode_end: ServerTime,
    },
    /// Reset the image: no more bytes follow.
    Cut,
}

/// Slot for an image in flight.
#[derive(Debug, Default)]
pub struct InFlightImage {
    state: Mutex<State>,
    changed: Notify,
}

#[derive(Debug, Default)]
struct State {
    /// Set by the encoder, taken by the transport.
    begun: Option<(ImageHeader, i32)>,
    parts: VecDeque<Part>,
    encoding: bool,
    sending: bool,
}

impl InFlightImage {
    /// Begins an image with this stream priority. The slot must be free.
    pub(crate) fn begin(&self, header: ImageHeader, priority: i32) {
        let mut state = self.lock();
        state.parts.clear();
        state.begun = Some((header, priority));
        (state.encoding, state.sending) = (true, true);
        drop(state);
        self.changed.notify_one();
    }

    pub(crate) fn push(&self, bytes: Bytes) {
        let mut state = self.lock();
        // If not sending: the deadline has passed, or the connection has ended.
        if state.sending {
            state.parts.push_back(Part::Bytes(bytes));
            drop(state);
            self.changed.notify_one();
        }
    }

    /// Ends the image: complete, or with `None` incomplete. Returns whether the slot is free.
    pub(crate) fn end(&self, encode_end: Option<ServerTime>) -> bool {
        let mut state = self.lock();
        state.encoding = false;
        if state.sending {
            let end = encode_end.map_or(Part::Cut, |encode_end| Part::End { encode_end });
            state.parts.push_back(end);
        }
        let is_free = !state.sending;
        drop(state);
        self.changed.notify_one();
        is_free
    }

    /// Waits for an image; returns its header and priority.
    pub async fn image(&self) -> (ImageHeader, i32) {
        loop {
            if let Some(begun) = self.lock().begun.take() {
                return begun;
            }
            self.changed.notified().await;
        }
    }

    /// Waits for the next part of the image.
    pub async fn part(&self) -> Part {
        loop {
            if let Some(part) = self.lock().parts.pop_front() {
                return part;
            }
            self.changed.notified().await;
        }
    }

    /// Releases the image, sent or not. Returns whether the slot is free.
    pub(crate) fn let_go(&self) -> bool {
        let mut state = self.lock();
        state.sending = false;
        state.parts.clear();
        !state.encoding
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // No code panics while the lock is held.
        lock(&self.state)
    }
}
