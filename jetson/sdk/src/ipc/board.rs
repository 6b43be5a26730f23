//! Two atomic words that both processes write: the newest slot, and the slots that the plugin has returned.
//!
//! A slot belongs to the process that last took it out of a word. The runtime trusts neither word: a plugin that writes
//! invalid words gets images that change during reading, without any other effect.

#![allow(unsafe_code, reason = "accesses the words by their type")]

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::atomic::{AtomicU64, Ordering};

use super::SLOTS;
use super::sealed::AtomicMemory;

#[derive(Debug)]
pub(super) struct Board(AtomicMemory);

#[repr(C)]
struct Words {
    /// 0, or the slot of the newest observation + 1 in the low byte, and its length in the higher bytes. [bytes]
    newest: AtomicU64,
    /// One bit per slot.
    returned: AtomicU64,
}

/// Slot and length of an observation.
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

    /// Publishes the newest observation. Returns the previous one if the plugin has not taken it.
    pub(super) fn post(&self, place: Place) -> Option<Place> {
        let word = (place.len as u64) << 8 | (place.slot as u64 + 1);
        place_in(self.words().newest.swap(word, Ordering::AcqRel))
    }

    /// Takes the newest observation, unless it was taken before.
    pub(super) fn take(&self) -> Option<Place> {
        place_in(self.words().newest.swap(0, Ordering::AcqRel))
    }

    /// Returns a taken slot to the runtime.
    pub(super) fn give_back(&self, slot: usize) {
        self.words().returned.fetch_or(1 << slot, Ordering::AcqRel);
    }

    /// Returns the slots that the plugin has given back since the last call.
    pub(super) fn returned(&self) -> impl Iterator<Item = usize> {
        let bits = self.words().returned.swap(0, Ordering::AcqRel);
        (0..SLOTS).filter(move |slot| bits & 1 << slot != 0)
    }

    fn words(&self) -> &Words {
        // SAFETY: created or opened as `Words`, which consists of atomics.
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
    fn newest_observation_wins_and_slots_are_returned() {
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
        fn any_word_decodes_to_a_valid_slot_or_none(word in any::<u64>()) {
            prop_assert!(place_in(word).is_none_or(|place| place.slot < SLOTS));
        }
    }
}
