//! Adaptive frequencies of 16 symbols, updated as one vector (after Giesen, "Models for adaptive arithmetic coding",
//! 2015: cumulative frequencies move towards those of a certain symbol).

#![allow(unsafe_code, reason = "SIMD loads and stores")]

/// Number of symbols in the alphabet.
pub(super) const SYMBOLS: usize = 16;
/// The frequencies sum to 2^15.
pub(super) const TOTAL_BITS: u32 = 15;
const TOTAL: u16 = 1 << TOTAL_BITS;

/// Start of each symbol's share, from 0; the last entry is [`TOTAL`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(align(64))]
pub(super) struct Cdf {
    starts: [u16; SYMBOLS + 1],
    /// Number of learnt symbols, up to the last entry of [`RATES`].
    seen: u16,
}

impl Cdf {
    /// Makes a table with equal shares for the first `symbols`, and the minimum share for the others.
    pub(super) const fn even(symbols: usize) -> Self {
        let rest = SYMBOLS - symbols;
        let share = (TOTAL as usize - rest) / symbols;
        let mut starts = [TOTAL; SYMBOLS + 1];
        let mut symbol = 0;
        while symbol < SYMBOLS {
            starts[symbol] = if symbol <= symbols - (rest == 0) as usize {
                (symbol * share) as u16
            } else {
                TOTAL - (SYMBOLS - symbol) as u16
            };
            symbol += 1;
        }
        if rest > 0 {
            starts[symbols] = TOTAL - rest as u16;
        }
        Self { starts, seen: 0 }
    }

    /// Returns the start and the size of a symbol's share.
    #[inline(always)]
    pub(super) fn share(&self, symbol: usize) -> (u32, u32) {
        let start = self.starts[symbol % SYMBOLS];
        (u32::from(start), u32::from(self.starts[symbol % SYMBOLS + 1] - start))
    }

    /// Returns the symbol with this position in its share, 0 to 2^15 - 1.
    #[inline(always)]
    pub(super) fn symbol_at(&self, place: u32) -> usize {
        kernel::symbol_at(&self.starts, place as u16)
    }

    /// Updates the frequencies with a symbol: quickly at first, then averaging over about 64 symbols.
    #[inline(always)]
    pub(super) fn learn(&mut self, symbol: usize) {
        let rate = RATES[usize::from(self.seen) % RATES.len()];
        kernel::learn(&mut self.starts, symbol % SYMBOLS, rate);
        self.seen = (self.seen + 1).min(RATES.len() as u16 - 1);
    }
}

/// Step size by number of learnt symbols: a step is 2^-rate of the distance.
const RATES: [u16; 64] = {
    let mut rates = [5; 64];
    let mut seen = 0;
    while seen < 63 {
        rates[seen] = if seen < 4 {
            2
        } else if seen < 12 {
            3
        } else {
            4
        };
        seen += 1;
    }
    rates
};

/// Shares if the symbol were certain: the others have a share of 1, so that no share falls below 1. (Both boundaries
/// round down in the same way, so shares of at least 1 stay at least 1.)
const CERTAIN: [[u16; SYMBOLS]; SYMBOLS] = {
    let mut certain = [[0; SYMBOLS]; SYMBOLS];
    let mut symbol = 0;
    while symbol < SYMBOLS {
        let mut at = 0;
        while at < SYMBOLS {
            certain[symbol][at] =
                if at <= symbol { at as u16 } else { TOTAL - (SYMBOLS - at) as u16 };
            at += 1;
        }
        symbol += 1;
    }
    certain
};

/// The plain version, compiled on every machine, so that tests cover it.
#[cfg_attr(target_arch = "x86_64", allow(dead_code))]
mod plain {
    use super::{CERTAIN, SYMBOLS};

    #[inline(always)]
    pub(super) fn symbol_at(starts: &[u16; SYMBOLS + 1], place: u16) -> usize {
        let mut below = 0u16;
        for start in &starts[1..SYMBOLS] {
            below += u16::from(*start <= place);
        }
        usize::from(below)
    }

    #[inline(always)]
    pub(super) fn learn(starts: &mut [u16; SYMBOLS + 1], symbol: usize, rate: u16) {
        for (start, certain) in starts.iter_mut().zip(CERTAIN[symbol]) {
            // Both are below 2^15, so the difference fits into a signed 16-bit number.
            let step = certain.wrapping_sub(*start).cast_signed() >> rate;
            *start = start.wrapping_add(step.cast_unsigned());
        }
    }
}

