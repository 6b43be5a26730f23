//! Prediction in the encoder: all neighbours are known, so each row is one vectorised loop.

use super::layout::{BLOCK_ROWS, Bases, Layout};

/// Returns the prediction of the median edge detector. `c` is the corner clamped between left and upper. `left + upper
/// - c` is the minimum or maximum of left and upper at an edge, and otherwise the plane through all three.
#[inline(always)]
pub(crate) fn med(left: u16, up: u16, corner: u16) -> u16 {
    let clamped = corner.min(left.max(up)).max(left.min(up));
    left.wrapping_add(up).wrapping_sub(clamped)
}

/// Maps 0, -1, 1, -2, 2 ... to 0, 1, 2, 3, 4 ...
#[inline(always)]
pub(crate) fn zigzag(residual: u16) -> u16 {
    (residual << 1) ^ (residual.cast_signed() >> 15).cast_unsigned()
}

/// Undoes [`zigzag`].
#[inline(always)]
pub(crate) fn unzigzag(code: u16) -> u16 {
    (code >> 1) ^ (code & 1).wrapping_neg()
}

/// Returns the base of each stripe: its first pixel, or 0 for a stripe beyond the image.
pub(super) fn bases(depth: &[u16], layout: &Layout) -> Bases {
    std::array::from_fn(|stripe| {
        let x = stripe * layout.stripe_columns;
        if x < layout.width { depth[x] } else { 0 }
    })
}

/// Writes the zig-zagged residuals of [`BLOCK_ROWS`] rows from `first_row`; zero for rows below the image. Columns
/// beyond the image are unchanged. `before` is the row above the image.
#[inline(always)]
pub(super) fn residual_rows(
    depth: &[u16],
    layout: &Layout,
    first_row: usize,
    before: &[u16],
    rows: &mut [u16],
) {
    let &Layout { width, height, stride, stripe_columns, .. } = layout;
    for (row, out) in rows.chunks_exact_mut(stride).enumerate().take(BLOCK_ROWS) {
        let y = first_row + row;
        if y >= height {
            out.fill(0);
            continue;
        }
        let current = &depth[y * width..(y + 1) * width];
        let above = if y == 0 { &before[..width] } else { &depth[(y - 1) * width..y * width] };
        let neighbours = current.windows(2).zip(above.windows(2));
        for (out, (current, above)) in out[1..width].iter_mut().zip(neighbours) {
            let predicted = med(current[0], above[1], above[0]);
            *out = zigzag(current[1].wrapping_sub(predicted));
        }
        // The first pixel of a stripe is predicted from the one above.
        for x in (0..width).step_by(stripe_columns) {
            out[x] = zigzag(current[x].wrapping_sub(above[x]));
        }
    }
}
