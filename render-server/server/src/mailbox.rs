//! Newest-wins slot for one item, with reuse of buffers.
//!
//! Writer: [`Mailbox::spare`], fill, [`Mailbox::put`]. Reader: [`Mailbox::take`], use, [`Mailbox::recycle`].
//! With one writer and one reader, three buffers circulate, so that no memory is allocated in the steady state.
//! The lock is held only to swap a few words.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use vizflyt_process::lock;

#[derive(Debug, Default)]
pub struct Mailbox<T> {
    inner: Mutex<Inner<T>>,
    filled: Condvar,
}

#[derive(Debug, Default)]
struct Inner<T> {
    slot: Option<T>,
    spares: Vec<T>,
    replaced: u64,
    closed: bool,
}

impl<T: Default> Mailbox<T> {
    /// Returns a buffer to fill: a used one, or a new one if too few circulate.
    pub fn spare(&self) -> T {
        self.lock().spares.pop().unwrap_or_default()
    }

    /// Stores `item` in place of an unread one; returns whether it replaced one.
    pub fn put(&self, item: T) -> bool {
        self.put_over(item, |_, _| {}).map(|old| self.recycle(old)).is_some()
    }

    /// Stores `item` like [`Self::put`], but first calls `inherit(item, old)` for the replaced item, and
    /// returns that.
    pub fn put_over(&self, mut item: T, inherit: impl FnOnce(&mut T, &mut T)) -> Option<T> {
        let mut inner = self.lock();
        let mut old = inner.slot.take();
        if let Some(old) = &mut old {
            inherit(&mut item, old);
        }
        inner.slot = Some(item);
        inner.replaced += u64::from(old.is_some());
        self.filled.notify_one();
        old
    }

    /// Waits at most `timeout` for an item; `None` if none came or the mailbox was closed.
    pub fn take(&self, timeout: Duration) -> Option<T> {
        let deadline = Instant::now() + timeout;
        let mut inner = self.lock();
        loop {
            if let Some(item) = inner.slot.take() {
                return Some(item);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if inner.closed || left.is_zero() {
                return None;
            }
            inner = self.filled.wait_timeout(inner, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Returns a buffer for reuse.
    pub fn recycle(&self, item: T) {
        let spares = &mut self.lock().spares;
        if spares.len() < MAX_SPARES {
            spares.push(item);
        }
    }

    /// Makes every present and future [`Self::take`] return at once.
    pub fn close(&self) {
        self.lock().closed = true;
        self.filled.notify_all();
    }

    /// Returns the number of items replaced unread.
    pub fn replaced(&self) -> u64 {
        self.lock().replaced
    }

    fn lock(&self) -> MutexGuard<'_, Inner<T>> {
        // No code panics while the lock is held; a poisoned mailbox is still valid.
        lock(&self.inner)
    }
}

/// Maximum of spare buffers: one being written, one in the slot, one being read, and two on other ways back.
const MAX_SPARES: usize = 5;

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    const LONG: Duration = Duration::from_secs(30);

    #[test]
    fn newest_wins_and_replaced_items_are_counted() {
        let mailbox = Mailbox::default();
        assert!(!mailbox.put(1));
        assert!(mailbox.put(2));
        assert!(mailbox.put(3));
        assert_eq!(mailbox.take(LONG), Some(3));
        assert_eq!(mailbox.take(Duration::ZERO), None);
        assert_eq!(mailbox.replaced(), 2);
    }

    #[test]
    fn buffers_circulate() {
        let mailbox = Mailbox::<Vec<u8>>::default();
        let mut seen = std::collections::BTreeSet::new();
        for round in 0..100usize {
            let mut buffer = mailbox.spare();
            buffer.clear();
            buffer.resize(1000, 0);
            seen.insert(buffer.as_ptr() as usize);
            mailbox.put(buffer);
            // The reader is slower than the writer: every third is read.
            if round % 3 == 0 {
                let taken = mailbox.take(LONG).unwrap();
                mailbox.recycle(taken);
            }
        }
        assert!(seen.len() <= 3, "{} buffers", seen.len());
    }

    #[test]
    fn another_thread_reads_items_in_order_and_the_last_one() {
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
    fn closing_wakes_the_reader() {
        let mailbox = Arc::new(Mailbox::<u32>::default());
        let reader = {
            let mailbox = mailbox.clone();
            std::thread::spawn(move || mailbox.take(LONG))
        };
        mailbox.close();
        assert_eq!(reader.join().unwrap(), None);
    }
}
