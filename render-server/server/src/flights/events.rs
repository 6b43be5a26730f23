//! Event log of a vehicle, for the runtime, the page and standard output.
//!
//! Every reader has its own cursor and reads at its own pace; the log keeps the newest [`EventLog::KEPT`]. A
//! reader that falls behind receives [`Lagged`], so that no event is lost unnoticed: a runtime's session is
//! then closed, and the runtime connects again.

use std::collections::VecDeque;
use std::sync::Mutex;
use vizflyt_process::lock;

use tokio::sync::watch;
use vizflyt_protocol::messages::Event;

/// Origin of an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// This server: referee, localization, stop button. Sent to the runtime.
    Server,
    /// The runtime, or this server about the runtime's connection. Shown only on the page.
    Page,
}

/// Entry of the log.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// Number of the event since the start of the server, from 0.
    pub index: u64,
    pub origin: Origin,
    pub event: Event,
}

/// The reader's next events have been dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("reader at event {cursor} fell behind: the oldest kept is {oldest}")]
pub struct Lagged {
    /// Cursor of the reader.
    pub cursor: u64,
    /// Oldest event in the log.
    pub oldest: u64,
}

#[derive(Debug)]
pub struct EventLog {
    entries: Mutex<VecDeque<Entry>>,
    next: watch::Sender<u64>,
}

impl Default for EventLog {
    fn default() -> Self {
        Self { entries: Mutex::default(), next: watch::Sender::new(0) }
    }
}

impl EventLog {
    /// Maximum number of events: a plugin that prints a hundred lines a second may be read 40 s late.
    pub const KEPT: usize = 4096;

    /// Appends an event; returns its index.
    pub fn push(&self, origin: Origin, event: Event) -> u64 {
        let mut entries = lock(&self.entries);
        let index = *self.next.borrow();
        entries.push_back(Entry { index, origin, event });
        if entries.len() > Self::KEPT {
            entries.pop_front();
        }
        // Under the lock, so that indices appear in order.
        self.next.send_replace(index + 1);
        index
    }

    /// Returns the index of the next event.
    pub fn next_index(&self) -> u64 {
        *self.next.borrow()
    }

    /// Returns a receiver that changes with every event.
    pub fn subscribe(&self) -> watch::Receiver<u64> {
        self.next.subscribe()
    }

    /// Returns the events from `cursor` on, and moves the cursor past them.
    pub fn read(&self, cursor: &mut u64) -> Result<Vec<Entry>, Lagged> {
        let entries = lock(&self.entries);
        let oldest = entries.front().map_or(*cursor, |entry| entry.index);
        if *cursor < oldest {
            return Err(Lagged { cursor: *cursor, oldest });
        }
        let skip = (*cursor - oldest) as usize;
        let found: Vec<_> = entries.iter().skip(skip).cloned().collect();
        *cursor += found.len() as u64;
        Ok(found)
    }

    /// Returns the newest events, at most `most`, and the cursor after them.
    pub fn newest(&self, most: usize) -> (Vec<Entry>, u64) {
        let entries = lock(&self.entries);
        let skip = entries.len().saturating_sub(most);
        let cursor = entries.back().map_or(0, |entry| entry.index + 1);
        (entries.iter().skip(skip).cloned().collect(), cursor)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::messages::{EventKind, bounded};
    use vizflyt_protocol::time::ServerTime;

    fn event(number: usize) -> Event {
        Event {
            stamp: ServerTime::from_ns(number as u64),
            kind: EventKind::Note,
            text: bounded(&format!("event {number}")),
        }
    }

    #[test]
    fn each_reader_reads_everything_once_and_in_order() {
        let log = EventLog::default();
        let (mut one, mut two) = (0, 0);
        log.push(Origin::Server, event(0));
        assert_eq!(log.read(&mut one).unwrap().len(), 1);
        log.push(Origin::Page, event(1));
        log.push(Origin::Server, event(2));
        let texts = |entries: Vec<Entry>| -> Vec<String> {
            entries.into_iter().map(|entry| entry.event.text.as_str().to_owned()).collect()
        };
        assert_eq!(texts(log.read(&mut one).unwrap()), ["event 1", "event 2"]);
        assert_eq!(texts(log.read(&mut two).unwrap()), ["event 0", "event 1", "event 2"]);
        assert!(log.read(&mut two).unwrap().is_empty());
        assert_eq!(texts(log.newest(2).0), ["event 1", "event 2"]);
        assert_eq!(log.newest(2).1, 3);
    }

    #[test]
    fn reader_that_falls_behind_is_notified() {
        let log = EventLog::default();
        let mut cursor = 0;
        for number in 0..EventLog::KEPT + 5 {
            log.push(Origin::Server, event(number));
        }
        assert_eq!(log.read(&mut cursor), Err(Lagged { cursor: 0, oldest: 5 }));
        cursor = 5;
        assert_eq!(log.read(&mut cursor).unwrap().len(), EventLog::KEPT);
    }

    #[tokio::test]
    async fn a_waiting_reader_is_woken() {
        let log = EventLog::default();
        let mut changed = log.subscribe();
        log.push(Origin::Server, event(0));
        changed.changed().await.unwrap();
        assert_eq!(*changed.borrow(), 1);
    }
}
