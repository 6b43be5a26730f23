//! How an image is cut into stripes and blocks.

/// Stripes of an image.
pub const STRIPES: usize = 8;
/// Columns of a block.
pub const BLOCK_COLUMNS: usize = 16;
/// Rows of a block.
pub const BLOCK_ROWS: usize = 4;
/// Pixels of a block.
pub(super) const BLOCK_PIXELS: usize = BLOCK_COLUMNS * BLOCK_ROWS;

/// What each stripe starts from.
pub(super) type Bases = [u16; STRIPES];
pub(super) const BASES_BYTES: usize = 2 * STRIPES;

/// Sizes that follow from the image's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Layout {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Columns of a stripe, a multiple of [`BLOCK_COLUMNS`].
    pub(super) stripe_columns: usize,
    /// Columns of all stripes.
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
