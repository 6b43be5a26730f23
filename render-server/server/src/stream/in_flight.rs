//! The place of one image on its way from the encoder to one subscriber's connection.
//!
//! The encode thread fills it slice by slice, a task of the transport empties it at the same time;
//! it is free again when both have let go. Slots are made when a subscriber comes, a few per
//! camera, so that nothing is allocated per image. A slice is a counted reference to the encoder's
//! buffer: however many subscribers an image has, its bytes are there once.

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard};
use vizflyt_process::lock;

use bytes::Bytes;
use tokio::sync::Notify;
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::time::ServerTime;

/// What the transport does next.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Part {
    /// Sends these bytes of bitstream.
    Bytes(Bytes),
    /// Ends the image.
    End {
        /// Encoding ended.
        encode_end: ServerTime,
    },
    /// Resets it: the rest will not come.
    Cut,
}

/// A place for an image in flight.
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
    /// Begins an image, which leaves with this priority; the place was free.
    pub(crate) fn begin(&self, header: ImageHeader, priority: i32) {
        let mut state = self.lock();
        state.parts.clear();
        state.begun = Some((header, priority));
        (state.encoding, state.sending) = (true, true);
        drop(state);
        self.changed.notify_one();
    }

    /// Adds bytes to the image.
    pub(crate) fn push(&self, bytes: Bytes) {
        let mut state = self.lock();
        // Nobody sends any more: past its deadline, or the connection is gone.
        if state.sending {
            state.parts.push_back(Part::Bytes(bytes));
            drop(state);
            self.changed.notify_one();
        }
    }

    /// Says that all bytes are there, or with `None` that no more will come; returns whether the
    /// place is free now.
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

    /// Lets go of the image, sent or not; returns whether the place is free now.
    pub(crate) fn let_go(&self) -> bool {
        let mut state = self.lock();
        state.sending = false;
        state.parts.clear();
        !state.encoding
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // Why: nothing panics while the lock is held.
        lock(&self.state)
    }
}
