//! Messages of the children in the order of arrival, and the number of children that may still send
//! some.

use std::sync::mpsc::{Receiver, RecvError, RecvTimeoutError};
use std::time::Duration;

use super::child::Notice;

/// Receiver of all notices.
#[derive(Debug)]
pub(super) struct Inbox {
    notices: Receiver<Notice>,
    open: usize,
}

impl Inbox {
    /// Returns an inbox for children that are started later.
    pub(super) fn new(notices: Receiver<Notice>) -> Self {
        Self { notices, open: 0 }
    }

    /// Counts a started child.
    pub(super) fn child_started(&mut self) {
        self.open += 1;
    }

    /// Returns the number of children with open standard output, according to the received notices.
    pub(super) fn open(&self) -> usize {
        self.open
    }

    /// Waits for the next notice.
    pub(super) fn recv(&mut self) -> Result<Notice, RecvError> {
        self.notices.recv().inspect(|notice| note_closed(&mut self.open, notice))
    }

    /// Waits for the next notice for at most `limit`.
    pub(super) fn recv_timeout(&mut self, limit: Duration) -> Result<Notice, RecvTimeoutError> {
        self.notices.recv_timeout(limit).inspect(|notice| note_closed(&mut self.open, notice))
    }
}

fn note_closed(open: &mut usize, notice: &Notice) {
    if matches!(notice, Notice::Closed(_)) {
        *open = open.saturating_sub(1);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use serde_json::Value;

    use super::super::child::Role;
    use super::*;

    #[test]
    fn does_not_wait_for_a_child_that_closed_during_the_flight() {
        let (notices, receiver) = mpsc::channel();
        let mut inbox = Inbox::new(receiver);
        for _ in 0..2 {
            inbox.child_started();
        }
        notices.send(Notice::Line(Role::Server, Value::Null)).unwrap();
        notices.send(Notice::Closed(Role::Runtime)).unwrap();
        inbox.recv().unwrap();
        assert_eq!(inbox.open(), 2);
        inbox.recv().unwrap();
        assert_eq!(inbox.open(), 1);
        notices.send(Notice::Interrupted).unwrap();
        notices.send(Notice::Closed(Role::Server)).unwrap();
        inbox.recv_timeout(Duration::ZERO).unwrap();
        inbox.recv_timeout(Duration::ZERO).unwrap();
        assert_eq!(inbox.open(), 0);
    }
}
