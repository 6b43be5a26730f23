//! Packing of residual blocks to bits and back, 16 columns at a time.

use super::layout::{BLOCK_COLUMNS, BLOCK_PIXELS, BLOCK_ROWS};
use super::simd::Kernel;
use crate::bits::{BitReader, BitWriter};

/// One value per column of a block: 16 lanes with separate bit streams.
pub(super) type Lanes = [u16; BLOCK_COLUMNS];
/// The residuals of a block.
pub(super) type Block = [Lanes; BLOCK_ROWS];
/// Size of one vector of lanes. [bytes]
pub(super) const LANES_BYTES: usize = 2 * BLOCK_COLUMNS;

/// Storage of a block: a number of low bits for every residual, and a number of high bits for the few larger ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Shape {
    /// Number of low bits of every residual, 0 to 15.
    pub(super) low: u32,
    /// Number of high bits of the residuals in the mask, 0 to 15; 0 means no mask.
    pub(super) high: u32,
}

impl Shape {
    /// Returns the byte for the table.
    pub(super) fn code(self) -> u8 {
        (self.low | self.high << 4) as u8
    }

    /// Parses a byte of the table; `None` if it has more than 16 bits.
    pub(super) fn of_code(code: u8) -> Option<Self> {
        let shape = Self { low: u32::from(code & 15), high: u32::from(code >> 4) };
        (shape.low + shape.high <= 16).then_some(shape)
    }

    /// Returns the cheapest shape of a block of residuals, and the mask of residuals with high bits. Of equally cheap
    /// shapes, returns the one with the most low bits. `top` is the length of the longest residual. `longer` returns
    /// the mask of residuals with more than the given number of bits; it is called with decreasing numbers from `top -
    /// 1`.
    #[inline(always)]
    pub(super) fn cheapest(top: u32, mut longer: impl FnMut(u32) -> u64) -> (Self, u64) {
        // 16 low bits have no code; 15 low bits and one high bit do.
        let (mut best, mut best_bits) = if top == 16 {
            (Self { low: 15, high: 1 }, u32::MAX)
        } else {
            (Self { low: top, high: 0 }, BLOCK_PIXELS as u32 * top)
        };
        let mut best_mask = 0;
        // The width of high bits is at most 15.
        for low in (top.saturating_sub(15)..top).rev() {
            let mask = longer(low);
            let (count, high) = (mask.count_ones(), top - low);
            let bits = BLOCK_PIXELS as u32 * (low + 1) + count * high;
            if bits < best_bits {
                (best, best_bits, best_mask) = (Self { low, high }, bits, mask);
            }
            // With fewer low bits, all residuals also have high bits, which is never cheaper.
            if count == BLOCK_PIXELS as u32 {
                break;
            }
        }
        (best, best_mask)
    }
}

/// Returns the length of the low bits, if the low widths of all blocks sum to `low_sum`: each block adds [`BLOCK_ROWS`]
/// residuals to each of the 16 streams. [bytes]
pub(super) fn low_len(low_sum: usize) -> usize {
    (low_sum * BLOCK_ROWS).div_ceil(16) * LANES_BYTES
}

/// Packs residuals to bits.
#[derive(Clone, Debug, Default)]
pub(super) struct Packer {
    /// Low bits: full vectors, then space for the worst case.
    low: Vec<u8>,
    low_len: usize,
    open: Lanes,
    /// Number of bits in `open`, 0 to 15.
    used: u32,
    masks: Vec<u8>,
    high: BitWriter,
}

impl Packer {
    /// Clears the packer and reserves space for this number of blocks.
    pub(super) fn start(&mut self, blocks: usize) {
        let room = low_len(blocks * 15);
        if self.low.len() < room {
            self.low.resize(room, 0);
        }
        self.low_len = 0;
        self.open = [0; BLOCK_COLUMNS];
        self.used = 0;
        self.masks.clear();
        self.masks.reserve(8 * blocks);
        self.high.start(blocks * BLOCK_PIXELS * 15);
    }

    /// Packs a block; returns its shape.
    #[inline(always)]
    pub(super) fn push_block<K: Kernel>(&mut self, block: &Block) -> Shape {
        let (shape, mut mask) = K::cheapest(block);
        if shape.low > 0 {
            self.push_low(block, shape.low);
        }
        if shape.high > 0 {
            self.masks.extend_from_slice(&mask.to_le_bytes());
            let values = block.as_flattened();
            while mask != 0 {
                let at = mask.trailing_zeros() as usize % BLOCK_PIXELS;
                self.high.push(u32::from(values[at] >> shape.low), shape.high);
                mask &= mask - 1;
            }
        }
        shape
    }

