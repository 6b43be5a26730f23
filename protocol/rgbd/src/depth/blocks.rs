//! Blocks of residuals to and from bits, 16 columns at a time.

use super::{BLOCK_COLUMNS, BLOCK_PIXELS, BLOCK_ROWS, simd};
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

    /// Returns the cheapest shape of a block, given how many of its residuals have more bits than
    /// each of 0 to 15; of equals, the one with the most low bits.
    #[inline(always)]
    pub(super) fn cheapest(longer_than: impl Fn(usize) -> u32) -> Self {
        let mut top = 16;
        while top > 0 && longer_than(top - 1) == 0 {
            top -= 1;
        }
        // 16 low bits have no code; 15 and one high bit do.
        let mut best =
            if top == 16 { Self { low: 15, high: 1 } } else { Self { low: top as u32, high: 0 } };
        let mut best_bits = if top == 16 { u32::MAX } else { (BLOCK_PIXELS * top) as u32 };
        for low in (0..top).rev().take(15) {
            let high = (top - low) as u32;
            let bits = (BLOCK_PIXELS * (low + 1)) as u32 + longer_than(low) * high;
            if bits < best_bits {
                best_bits = bits;
                best = Self { low: low as u32, high };
            }
        }
        best
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
    pub(super) fn push_block(&mut self, block: &Block) -> Shape {
        let longer = simd::longer_than(block);
        let shape = Shape::cheapest(|bits| longer[bits].count_ones());
        if shape.low > 0 {
            let kept = u16::MAX >> (16 - shape.low);
            for row in block {
                self.push(&row.map(|value| value & kept), shape.low);
            }
        }
        if shape.high > 0 {
            let mut mask = longer[shape.low as usize];
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
    fn push(&mut self, value: &Lanes, width_bits: u32) {
        for lane in 0..BLOCK_COLUMNS {
            self.open[lane] |= value[lane] << self.used;
        }
        let used = self.used + width_bits;
        if used < 16 {
            self.used = used;
            return;
        }
        self.flush();
        self.used = used - 16;
        if self.used > 0 {
            // What did not fit: the upper `used - 16` bits, so the shift is 1 to 15.
            for lane in 0..BLOCK_COLUMNS {
                self.open[lane] = value[lane] >> (width_bits - self.used);
            }
        }
    }

    #[inline(always)]
    fn flush(&mut self) {
        let room = &mut self.low[self.low_len..self.low_len + LANES_BYTES];
        for lane in 0..BLOCK_COLUMNS {
            room[2 * lane..2 * lane + 2].copy_from_slice(&self.open[lane].to_le_bytes());
        }
        self.low_len += LANES_BYTES;
        self.open = [0; BLOCK_COLUMNS];
    }

    /// Appends all bits to `out`: low ones, masks, high ones.
    pub(super) fn finish(&mut self, out: &mut Vec<u8>) {
        if self.used > 0 {
            self.flush();
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
        for row in 0..BLOCK_ROWS {
            let at = row * stride + column;
            let value = if shape.low == 0 { [0; BLOCK_COLUMNS] } else { self.pop(shape.low) };
            rows[at..at + BLOCK_COLUMNS].copy_from_slice(&value);
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
    fn pop(&mut self, width_bits: u32) -> Lanes {
        if self.used == 16 {
            self.load();
        }
        let mask = u16::MAX >> (16 - width_bits);
        let mut value: Lanes = std::array::from_fn(|lane| self.open[lane] >> self.used);
        let end = self.used + width_bits;
        if end > 16 {
            // The first part has 16 - used bits, 1 to 15 of them.
            let have = 16 - self.used;
            self.load();
            for lane in 0..BLOCK_COLUMNS {
                value[lane] |= self.open[lane] << have;
            }
            self.used = end - 16;
        } else {
            self.used = end;
        }
        value.map(|lane| lane & mask)
    }

    #[inline(always)]
    fn load(&mut self) {
        let (vector, rest) = self.low.split_at(LANES_BYTES);
        for lane in 0..BLOCK_COLUMNS {
            self.open[lane] = u16::from_le_bytes([vector[2 * lane], vector[2 * lane + 1]]);
        }
        self.low = rest;
        self.used = 0;
    }
}
