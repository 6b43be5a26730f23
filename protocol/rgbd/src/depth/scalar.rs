//! The reference: the format said a pixel and a bit at a time.

use super::blocks::{width_code, width_of_code, width_of_residuals};
use super::predict::{med, unzigzag, zigzag};
use super::{BLOCK_COLUMNS, BLOCK_ROWS, Layout, checked_parts};
use crate::codec::DecodeError;

/// Appends the encoding of a row-major image to `out`. [mm]
///
/// # Panics
/// If `depth` is empty or no whole number of rows.
pub fn encode(depth: &[u16], width: usize, out: &mut Vec<u8>) {
    assert!(width > 0 && !depth.is_empty() && depth.len().is_multiple_of(width));
    let layout = Layout::new(width, depth.len() / width);
    let mut codes = Vec::new();
    let mut streams: Vec<Vec<bool>> = vec![Vec::new(); BLOCK_COLUMNS];
    for block in 0..layout.blocks() {
        let residuals = pixels_of_block(&layout, block).map(|(x, y)| {
            if x >= layout.width || y >= layout.height {
                return 0;
            }
            zigzag(depth[y * width + x].wrapping_sub(predicted(depth, &layout, x, y)))
        });
        let residuals: Vec<u16> = residuals.collect();
        let width_bits = width_of_residuals(residuals.iter().fold(0, |a, b| a | b));
        codes.push(width_code(width_bits));
        for (index, residual) in residuals.iter().enumerate() {
            let stream = &mut streams[index % BLOCK_COLUMNS];
            stream.extend((0..width_bits).map(|bit| residual >> bit & 1 == 1));
        }
    }
    out.extend(codes.chunks(2).map(|pair| pair[0] | pair.get(1).unwrap_or(&0) << 4));
    for word in 0..streams[0].len().div_ceil(16) {
        for stream in &streams {
            let bit = |n: usize| u16::from(stream.get(16 * word + n) == Some(&true)) << n;
            out.extend((0..16).map(bit).fold(0, |a, b| a | b).to_le_bytes());
        }
    }
}

/// Decodes into a row-major image. [mm]
///
/// # Errors
/// [`DecodeError::Depth`] unless `bytes` are as long as their own table of widths says.
///
/// # Panics
/// If `depth` is empty or no whole number of rows.
pub fn decode(bytes: &[u8], width: usize, depth: &mut [u16]) -> Result<(), DecodeError> {
    assert!(width > 0 && !depth.is_empty() && depth.len().is_multiple_of(width));
    let layout = Layout::new(width, depth.len() / width);
    let (table, bits) = checked_parts(bytes, &layout)?;
    let mut residuals = vec![0; depth.len()];
    let mut used = 0;
    for block in 0..layout.blocks() {
        let width_bits = width_of_code(table[block / 2] >> (4 * (block % 2)) & 15) as usize;
        for (index, (x, y)) in pixels_of_block(&layout, block).enumerate() {
            let (row, column) = (index / BLOCK_COLUMNS, index % BLOCK_COLUMNS);
            let bit = |n: usize| {
                let at = used + row * width_bits + n;
                let byte = 2 * (at / 16 * BLOCK_COLUMNS + column) + at % 16 / 8;
                u16::from(bits[byte] >> (at % 8) & 1) << n
            };
            if x < layout.width && y < layout.height {
                residuals[y * width + x] = (0..width_bits).map(bit).fold(0, |a, b| a | b);
            }
        }
        used += BLOCK_ROWS * width_bits;
    }
    for y in 0..layout.height {
        for x in 0..layout.width {
            let residual = unzigzag(residuals[y * width + x]);
            depth[y * width + x] = predicted(depth, &layout, x, y).wrapping_add(residual);
        }
    }
    Ok(())
}

/// The pixels of a block, row by row.
fn pixels_of_block(layout: &Layout, block: usize) -> impl Iterator<Item = (usize, usize)> {
    let x0 = block % layout.blocks_across * BLOCK_COLUMNS;
    let y0 = block / layout.blocks_across * BLOCK_ROWS;
    (0..BLOCK_ROWS).flat_map(move |dy| (0..BLOCK_COLUMNS).map(move |dx| (x0 + dx, y0 + dy)))
}

/// What a pixel is predicted to be from those before it in its band.
fn predicted(depth: &[u16], layout: &Layout, x: usize, y: usize) -> u16 {
    let top = y.is_multiple_of(layout.band_rows);
    let at = |x: Option<usize>, y: Option<usize>| match (x, y) {
        (Some(x), Some(y)) => depth[y * layout.width + x],
        _ => 0,
    };
    let (left, above) = (x.checked_sub(1), if top { None } else { y.checked_sub(1) });
    med(at(left, Some(y)), at(Some(x), above), at(left, above))
}
