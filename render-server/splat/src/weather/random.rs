//! Random numbers that depend only on a seed and keys: the same on every machine, in any order.

use vizflyt_protocol::random::{GOLDEN, SplitMix64};
pub(super) use vizflyt_protocol::random::{mix, unit_f32 as unit};

/// Sequence of random numbers of one item.
#[derive(Clone, Copy, Debug)]
pub(super) struct Random(SplitMix64);

impl Random {
    /// Returns the sequence of the item with these keys.
    pub(super) fn of(seed: u64, keys: [i64; 4]) -> Self {
        let keyed = |state: u64, key: i64| mix(state.wrapping_add(GOLDEN) ^ mix(key as u64));
        Self(SplitMix64::new(keys.into_iter().fold(mix(seed), keyed)))
    }

    /// Returns the next number in [0, 1).
    pub(super) fn unit(&mut self) -> f32 {
        self.0.unit_f32()
    }
}