#[cfg(not(target_arch = "x86_64"))]
use plain as kernel;

/// SSE2 is available on every x86_64, so no detection is needed at run time.
#[cfg(target_arch = "x86_64")]
mod kernel {
    use core::arch::x86_64::{
        __m128i, _mm_add_epi16, _mm_cmpgt_epi16, _mm_cvtsi32_si128, _mm_loadu_si128,
        _mm_movemask_epi8, _mm_packs_epi16, _mm_set1_epi16, _mm_sra_epi16, _mm_storeu_si128,
        _mm_sub_epi16,
    };

    use super::{CERTAIN, SYMBOLS};

    #[inline(always)]
    pub(super) fn symbol_at(starts: &[u16; SYMBOLS + 1], place: u16) -> usize {
        let [low, high] = halves(starts);
        // SAFETY: SSE2 is part of x86_64; these intrinsics work on values only.
        let above = unsafe {
            let place = _mm_set1_epi16(place.cast_signed());
            _mm_movemask_epi8(_mm_packs_epi16(
                _mm_cmpgt_epi16(low, place),
                _mm_cmpgt_epi16(high, place),
            ))
        };
        // The first share begins at 0, so at least one start is not above the position.
        (above | 1 << SYMBOLS).trailing_zeros().saturating_sub(1) as usize
    }

    #[inline(always)]
    pub(super) fn learn(starts: &mut [u16; SYMBOLS + 1], symbol: usize, rate: u16) {
        let [low, high] = halves(starts);
        let certain = &CERTAIN[symbol];
        let certain = halves(certain);
        // SAFETY: SSE2 is part of x86_64; these intrinsics work on values only.
        let [low, high] = unsafe {
            let rate = _mm_cvtsi32_si128(i32::from(rate));
            let step =
                |now, certain| _mm_add_epi16(now, _mm_sra_epi16(_mm_sub_epi16(certain, now), rate));
            [step(low, certain[0]), step(high, certain[1])]
        };
        let (to, _) = starts.as_chunks_mut::<8>();
        // SAFETY: each chunk is 16 writable bytes; the stores need no alignment.
        unsafe {
            _mm_storeu_si128(to[0].as_mut_ptr().cast(), low);
            _mm_storeu_si128(to[1].as_mut_ptr().cast(), high);
        }
    }

    /// Loads the first 16 entries.
    #[inline(always)]
    fn halves<const N: usize>(entries: &[u16; N]) -> [__m128i; 2] {
        let (from, _) = entries.as_chunks::<8>();
        // SAFETY: each chunk is 16 readable bytes; the loads need no alignment.
        unsafe {
            [_mm_loadu_si128(from[0].as_ptr().cast()), _mm_loadu_si128(from[1].as_ptr().cast())]
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn initial_shares_are_positive_and_sum_to_the_total() {
        for symbols in 1..=SYMBOLS {
            let cdf = Cdf::even(symbols);
            let shares: Vec<u32> = (0..SYMBOLS).map(|symbol| cdf.share(symbol).1).collect();
            assert!(shares.iter().all(|&share| share > 0), "{symbols}: {shares:?}");
            assert_eq!(shares.iter().sum::<u32>(), u32::from(TOTAL));
        }
    }

    proptest! {
        /// The machine's kernel and the plain kernel agree, shares stay positive, and every position has a symbol.
        #[test]
        fn kernels_agree(symbols in prop::collection::vec(0..SYMBOLS, 1..400), place in 0..TOTAL) {
            let mut cdf = Cdf::even(SYMBOLS);
            for symbol in symbols {
                let rate = RATES[usize::from(cdf.seen)];
                let mut plain = cdf.starts;
                plain::learn(&mut plain, symbol, rate);
                cdf.learn(symbol);
                prop_assert_eq!(plain, cdf.starts);
                prop_assert!((0..SYMBOLS).all(|symbol| cdf.share(symbol).1 > 0));
                let found = cdf.symbol_at(u32::from(place));
                prop_assert_eq!(found, plain::symbol_at(&cdf.starts, place));
                let (start, share) = cdf.share(found);
                prop_assert!((start..start + share).contains(&u32::from(place)));
            }
        }
    }
}
