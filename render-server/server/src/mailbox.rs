//! A slot for one item between two threads: the newest item wins.

use std::sync::{Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};
use vizflyt_process::lock;

/// A newest-wins slot for items of type `T`.
#[derive(Debug)]
pub struct Mailbox<T> {
    slot: Mutex<Option<T>>,
    filled: Condvar,
}

impl<T> Default for Mailbox<T> {
    fn default() -> Self {
        Self { slot: Mutex::new(None), filled: Condvar::new() }
    }
}

impl<T> Mailbox<T> {
    /// Stores `item`; returns whether it replaced one.
    pub fn put(&self, item: T) -> bool {
        self.put_over(item, |_, _| {}).is_some()
    }

    /// Stores `item` and returns the item that it replaced. `inherit(item, old)` first moves what is still needed from
    /// the old item to the new one, under the lock.
    pub fn put_over(&self, mut item: T, inherit: impl FnOnce(&mut T, &mut T)) -> Option<T> {
        let mut slot = lock(&self.slot);
        let mut old = slot.take();
        if let Some(old) = &mut old {
            inherit(&mut item, old);
        }
        *slot = Some(item);
        self.filled.notify_one();
        old
    }

    /// Waits at most `timeout` for an item.
    pub fn take(&self, timeout: Duration) -> Option<T> {
        let deadline = Instant::now() + timeout;
        let mut slot = lock(&self.slot);
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            if slot.is_some() || left.is_zero() {
                return slot.take();
            }
            slot = self.filled.wait_timeout(slot, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    const LONG: Duration = Duration::from_secs(30);

    #[test]
    fn keeps_the_newest_item() {
        let mailbox = Mailbox::default();
        assert!(!mailbox.put(1));
        assert!(mailbox.put(2));
        assert!(mailbox.put(3));
        assert_eq!(mailbox.take(LONG), Some(3));
        assert_eq!(mailbox.take(Duration::ZERO), None);
    }

    #[test]
    fn a_reader_on_another_thread_gets_rising_items_and_the_last_one() {
        let mailbox = Arc::new(Mailbox::<u32>::default());
        let reader = {
            let mailbox = mailbox.clone();
            std::thread::spawn(move || {
                let mut last = 0;
                while last < 10_000 {
                    let item = mailbox.take(LONG).unwrap();
                    assert!(item > last);
                    last = item;
                }
            })
        };
        for item in 1..=10_000 {
            mailbox.put(item);
        }
        reader.join().unwrap();
    }

    #[test]
    fn putting_wakes_the_reader() {
        let mailbox = Arc::new(Mailbox::<u32>::default());
        let reader = {
            let mailbox = mailbox.clone();
            std::thread::spawn(move || mailbox.take(LONG))
        };
        mailbox.put(7);
        assert_eq!(reader.join().unwrap(), Some(7));
    }
}
