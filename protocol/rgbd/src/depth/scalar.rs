//! Reference implementation of the format: one pixel and one bit at a time.

use super::Parts;
use super::blocks::Shape;
use super::layout::{BLOCK_COLUMNS, BLOCK_ROWS, Bases, Layout};
use super::predict::{bases, med, unzigzag, zigzag};
use crate::error::DecodeError;

/// Appends the encoding of a row-major image to `out`. [mm]
///
/// # Panics
/// If `depth` is empty or not a whole number of rows.
pub fn encode(depth: &[u16], width: usize, out: &mut Vec<u8>) {
    assert!(width > 0 && !depth.is_empty() && depth.len().is_multiple_of(width));
    let layout = Layout::new(width, depth.len() / width);
    let bases = bases(depth, &layout);
    let (mut table, mut masks) = (Vec::new(), Vec::new());
    let mut low: Vec<Vec<bool>> = vec![Vec::new(); BLOCK_COLUMNS];
    let mut high: Vec<bool> = Vec::new();
    for block in 0..layout.blocks() {
        let residuals = pixels_of_block(&layout, block).map(|(x, y)| {
            if x >= layout.width || y >= layout.height {
                return 0;
            }
            zigzag(depth[y * width + x].wrapping_sub(predicted(depth, &bases, &layout, x, y)))
        });
        let residuals: Vec<u16> = residuals.collect();
        let top = 16 - residuals.iter().max().map_or(16, |most| most.leading_zeros());
        let (shape, _) = Shape::cheapest(top, |bits| longer_than(&residuals, bits));
        table.push(shape.code());
        for (index, residual) in residuals.iter().enumerate() {
            let bits = |from, count| (from..from + count).map(|bit| residual >> bit & 1 == 1);
            low[index % BLOCK_COLUMNS].extend(bits(0, shape.low));
            if shape.high > 0 {
                let named = residual >> shape.low != 0;
                masks.push(named);
                high.extend(bits(shape.low, if named { shape.high } else { 0 }));
            }
        }
    }
    out.extend(bases.iter().flat_map(|base| base.to_le_bytes()));
    out.extend(table);
    for word in 0..low[0].len().div_ceil(16) {
        for stream in &low {
            let bit = |n: usize| u16::from(stream.get(16 * word + n) == Some(&true)) << n;
            out.extend((0..16).map(bit).fold(0, |a, b| a | b).to_le_bytes());
        }
    }
    for stream in [masks, high] {
        out.extend(stream.chunks(8).map(|byte| {
            byte.iter().enumerate().fold(0, |all, (n, &bit)| all | u8::from(bit) << n)
        }));
    }
}

/// Decodes to a row-major image. [mm]
///
/// # Errors
/// [`DecodeError::Depth`] unless the length of `bytes` matches their own table.
///
/// # Panics
/// If `depth` is empty or not a whole number of rows.
pub fn decode(bytes: &[u8], width: usize, depth: &mut [u16]) -> Result<(), DecodeError> {
    assert!(width > 0 && !depth.is_empty() && depth.len().is_multiple_of(width));
    let layout = Layout::new(width, depth.len() / width);
    let parts = Parts::checked(bytes, &layout)?;
    let bit_of = |stream: &[u8], at: usize| stream[at / 8] >> (at % 8) & 1;
    let mut residuals = vec![0; depth.len()];
    let (mut low_at, mut mask_at, mut high_at) = (0, 0, 0);
    for block in 0..layout.blocks() {
        let shape = Shape::of_code(parts.table[block]).expect("the table was checked");
        for (index, (x, y)) in pixels_of_block(&layout, block).enumerate() {
            let (row, column) = (index / BLOCK_COLUMNS, index % BLOCK_COLUMNS);
            let mut residual = 0;
            for n in 0..shape.low {
                let at = low_at + row * shape.low as usize + n as usize;
                let at = 16 * (at / 16 * BLOCK_COLUMNS + column) + at % 16;
                residual |= u16::from(bit_of(parts.low, at)) << n;
            }
            if shape.high > 0 {
                if bit_of(parts.masks, mask_at) == 1 {
                    for n in 0..shape.high {
                        residual |= u16::from(bit_of(parts.high, high_at)) << (shape.low + n);
                        high_at += 1;
                    }
                }
                mask_at += 1;
            }
            if x < layout.width && y < layout.height {
                residuals[y * width + x] = residual;
            }
        }
        low_at += BLOCK_ROWS * shape.low as usize;
    }
    for y in 0..layout.height {
        for x in 0..layout.width {
            let residual = unzigzag(residuals[y * width + x]);
            depth[y * width + x] =
                predicted(depth, &parts.bases, &layout, x, y).wrapping_add(residual);
        }
    }
    Ok(())
}

/// Returns the mask of residuals with more than `bits` bits, the first in bit 0.
pub(super) fn longer_than(residuals: &[u16], bits: u32) -> u64 {
    residuals.iter().rev().fold(0, |mask, &residual| mask << 1 | u64::from(residual >> bits != 0))
}

/// Returns the pixels of a block, row by row.
fn pixels_of_block(layout: &Layout, block: usize) -> impl Iterator<Item = (usize, usize)> {
    let x0 = block % layout.blocks_across * BLOCK_COLUMNS;
    let y0 = block / layout.blocks_across * BLOCK_ROWS;
    (0..BLOCK_ROWS).flat_map(move |dy| (0..BLOCK_COLUMNS).map(move |dx| (x0 + dx, y0 + dy)))
}

/// Returns the prediction of a pixel from earlier ones in its stripe.
fn predicted(depth: &[u16], bases: &Bases, layout: &Layout, x: usize, y: usize) -> u16 {
    let base = bases[x / layout.stripe_columns];
    let above = |x: usize| if y == 0 { base } else { depth[(y - 1) * layout.width + x] };
    if x.is_multiple_of(layout.stripe_columns) {
        return above(x);
    }
    med(depth[y * layout.width + x - 1], above(x), above(x - 1))
}
