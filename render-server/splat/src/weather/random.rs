//! Numbers that follow from a seed and from what they are for: the same on every machine, in any order.

/// A sequence of random numbers (SplitMix64: Steele, Lea, Flood 2014).
#[derive(Clone, Copy, Debug)]
pub(super) struct Random(u64);

impl Random {
    /// Returns the sequence of one thing among others.
    pub(super) fn of(seed: u64, keys: [i64; 4]) -> Self {
        let keyed = |state: u64, key: i64| mix(state.wrapping_add(GAMMA) ^ mix(key as u64));
        Self(keys.into_iter().fold(mix(seed), keyed))
    }

    /// Returns the next number, 0 to 1, without 1.
    pub(super) fn unit(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(GAMMA);
        unit(mix(self.0))
    }
}

/// Returns 64 well mixed bits of 64.
pub(super) fn mix(mut z: u64) -> u64 {
    z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ z >> 31
}

/// Returns 0 to 1, without 1, of 64 random bits.
pub(super) fn unit(bits: u64) -> f32 {
    (bits >> 40) as f32 * (1.0 / 16_777_216.0)
}

const GAMMA: u64 = 0x9e37_79b9_7f4a_7c15;
