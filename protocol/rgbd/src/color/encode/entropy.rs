//! Huffman coding of blocks (ITU-T T.81, F.1.2).

use super::tables::{Words, ZIGZAG};
use super::transform::{ACROSS, Coefficients};

/// More than the blocks of a group take, 12 at most: every coefficient a word of 16 bits and 10
/// after it, and every byte stuffed.
const MAX_GROUP_BYTES: usize = 12 * 2 * 64 * 26 / 8 + 64;

/// Where the zigzag's n-th coefficient of the first block is in [`Coefficients`].
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

/// By horizontal frequency u and a set of vertical ones: the set of zigzag numbers.
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

/// Writes bits, high ones first, with a zero byte after every 0xff.
pub(super) struct Bits<'a> {
    /// What is written, then room.
    out: &'a mut Vec<u8>,
    len: usize,
    /// The last bits, low; what is above them is of no account.
    word: u64,
    /// How many more the word holds.
    free: u32,
}

impl<'a> Bits<'a> {
    pub(super) fn new(out: &'a mut Vec<u8>) -> Self {
        Self { len: out.len(), out, word: 0, free: 64 }
    }

    /// Makes room for the blocks of a group.
    pub(super) fn make_room(&mut self) {
        if self.out.len() < self.len + MAX_GROUP_BYTES {
            self.out.resize(self.len + 4 * MAX_GROUP_BYTES, 0);
        }
    }

    /// Adds the low `count` bits, 1 to 57; the others must be 0.
    #[inline(always)]
    fn put(&mut self, bits: u64, count: u32) {
        debug_assert!(bits >> count == 0);
        if count <= self.free {
            self.free -= count;
            self.word = self.word << count | bits;
        } else {
            let over = count - self.free;
            self.flush(self.word << self.free | bits >> over);
            self.word = bits;
            self.free = 64 - over;
        }
    }

    #[inline(always)]
    fn flush(&mut self, word: u64) {
        const EVERY: u64 = 0x0101_0101_0101_0101;
        // A byte of 0xff loses its high bit when one is added, whatever is carried in.
        if word & !word.wrapping_add(EVERY) & (EVERY << 7) == 0 {
            self.out[self.len..self.len + 8].copy_from_slice(&word.to_be_bytes());
            self.len += 8;
        } else {
            self.len = stuffed(self.out, self.len, &word.to_be_bytes());
        }
    }

    /// Fills the last byte with ones, and takes the room that is left away.
    pub(super) fn finish(mut self) {
        self.make_room();
        self.put(0x7f, 7);
        let bytes = (self.word << self.free).to_be_bytes();
        let whole = (64 - self.free as usize) / 8;
        let len = stuffed(self.out, self.len, &bytes[..whole]);
        self.out.truncate(len);
    }

    /// Adds a block, of those side by side; `last_dc` is the DC coefficient of the block before, of
    /// the same component.
    #[inline(always)]
    pub(super) fn block(
        &mut self,
        coefficients: &Coefficients,
        block: usize,
        words: &Words,
        last_dc: &mut i32,
    ) {
        let (magnitudes, bits) = coefficients.of_block(block);

        // Where the bits of a number are the magnitude, it is not negative.
        let dc = i32::from(magnitudes[0]);
        let dc = if bits[0] == magnitudes[0] { dc } else { -dc };
        let difference = dc - *last_dc;
        *last_dc = dc;
        let category = 32 - difference.unsigned_abs().leading_zeros();
        let word = words.dc[category as usize];
        let low = (difference + (difference >> 31)) & ((1 << category) - 1);
        self.put(u64::from(word >> 5) | low as u64, word & 31);

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
                self.put(words.zeros.0, words.zeros.1);
                zeros -= 16;
            }
            let place = usize::from(PLACES[at as usize]);
            let category = u32::from(magnitudes[place].cast_unsigned()).leading_zeros();
            let word = words.ac[usize::from((16 * zeros + category) as u8)];
            let low = u64::from(bits[place].cast_unsigned());
            self.put(u64::from(word >> 5) | low, word & 31);
        }
        if next < 64 {
            self.put(words.end.0, words.end.1);
        }
    }
}

/// Writes bytes, and a zero after every 0xff; returns the new length.
#[cold]
fn stuffed(room: &mut [u8], mut len: usize, bytes: &[u8]) -> usize {
    for &byte in bytes {
        room[len] = byte;
        // The zero is there in any case, and overwritten where it is none.
        room[len + 1] = 0;
        len += if byte == 0xff { 2 } else { 1 };
    }
    len
}
