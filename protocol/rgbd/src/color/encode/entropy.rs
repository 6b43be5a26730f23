//! Huffman coding of blocks (ITU-T T.81, F.1.2).

use super::super::jpeg::ZIGZAG;
use super::tables::Words;
use super::transform::{ACROSS, Coefficients};

/// Maximum number of blocks that are coded before their bits are joined.
pub(super) const GROUP_BLOCKS: usize = 12;
/// Upper limit of their words: one per coefficient, and the end of block.
const GROUP_WORDS: usize = 1024;
/// Upper limit of their bytes, at 26 bits per word.
const GROUP_BYTES: usize = GROUP_WORDS * 26 / 8 + 16;
const _: () = assert!(GROUP_WORDS > GROUP_BLOCKS * 65);

/// Position of the zigzag's n-th coefficient of the first block in [`Coefficients`].
const PLACES: [u8; 64] = {
    let mut places = [0; 64];
    let mut n = 0;
    while n < 64 {
        let (v, u) = (ZIGZAG[n] / 8, ZIGZAG[n] % 8);
        places[n] = ACROSS as u8 * u + v;
        n += 1;
    }
    places
};

/// Set of zigzag numbers, by horizontal frequency u and set of vertical frequencies.
static ZIGZAG_SETS: [[u64; 256]; 8] = {
    let mut sets = [[0; 256]; 8];
    let mut n = 0;
    while n < 64 {
        let (v, u) = (ZIGZAG[n] / 8, ZIGZAG[n] % 8);
        let mut set = 0;
        while set < 256 {
            sets[u as usize][set] |= (set as u64 >> v & 1) << n;
            set += 1;
        }
        n += 1;
    }
    sets
};

/// Words of a group of blocks: their bits multiplied by 32, plus the number of bits.
pub(super) struct Coded {
    words: [u32; GROUP_WORDS],
    len: usize,
}

impl Coded {
    pub(super) const fn new() -> Self {
        Self { words: [0; GROUP_WORDS], len: 0 }
    }

    /// Removes and returns the words, with an empty word appended if their number is odd.
    pub(super) fn take(&mut self) -> &[[u32; 2]] {
        self.words[self.len] = 0;
        let len = std::mem::take(&mut self.len).next_multiple_of(2);
        self.words[..len].as_chunks().0
    }

    /// Codes one of the blocks side by side. `last_dc` is the DC coefficient of the previous block of this component.
    #[inline(always)]
    pub(super) fn block(
        &mut self,
        coefficients: &Coefficients,
        block: usize,
        words: &Words,
        last_dc: &mut i32,
    ) {
        let (magnitudes, bits) = coefficients.of_block(block);
        let mut room = self.words[self.len..].iter_mut();
        let mut push = |word| *room.next().expect("the buffer is large enough for a group") = word;

        // A number is not negative if its bits equal the magnitude.
        let dc = i32::from(magnitudes[0]);
        let dc =
            if bits[0].cast_unsigned() >> 5 == magnitudes[0].cast_unsigned() { dc } else { -dc };
        let difference = dc - *last_dc;
        *last_dc = dc;
        let category = 32 - difference.unsigned_abs().leading_zeros();
        let low = (difference + (difference >> 31)) & ((1 << category) - 1);
        push(words.dc[category as usize] | low.cast_unsigned() << 5);

        let mut left = 0;
        for (sets, set) in ZIGZAG_SETS.iter().zip(&coefficients.nonzero) {
            left |= sets[usize::from(set[block])];
        }
        left &= !1;
        let mut next = 1;
        while left != 0 {
            let at = left.trailing_zeros();
            left &= left - 1;
            let mut zeros = at - next;
            next = at + 1;
            while zeros >= 16 {
                push(words.sixteen_zeros);
                zeros -= 16;
            }
            let place = usize::from(PLACES[at as usize]);
            let leading = u32::from(magnitudes[place].cast_unsigned()).leading_zeros();
            let word = words.ac[usize::from((16 * zeros + leading) as u8)];
            push(word | u32::from(bits[place].cast_unsigned()));
        }
        if next < 64 {
            push(words.end);
        }
        self.len = GROUP_WORDS - room.len();
    }
}

/// Joins words, high bits first, and writes a zero byte after every 0xff.
pub(super) struct Bits<'a> {
    /// Written bytes, then reserved space.
    out: &'a mut Vec<u8>,
    len: usize,
    /// The last bits, high ones first, followed by zeros.
    open: u64,
    /// Number of bits in `open`, less than 8 between calls.
    used: u32,
    /// Bytes of a group before byte stuffing.
    bytes: [u8; GROUP_BYTES],
}

impl<'a> Bits<'a> {
    pub(super) fn new(out: &'a mut Vec<u8>) -> Self {
        Self { len: out.len(), out, open: 0, used: 0, bytes: [0; GROUP_BYTES] }
    }

    /// Appends the words of a group, in pairs of at most 52 bits.
    #[inline(always)]
    pub(super) fn extend(&mut self, words: &[[u32; 2]]) {
        let (mut open, mut used, mut len) = (self.open, self.used, 0);
        for &[first, second] in words {
            let count = second & 31;
            let bits = u64::from(first >> 5) << count | u64::from(second >> 5);
            // At least 2, at most 7 + 52.
            used += (first & 31) + count;
            open |= bits << (64 - used);
            self.bytes[len..len + 8].copy_from_slice(&open.to_be_bytes());
            len += used as usize / 8;
            open <<= used & !7;
            used &= 7;
        }
        (self.open, self.used) = (open, used);
        self.write(len);
    }

    /// Writes the first `len` bytes of the group.
    #[inline(always)]
    fn write(&mut self, len: usize) {
        if self.out.len() < self.len + 2 * GROUP_BYTES {
            self.out.resize(self.len + 8 * GROUP_BYTES, 0);
        }
        let (eights, rest) = self.bytes[..len].as_chunks::<8>();
        for eight in eights {
            const EVERY: u64 = 0x0101_0101_0101_0101;
            let word = u64::from_ne_bytes(*eight);
            // Adding one clears the high bit of a byte 0xff, with or without carry.
            if word & !word.wrapping_add(EVERY) & (EVERY << 7) == 0 {
                self.out[self.len..self.len + 8].copy_from_slice(eight);
                self.len += 8;
            } else {
                self.len = stuffed(self.out, self.len, eight);
            }
        }
        self.len = stuffed(self.out, self.len, rest);
    }

    /// Fills the last byte with ones, and removes the reserved space.
    pub(super) fn finish(mut self) {
        self.extend(&[[0x7f << 5 | 7, 0]]);
        self.out.truncate(self.len);
    }
}

/// Writes bytes, with a zero after every 0xff; returns the new length.
fn stuffed(room: &mut [u8], mut len: usize, bytes: &[u8]) -> usize {
    for &byte in bytes {
        // An unneeded zero is overwritten.
        room[len..len + 2].copy_from_slice(&[byte, 0]);
        len += 1 + usize::from(byte == 0xff);
    }
    len
}
