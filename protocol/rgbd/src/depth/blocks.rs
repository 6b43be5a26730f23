//! Blocks of residuals to and from bits, 16 columns at a time.

use super::{BLOCK_COLUMNS, BLOCK_ROWS};

/// One bit stream per column of a block: 16 lanes.
type Lanes = [u16; BLOCK_COLUMNS];
/// Bytes of one vector of lanes.
const LANES_BYTES: usize = 2 * BLOCK_COLUMNS;

/// Returns the four-bit code of a block's width. Width 15 is stored as 16.
pub(super) fn width_code(width_bits: u32) -> u8 {
    debug_assert!(width_bits <= 16 && width_bits != 15);
    width_bits.min(15) as u8
}

/// Returns the width of a four-bit code. [bits]
pub(super) fn width_of_code(code: u8) -> u32 {
    if code == 15 { 16 } else { u32::from(code) }
}

/// Returns the bits that the largest of a block's residuals needs, as a code can say it.
pub(super) fn width_of_residuals(or_of_all: u16) -> u32 {
    match u16::BITS - or_of_all.leading_zeros() {
        15 => 16,
        width_bits => width_bits,
    }
}

/// Returns the bytes of bits after blocks whose widths sum to `width_sum`: each adds
/// [`BLOCK_ROWS`] residuals to each of the 16 streams.
pub(super) fn bits_len(width_sum: usize) -> usize {
    (width_sum * BLOCK_ROWS).div_ceil(16) * LANES_BYTES
}

/// Residuals to bits.
#[derive(Clone, Debug, Default)]
pub(super) struct Packer {
    /// Full vectors, then room for the worst case.
    bytes: Vec<u8>,
    len: usize,
    open: Lanes,
    /// Bits used in `open`, 0 to 15.
    used: u32,
}

impl Packer {
    /// Forgets everything; makes room for so many blocks of 16 bits.
    pub(super) fn start(&mut self, blocks: usize) {
        let room = bits_len(blocks * 16);
        if self.bytes.len() < room {
            self.bytes.resize(room, 0);
        }
        self.len = 0;
        self.open = [0; BLOCK_COLUMNS];
        self.used = 0;
    }

    /// Adds the block at `column` of [`BLOCK_ROWS`] rows; returns its width. [bits]
    #[inline]
    pub(super) fn push_block(&mut self, rows: &[u16], stride: usize, column: usize) -> u32 {
        let values: [Lanes; BLOCK_ROWS] =
            std::array::from_fn(|row| lanes_at(rows, row * stride + column));
        let mut or: Lanes = [0; BLOCK_COLUMNS];
        for value in &values {
            for lane in 0..BLOCK_COLUMNS {
                or[lane] |= value[lane];
            }
        }
        let width_bits = width_of_residuals(or.iter().fold(0, |a, b| a | b));
        if width_bits > 0 {
            for value in &values {
                self.push(value, width_bits);
            }
        }
        width_bits
    }

    #[inline]
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

    #[inline]
    fn flush(&mut self) {
        let room = &mut self.bytes[self.len..self.len + LANES_BYTES];
        for lane in 0..BLOCK_COLUMNS {
            room[2 * lane..2 * lane + 2].copy_from_slice(&self.open[lane].to_le_bytes());
        }
        self.len += LANES_BYTES;
        self.open = [0; BLOCK_COLUMNS];
    }

    /// Appends all bits to `out`.
    pub(super) fn finish(&mut self, out: &mut Vec<u8>) {
        if self.used > 0 {
            self.flush();
        }
        out.extend_from_slice(&self.bytes[..self.len]);
    }
}

fn lanes_at(rows: &[u16], at: usize) -> Lanes {
    let mut lanes = [0; BLOCK_COLUMNS];
    lanes.copy_from_slice(&rows[at..at + BLOCK_COLUMNS]);
    lanes
}

/// Bits to residuals. The bits must be as long as the widths to come need ([`bits_len`]).
pub(super) struct Unpacker<'a> {
    bits: &'a [u8],
    open: Lanes,
    /// Bits used up in `open`; 16 when the next vector must be loaded.
    used: u32,
}

impl<'a> Unpacker<'a> {
    pub(super) fn new(bits: &'a [u8]) -> Self {
        Self { bits, open: [0; BLOCK_COLUMNS], used: 16 }
    }

    /// Takes one block of this width and writes its residuals at `column` of the rows.
    #[inline]
    pub(super) fn pop_block(
        &mut self,
        width_bits: u32,
        rows: &mut [u16],
        stride: usize,
        column: usize,
    ) {
        for row in 0..BLOCK_ROWS {
            let at = row * stride + column;
            let value = if width_bits == 0 { [0; BLOCK_COLUMNS] } else { self.pop(width_bits) };
            rows[at..at + BLOCK_COLUMNS].copy_from_slice(&value);
        }
    }

    #[inline]
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

    #[inline]
    fn load(&mut self) {
        let (vector, rest) = self.bits.split_at(LANES_BYTES);
        for lane in 0..BLOCK_COLUMNS {
            self.open[lane] = u16::from_le_bytes([vector[2 * lane], vector[2 * lane + 1]]);
        }
        self.bits = rest;
        self.used = 0;
    }
}
