//! Blocks of residuals to and from bits, 16 columns at a time.

use super::layout::{BLOCK_COLUMNS, BLOCK_PIXELS, BLOCK_ROWS};
use super::simd::Kernel;
use crate::bits::{BitReader, BitWriter};

/// One bit stream per column of a block: 16 lanes.
pub(super) type Lanes = [u16; BLOCK_COLUMNS];
/// The residuals of a block.
pub(super) type Block = [Lanes; BLOCK_ROWS];
/// Bytes of one vector of lanes.
pub(super) const LANES_BYTES: usize = 2 * BLOCK_COLUMNS;

/// How a block is stored: so many low bits of every residual, and so many more of those few that
/// need them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Shape {
    /// Low bits of every residual, 0 to 15.
    pub(super) low: u32,
    /// High bits of the residuals that the mask names, 0 to 15; 0: there is no mask.
    pub(super) high: u32,
}

impl Shape {
    /// Returns the byte of the table.
    pub(super) fn code(self) -> u8 {
        (self.low | self.high << 4) as u8
    }

    /// Reads a byte of the table; `None` if it asks for more than 16 bits.
    pub(super) fn of_code(code: u8) -> Option<Self> {
        let shape = Self { low: u32::from(code & 15), high: u32::from(code >> 4) };
        (shape.low + shape.high <= 16).then_some(shape)
    }

    /// Returns the cheapest shape of a block of residuals, and which of them have high bits; of
    /// equals, the shape with the most low bits. `top` is the length of the longest residual, and
    /// `longer` counts, called for `top - 1` low bits and then ever fewer, which have more.
    #[inline(always)]
    pub(super) fn cheapest(top: u32, mut longer: impl FnMut(u32) -> u64) -> (Self, u64) {
        // 16 low bits have no code; 15 and one high bit do.
        let (mut best, mut best_bits) = if top == 16 {
            (Self { low: 15, high: 1 }, u32::MAX)
        } else {
            (Self { low: top, high: 0 }, BLOCK_PIXELS as u32 * top)
        };
        let mut best_mask = 0;
        // High bits have a width of 15 at most.
        for low in (top.saturating_sub(15)..top).rev() {
            let mask = longer(low);
            let (count, high) = (mask.count_ones(), top - low);
            let bits = BLOCK_PIXELS as u32 * (low + 1) + count * high;
            if bits < best_bits {
                (best, best_bits, best_mask) = (Self { low, high }, bits, mask);
            }
            // With fewer low bits all have high ones too, which is never cheaper.
            if count == BLOCK_PIXELS as u32 {
                break;
            }
        }
        (best, best_mask)
    }
}

/// Returns the bytes of low bits after blocks whose low widths sum to `low_sum`: each adds
/// [`BLOCK_ROWS`] residuals to each of the 16 streams.
pub(super) fn low_len(low_sum: usize) -> usize {
    (low_sum * BLOCK_ROWS).div_ceil(16) * LANES_BYTES
}

/// Residuals to bits.
#[derive(Clone, Debug, Default)]
pub(super) struct Packer {
    /// Low bits: full vectors, then room for the worst case.
    low: Vec<u8>,
    low_len: usize,
    open: Lanes,
    /// Bits used in `open`, 0 to 15.
    used: u32,
    masks: Vec<u8>,
    high: BitWriter,
}

impl Packer {
    /// Forgets everything; makes room for so many blocks.
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

    /// Adds a block; returns its shape.
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
        // In locals, so that they stay in registers from row to row.
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
                // What did not fit: the upper `used` bits.
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

    /// Appends all bits to `out`: low ones, masks, high ones.
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

/// Bits to residuals. The three streams must be as long as the shapes to come need.
pub(super) struct Unpacker<'a> {
    low: &'a [u8],
    open: Lanes,
    /// Bits used up in `open`; 16 when the next vector must be loaded.
    used: u32,
    masks: &'a [u8],
    high: BitReader<'a>,
}

impl<'a> Unpacker<'a> {
    pub(super) fn new(low: &'a [u8], masks: &'a [u8], high: &'a [u8]) -> Self {
        Self { low, open: [0; BLOCK_COLUMNS], used: 16, masks, high: BitReader::new(high) }
    }

    /// Takes one block of this shape and writes its residuals at `column` of the rows.
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
        // In locals, so that they stay in registers from row to row.
        let (mut open, mut used) = (self.open, self.used);
        for row in 0..BLOCK_ROWS {
            if used == 16 {
                (open, used) = (self.load(), 0);
            }
            let mut value: Lanes = open.map(|lane| lane >> used);
            used += width_bits;
            if used > 16 {
                // The first part has `have` bits, 1 to 15 of them.
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
