//! What the children report, in the order in which it comes, and how many of them may still report something.

use std::sync::mpsc::{Receiver, RecvError, RecvTimeoutError};
use std::time::Duration;

use super::child::Notice;

/// The one place where notices are received.
#[derive(Debug)]
pub(super) struct Inbox {
    notices: Receiver<Notice>,
    open: usize,
}

impl Inbox {
    /// Makes the inbox of children that are still to be started.
    pub(super) fn new(notices: Receiver<Notice>) -> Self {
        Self { notices, open: 0 }
    }

    /// Notes that a child was started.
    pub(super) fn child_started(&mut self) {
        self.open += 1;
    }

    /// Returns the number of children whose standard output is open, as far as notices have been received.
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
    fn a_child_that_closed_during_the_flight_is_not_waited_for_at_its_end() {
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
