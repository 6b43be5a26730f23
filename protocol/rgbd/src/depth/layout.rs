//! Division of an image into stripes and blocks.

/// Number of stripes of an image.
pub const STRIPES: usize = 8;
/// Number of columns of a block.
pub const BLOCK_COLUMNS: usize = 16;
/// Number of rows of a block.
pub const BLOCK_ROWS: usize = 4;
/// Number of pixels of a block.
pub(super) const BLOCK_PIXELS: usize = BLOCK_COLUMNS * BLOCK_ROWS;

/// First prediction of each stripe.
pub(super) type Bases = [u16; STRIPES];
pub(super) const BASES_BYTES: usize = 2 * STRIPES;

/// Sizes derived from the size of the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Layout {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Number of columns of a stripe, a multiple of [`BLOCK_COLUMNS`].
    pub(super) stripe_columns: usize,
    /// Number of columns of all stripes.
    pub(super) stride: usize,
    pub(super) blocks_across: usize,
    pub(super) blocks_down: usize,
}

impl Layout {
    pub(super) fn new(width: usize, height: usize) -> Self {
        let stripe_columns = width.div_ceil(STRIPES).next_multiple_of(BLOCK_COLUMNS);
        Self {
            width,
            height,
            stripe_columns,
            stride: STRIPES * stripe_columns,
            blocks_across: width.div_ceil(BLOCK_COLUMNS),
            blocks_down: height.div_ceil(BLOCK_ROWS),
        }
    }

    pub(super) fn blocks(&self) -> usize {
        self.blocks_across * self.blocks_down
    }
}
