//! Random numbers from a seed, identical on every machine: SplitMix64 (G. Steele, D. Lea, C. Flood: "Fast splittable
//! pseudorandom number generators", OOPSLA 2014). The n-th number is a hash of seed and n, so that each can be computed
//! independently ([`nth`]). Not cryptographically secure.

/// 2^64 divided by the golden ratio, odd: the increment of the state.
pub const GOLDEN: u64 = 0x9E37_79B9_7F4A_7C15;

/// Mixes 64 bits: SplitMix64's finaliser.
#[inline]
pub const fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// Returns number `n` of a seed, counted from 0: the output of [`SplitMix64::bits`] after `n` calls.
#[inline]
pub const fn nth(seed: u64, n: u64) -> u64 {
    mix(seed.wrapping_add(n.wrapping_add(1).wrapping_mul(GOLDEN)))
}

/// Returns a number in [0, 1) from the upper 53 bits.
#[inline]
pub const fn unit(bits: u64) -> f64 {
    (bits >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
}

/// Returns a number in [0, 1) from the upper 24 bits.
#[inline]
pub const fn unit_f32(bits: u64) -> f32 {
    (bits >> 40) as f32 * (1.0 / (1u64 << 24) as f32)
}

/// Generator of the sequence of random numbers of a seed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SplitMix64 {
    state: u64,
}

impl SplitMix64 {
    /// Returns the generator for a seed.
    #[inline]
    pub const fn new(seed: u64) -> Self {
        Self { state: seed }
    }

    /// Returns the state, which is the seed of the remaining numbers.
    #[inline]
    pub const fn state(self) -> u64 {
        self.state
    }

    /// Returns the next 64 random bits.
    #[inline]
    pub const fn bits(&mut self) -> u64 {
        self.state = self.state.wrapping_add(GOLDEN);
        mix(self.state)
    }

    /// Returns the next number in [0, 1).
    #[inline]
    pub const fn unit(&mut self) -> f64 {
        unit(self.bits())
    }

    /// Returns the next number in [0, 1), in single precision.
    #[inline]
    pub const fn unit_f32(&mut self) -> f32 {
        unit_f32(self.bits())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matches_the_published_numbers() {
        // First outputs for the state 1234567.
        let mut random = SplitMix64::new(1234567);
        let first = [6457827717110365317, 3203168211198807973];
        assert_eq!([random.bits(), random.bits()], first);
        assert_eq!([nth(1234567, 0), nth(1234567, 1)], first);
    }

    #[test]
    fn units_are_below_1() {
        assert_eq!((unit(0), unit_f32(0)), (0.0, 0.0));
        assert!(unit(u64::MAX) < 1.0 && unit_f32(u64::MAX) < 1.0);
    }
}
