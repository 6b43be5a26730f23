//! Two words that both processes write: which slot is newest, and which the plugin has done with.
//!
//! A slot belongs to whoever took it out of a word last. The runtime trusts neither: a plugin that writes nonsense gets
//! images that change while it looks at them, and nothing else happens.

#![allow(unsafe_code, reason = "asks for the words by their type")]

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::atomic::{AtomicU64, Ordering};

use super::SLOTS;
use super::sealed::AtomicMemory;

/// Shared by both ends.
#[derive(Debug)]
pub(super) struct Board(AtomicMemory);

#[repr(C)]
struct Words {
    /// 0, or the newest observation's slot + 1 in the low byte, its length above. [bytes]
    newest: AtomicU64,
    /// Bit per slot.
    returned: AtomicU64,
}

/// Where an observation lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Place {
    pub(super) slot: usize,
    /// [bytes]
    pub(super) len: usize,
}

impl Board {
    pub(super) fn new() -> io::Result<Self> {
        Ok(Self(AtomicMemory::new::<Words>()?))
    }

    pub(super) fn open(descriptor: OwnedFd) -> io::Result<Self> {
        Ok(Self(AtomicMemory::open::<Words>(descriptor)?))
    }

    /// Posts the newest observation; returns the one before if nobody has taken it.
    pub(super) fn post(&self, place: Place) -> Option<Place> {
        let word = (place.len as u64) << 8 | (place.slot as u64 + 1);
        place_in(self.words().newest.swap(word, Ordering::AcqRel))
    }

    /// Takes the newest observation, if nobody has yet.
    pub(super) fn take(&self) -> Option<Place> {
        place_in(self.words().newest.swap(0, Ordering::AcqRel))
    }

    /// Gives a slot back that was taken.
    pub(super) fn give_back(&self, slot: usize) {
        self.words().returned.fetch_or(1 << slot, Ordering::AcqRel);
    }

    /// Returns the slots that were given back since the last call.
    pub(super) fn returned(&self) -> impl Iterator<Item = usize> {
        let bits = self.words().returned.swap(0, Ordering::AcqRel);
        (0..SLOTS).filter(move |slot| bits & 1 << slot != 0)
    }

    fn words(&self) -> &Words {
        // SAFETY: made or opened as `Words`, which are atomics.
        unsafe { self.0.get::<Words>() }
    }
}

impl AsFd for Board {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

fn place_in(word: u64) -> Option<Place> {
    let slot = usize::try_from(word & 0xFF).ok()?.checked_sub(1).filter(|&slot| slot < SLOTS)?;
    Some(Place { slot, len: usize::try_from(word >> 8).ok()? })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_newest_wins_and_slots_come_back() {
        let board = Board::new().unwrap();
        let theirs = Board::open(board.as_fd().try_clone_to_owned().unwrap()).unwrap();
        let place = |slot| Place { slot, len: 1 << 20 };
        assert_eq!(theirs.take(), None);
        assert_eq!(board.post(place(0)), None);
        assert_eq!(board.post(place(3)), Some(place(0)));
        assert_eq!((theirs.take(), theirs.take()), (Some(place(3)), None));
        theirs.give_back(3);
        theirs.give_back(5);
        assert_eq!(board.returned().collect::<Vec<_>>(), [3, 5]);
        assert_eq!(board.returned().count(), 0);
    }

    proptest! {
        #[test]
        fn any_word_is_a_slot_or_none(word in any::<u64>()) {
            prop_assert!(place_in(word).is_none_or(|place| place.slot < SLOTS));
        }
    }
}
