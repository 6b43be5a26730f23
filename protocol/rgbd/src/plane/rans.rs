//! Symbols and raw bits to bytes: range asymmetric numeral systems (Duda, arXiv:1311.2540),
//! [`LANES`] states of 32 bits taking turns on one stream of 16-bit words.

use super::cdf::{Cdf, TOTAL_BITS};
use crate::bits::{BitReader, BitWriter};

/// States, so that a processor has several symbols under way at once.
pub(super) const LANES: usize = 4;
/// States lie in 2^16 to 2^32 - 1.
const MIN_STATE: u32 = 1 << 16;
/// Length of the words, then the states.
const HEADER_BYTES: usize = 4 + 4 * LANES;

/// One end: the model that drives it is the same for both.
pub(super) trait Coder {
    /// Codes a symbol and has its frequencies learn. The encoder returns `symbol`, the decoder
    /// what it finds instead.
    fn symbol(&mut self, lane: usize, cdf: &mut Cdf, symbol: usize) -> usize;
    /// Codes `count` bits, 0 to 16, as they are; returns like [`Self::symbol`].
    fn raw(&mut self, value: u32, count: u32) -> u32;
}

/// Gathers symbols, then codes them from the last to the first.
#[derive(Clone, Debug, Default)]
pub(super) struct SymbolWriter {
    /// Start, share - 1, lane: 15 + 15 + 2 bits.
    symbols: Vec<u32>,
    raw: BitWriter,
    words: Vec<u16>,
}

impl SymbolWriter {
    /// Forgets everything; makes room for so many raw bits.
    pub(super) fn start(&mut self, most_raw_bits: usize) {
        self.symbols.clear();
        self.raw.start(most_raw_bits);
    }

    /// Appends everything to `out`.
    pub(super) fn finish(&mut self, out: &mut Vec<u8>) {
        let mut states = [MIN_STATE; LANES];
        // A word a symbol at most, and one more to write in vain.
        if self.words.len() <= self.symbols.len() {
            self.words.resize(self.symbols.len() + 1, 0);
        }
        let mut len = 0;
        for &symbol in self.symbols.iter().rev() {
            let (start, share) = (symbol & 0x7fff, (symbol >> 15 & 0x7fff) + 1);
            let state = &mut states[(symbol >> 30) as usize % LANES];
            // Without a branch: a word goes out as often as the bits have it, which is no pattern.
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

/// Takes symbols apart again. Behind the end come zeros; [`Self::is_finished`] detects it.
pub(super) struct SymbolReader<'a> {
    states: [u32; LANES],
    words: &'a [[u8; 2]],
    next: usize,
    raw: BitReader<'a>,
}

impl<'a> SymbolReader<'a> {
    /// Returns `None` if the bytes are fewer than they state.
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

    /// Returns whether everything was taken and every state is where the encoder began.
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
        // At most 2^17 of 2^15 shares: no more than 32 bits.
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
