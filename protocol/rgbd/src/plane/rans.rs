//! Entropy coder for symbols and raw bits: range asymmetric numeral systems (Duda, arXiv:1311.2540), with [`LANES`]
//! states of 32 bits that alternate on one stream of 16-bit words.

use super::cdf::{Cdf, TOTAL_BITS};
use crate::bits::{BitReader, BitWriter};

/// Number of states, so that a processor works on several symbols at once.
pub(super) const LANES: usize = 4;
/// States are in the range 2^16 to 2^32 - 1.
const MIN_STATE: u32 = 1 << 16;
/// Number of words, then the states.
const HEADER_BYTES: usize = 4 + 4 * LANES;

/// Encoder or decoder. The same model drives both.
pub(super) trait Coder {
    /// Codes a symbol and updates its frequencies. The encoder returns `symbol`; the decoder ignores it and returns the
    /// decoded symbol.
    fn symbol(&mut self, lane: usize, cdf: &mut Cdf, symbol: usize) -> usize;
    /// Codes `count` raw bits, 0 to 16; returns the value as in [`Self::symbol`].
    fn raw(&mut self, value: u32, count: u32) -> u32;
}

/// Collects symbols, then codes them from the last to the first.
#[derive(Clone, Debug, Default)]
pub(super) struct SymbolWriter {
    /// Start, share - 1, and lane: 15 + 15 + 2 bits.
    symbols: Vec<u32>,
    raw: BitWriter,
    words: Vec<u16>,
}

impl SymbolWriter {
    /// Clears the writer and reserves space for at most `most_raw_bits` raw bits.
    pub(super) fn start(&mut self, most_raw_bits: usize) {
        self.symbols.clear();
        self.raw.start(most_raw_bits);
    }

    /// Appends the coded symbols and raw bits to `out`.
    pub(super) fn finish(&mut self, out: &mut Vec<u8>) {
        let mut states = [MIN_STATE; LANES];
        // At most one word per symbol, and one extra for a write that is not kept.
        if self.words.len() <= self.symbols.len() {
            self.words.resize(self.symbols.len() + 1, 0);
        }
        let mut len = 0;
        for &symbol in self.symbols.iter().rev() {
            let (start, share) = (symbol & 0x7fff, (symbol >> 15 & 0x7fff) + 1);
            let state = &mut states[(symbol >> 30) as usize % LANES];
            // Without a branch: whether a word is written depends on the data and is unpredictable.
            let full = u64::from(*state) >= u64::from(share) << (32 - TOTAL_BITS);
            self.words[len] = *state as u16;
            len += usize::from(full);
            *state >>= 16 * u32::from(full);
            *state = ((*state / share) << TOTAL_BITS) + *state % share + start;
        }
        out.extend_from_slice(&(len as u32).to_le_bytes());
        out.extend(states.iter().flat_map(|state| state.to_le_bytes()));
        out.extend(self.words[..len].iter().rev().flat_map(|word| word.to_le_bytes()));
        self.raw.finish(out);
    }
}

impl Coder for SymbolWriter {
    #[inline(always)]
    fn symbol(&mut self, lane: usize, cdf: &mut Cdf, symbol: usize) -> usize {
        let (start, share) = cdf.share(symbol);
        self.symbols.push(start | (share - 1) << 15 | (lane as u32) << 30);
        cdf.learn(symbol);
        symbol
    }

    #[inline(always)]
    fn raw(&mut self, value: u32, count: u32) -> u32 {
        self.raw.push(value, count);
        value
    }
}

/// Decodes symbols. Reads zeros beyond the end, which [`Self::is_finished`] detects.
pub(super) struct SymbolReader<'a> {
    states: [u32; LANES],
    words: &'a [[u8; 2]],
    next: usize,
    raw: BitReader<'a>,
}

impl<'a> SymbolReader<'a> {
    /// Returns `None` if there are fewer bytes than the header states.
    pub(super) fn new(bytes: &'a [u8]) -> Option<Self> {
        let (header, rest) = bytes.split_first_chunk::<HEADER_BYTES>()?;
        let number = |at: usize| {
            u32::from_le_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]])
        };
        let (words, raw) = rest.split_at_checked((number(0) as usize).checked_mul(2)?)?;
        Some(Self {
            states: std::array::from_fn(|lane| number(4 + 4 * lane)),
            words: words.as_chunks().0,
            next: 0,
            raw: BitReader::new(raw),
        })
    }

    /// Returns whether all data was read and every state has returned to its initial value.
    pub(super) fn is_finished(&self) -> bool {
        self.states == [MIN_STATE; LANES] && self.next == self.words.len() && self.raw.is_finished()
    }
}

impl Coder for SymbolReader<'_> {
    #[inline(always)]
    fn symbol(&mut self, lane: usize, cdf: &mut Cdf, _: usize) -> usize {
        let state = &mut self.states[lane % LANES];
        let place = *state & ((1 << TOTAL_BITS) - 1);
        let symbol = cdf.symbol_at(place);
        let (start, share) = cdf.share(symbol);
        // At most 2^17 times 2^15: no more than 32 bits.
        *state = share.wrapping_mul(*state >> TOTAL_BITS).wrapping_add(place - start);
        // Without a branch, as above.
        let word = self.words.get(self.next).copied().unwrap_or_default();
        let short = *state < MIN_STATE;
        let refilled = *state << 16 | u32::from(u16::from_le_bytes(word));
        *state = if short { refilled } else { *state };
        self.next += usize::from(short);
        cdf.learn(symbol);
        symbol
    }

    #[inline(always)]
    fn raw(&mut self, _: u32, count: u32) -> u32 {
        self.raw.pop(count)
    }
}