    #[inline(always)]
    fn push_low(&mut self, block: &Block, width_bits: u32) {
        let kept = u16::MAX >> (16 - width_bits);
        // Local variables stay in registers from row to row.
        let (mut open, mut used) = (self.open, self.used);
        for row in block {
            let value = row.map(|value| value & kept);
            for lane in 0..BLOCK_COLUMNS {
                open[lane] |= value[lane] << used;
            }
            used += width_bits;
            if used >= 16 {
                self.flush(&open);
                used -= 16;
                // The remaining upper `used` bits.
                let spent = width_bits - used;
                open = value.map(|lane| lane >> spent);
            }
        }
        (self.open, self.used) = (open, used);
    }

    #[inline(always)]
    fn flush(&mut self, open: &Lanes) {
        let room = &mut self.low[self.low_len..self.low_len + LANES_BYTES];
        for lane in 0..BLOCK_COLUMNS {
            room[2 * lane..2 * lane + 2].copy_from_slice(&open[lane].to_le_bytes());
        }
        self.low_len += LANES_BYTES;
    }

    /// Appends all bits to `out`: low bits, masks, high bits.
    pub(super) fn finish(&mut self, out: &mut Vec<u8>) {
        if self.used > 0 {
            let open = self.open;
            self.flush(&open);
        }
        out.extend_from_slice(&self.low[..self.low_len]);
        out.extend_from_slice(&self.masks);
        self.high.finish(out);
    }
}

/// Unpacks bits to residuals. The three streams must have the lengths that the shapes require.
pub(super) struct Unpacker<'a> {
    low: &'a [u8],
    open: Lanes,
    /// Number of consumed bits of `open`; 16 if the next vector must be loaded.
    used: u32,
    masks: &'a [u8],
    high: BitReader<'a>,
}

impl<'a> Unpacker<'a> {
    pub(super) fn new(low: &'a [u8], masks: &'a [u8], high: &'a [u8]) -> Self {
        Self { low, open: [0; BLOCK_COLUMNS], used: 16, masks, high: BitReader::new(high) }
    }

    /// Unpacks one block of this shape and writes its residuals at `column` of the rows.
    #[inline(always)]
    pub(super) fn pop_block(
        &mut self,
        shape: Shape,
        rows: &mut [u16],
        stride: usize,
        column: usize,
    ) {
        if shape.low == 0 {
            for row in 0..BLOCK_ROWS {
                let at = row * stride + column;
                rows[at..at + BLOCK_COLUMNS].fill(0);
            }
        } else {
            self.pop_low(shape.low, rows, stride, column);
        }
        if shape.high > 0 {
            let (mask, rest) = self.masks.split_first_chunk().unwrap_or((&[0; 8], &[]));
            self.masks = rest;
            let mut mask = u64::from_le_bytes(*mask);
            while mask != 0 {
                let index = mask.trailing_zeros() as usize;
                let at = index / BLOCK_COLUMNS * stride + column + index % BLOCK_COLUMNS;
                rows[at] |= (self.high.pop(shape.high) << shape.low) as u16;
                mask &= mask - 1;
            }
        }
    }

    #[inline(always)]
    fn pop_low(&mut self, width_bits: u32, rows: &mut [u16], stride: usize, column: usize) {
        let mask = u16::MAX >> (16 - width_bits);
        // Local variables stay in registers from row to row.
        let (mut open, mut used) = (self.open, self.used);
        for row in 0..BLOCK_ROWS {
            if used == 16 {
                (open, used) = (self.load(), 0);
            }
            let mut value: Lanes = open.map(|lane| lane >> used);
            used += width_bits;
            if used > 16 {
                // The first part has `have` bits, 1 to 15.
                let have = 16 + width_bits - used;
                open = self.load();
                for lane in 0..BLOCK_COLUMNS {
                    value[lane] |= open[lane] << have;
                }
                used -= 16;
            }
            let at = row * stride + column;
            rows[at..at + BLOCK_COLUMNS].copy_from_slice(&value.map(|lane| lane & mask));
        }
        (self.open, self.used) = (open, used);
    }

    #[inline(always)]
    fn load(&mut self) -> Lanes {
        let (vector, rest) = self.low.split_at(LANES_BYTES);
        self.low = rest;
        std::array::from_fn(|lane| u16::from_le_bytes([vector[2 * lane], vector[2 * lane + 1]]))
    }
}
