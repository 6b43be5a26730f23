//! Blocks of pixels that an ellipse alpha >= 1/255 touches: blending evaluates a splat only on them.
//!
//! A block is one vector of pixels: 4 wide, 2 or 4 high (squarer than a row, so that fewer lanes are outside the
//! ellipse). A tile has 4 columns of 8 or 4 bands of blocks. Blocks are numbered, and stored as bits, column by
//! column. If a splat fits into as many blocks as a tile has, projection finds its blocks for a vector of splats at
//! once ([`window`]), and binning shifts them to the tiles. For a larger splat, binning finds the blocks for a vector
//! of bands at once ([`Bands`]). Both use [`Ellipse::span`].

use super::bin::TILE;
use super::project::{MIN_LEVEL, Splat2d};
use super::simd::Simd;

/// Width of a block. [px]
pub(super) const BLOCK_WIDTH: usize = 4;
/// Blocks across a tile.
pub(super) const COLUMNS: usize = TILE / BLOCK_WIDTH;

/// Height of a block for vectors of `lanes` lanes. [px]
pub(super) const fn block_height(lanes: usize) -> usize {
    lanes / BLOCK_WIDTH
}

/// Rows of blocks in a tile.
pub(super) const fn bands(lanes: usize) -> usize {
    TILE / block_height(lanes)
}

/// Blocks of a splat that fits into a window of a tile's size. The window can start at any block.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub(super) struct Cover {
    /// First column of blocks of the window, from the left of the image.
    pub(super) left: u16,
    /// First band of the window, from the top of the image.
    pub(super) top: u16,
    /// Bits by column, then band, the first in the lowest bit; 0 if the splat is larger than a window.
    pub(super) blocks: u32,
}

impl Cover {
    /// Returns the blocks in the tile of the window's first block, in the tile right of it, in the tile below it, and
    /// in the diagonal one.
    #[inline(always)]
    pub(super) fn split(self, lanes: usize) -> [u32; 4] {
        let bands = bands(lanes);
        let (x, y) = (usize::from(self.left) % COLUMNS, usize::from(self.top) % bands);
        let tile = u64::from(u32::MAX) >> (32 - COLUMNS * bands);
        // Bands of each column that are in the first tile.
        let stay = tile / ((1 << bands) - 1) * ((1 << (bands - y)) - 1);
        let blocks = u64::from(self.blocks);
        let upper = (blocks & stay) << y << (bands * x);
        let lower = (blocks & !stay) >> (bands - y) << (bands * x);
        let beyond = COLUMNS * bands;
        [upper & tile, upper >> beyond, lower & tile, lower >> beyond].map(|blocks| blocks as u32)
    }
}

/// Ellipses alpha >= 1/255, one per lane; [`Splat2d`] describes the values.
#[derive(Clone, Copy)]
pub(super) struct Ellipse<S: Simd> {
    pub(super) mean_x: S::F,
    pub(super) mean_y: S::F,
    pub(super) shear: S::F,
    pub(super) width: S::F,
    pub(super) scale_y: S::F,
    pub(super) level: S::F,
    pub(super) tip_y: S::F,
    pub(super) extent_y: S::F,
}

impl<S: Simd> Ellipse<S> {
    /// Returns the same ellipse in every lane.
    #[inline(always)]
    fn of(s: S, splat: &Splat2d) -> Self {
        Self {
            mean_x: s.splat(splat.mean_x),
            mean_y: s.splat(splat.mean_y),
            shear: s.splat(splat.shear),
            width: s.splat(splat.width),
            scale_y: s.splat(splat.scale_y),
            level: s.splat(splat.level),
            tip_y: s.splat(splat.tip_y),
            extent_y: s.splat(splat.extent_y),
        }
    }

    /// Returns the part of a band of blocks that the ellipse covers. `top` is the first row of pixels of the band.
    #[inline(always)]
    fn span(&self, s: S, top: S::F) -> Span<S> {
        let first = top + s.splat(0.5) - self.mean_y;
        let last = first + s.splat(block_height(S::LANES) as f32 - 1.0);
        let zero = s.splat(0.0);
        let reaches = s.lt(first, self.extent_y) & s.lt(zero - self.extent_y, last);
        // The outermost points are the tips of the ellipse, or its intersection with the band's edge nearest to them.
        let leftmost = s.min(s.max(zero - self.tip_y, first), last);
        let rightmost = s.min(s.max(self.tip_y, first), last);
        let left = self.middle(s, leftmost) - self.half(s, leftmost);
        let right = self.middle(s, rightmost) + self.half(s, rightmost);
        Span { reaches, left, right }
    }

    /// Returns the x of the ellipse's middle at height `dy`. [px]
    #[inline(always)]
    fn middle(&self, s: S, dy: S::F) -> S::F {
        s.mul_add(self.shear, dy, self.mean_x)
    }

    /// Returns half the width of the ellipse at height `dy`. [px]
    #[inline(always)]
    fn half(&self, s: S, dy: S::F) -> S::F {
        let v = dy * self.scale_y;
        let rest = s.neg_mul_add(v, v, self.level - s.splat(MIN_LEVEL));
        s.sqrt(s.max(rest, s.splat(0.0))) * self.width
    }
}

/// Part of a band of blocks that ellipses cover, one per lane.
struct Span<S: Simd> {
    /// Whether the ellipse reaches the band.
    reaches: S::M,
    /// Leftmost x. [px]
    left: S::F,
    /// Rightmost x. [px]
    right: S::F,
}

impl<S: Simd> Span<S> {
    /// Returns whether the ellipses touch the block whose first column of pixels is `x`.
    #[inline(always)]
    fn touches(&self, s: S, x: f32) -> S::M {
        let last = x + BLOCK_WIDTH as f32 - 0.5;
        self.reaches & s.lt(self.left, s.splat(last)) & s.lt(s.splat(x + 0.5), self.right)
    }
}

/// Returns which blocks of a window the ellipses touch, within an image of `size` [px]: [`Cover::blocks`] as whole
/// numbers, its lower and its upper 16 bits. `corner` is the first pixel of the windows.
#[inline(always)]
pub(super) fn window<S: Simd>(
    s: S,
    ellipse: &Ellipse<S>,
    corner: [S::F; 2],
    size: [u32; 2],
) -> [S::F; 2] {
    let bands = bands(S::LANES);
    let [width, height] = size.map(|size| s.splat(size as f32));
    let mut halves = [s.splat(0.0); 2];
    for band in 0..bands {
        let top = corner[1] + s.splat((band * block_height(S::LANES)) as f32);
        let span = ellipse.span(s, top);
        let span = Span {
            reaches: span.reaches & s.lt(top, height),
            left: span.left - corner[0],
            right: s.min(span.right, width) - corner[0],
        };
        for column in 0..COLUMNS {
            let block = column * bands + band;
            let bit = s.splat((1u32 << (block % 16)) as f32);
            let touched = span.touches(s, (column * BLOCK_WIDTH) as f32);
            halves[block / 16] = halves[block / 16] + s.keep(touched, bit);
        }
    }
    halves
}

/// Blocks that one ellipse, equal in all lanes, touches in a vector of consecutive bands: one or more rows of tiles.
pub(super) struct Bands<S: Simd>(Span<S>);

impl<S: Simd> Bands<S> {
    /// Computes the bands from row `top` on. [px]
    #[inline(always)]
    pub(super) fn new(s: S, splat: &Splat2d, top: f32) -> Self {
        const LANE: [f32; 16] =
            [0., 1., 2., 3., 4., 5., 6., 7., 8., 9., 10., 11., 12., 13., 14., 15.];
        let height = s.splat(block_height(S::LANES) as f32);
        Self(Ellipse::of(s, splat).span(s, s.mul_add(s.load(&LANE), height, s.splat(top))))
    }

    /// Returns the bits of the bands' blocks in a column of tiles, for [`Self::of_row`]. `left` is the column's first
    /// pixel.
    #[inline(always)]
    pub(super) fn of_column(&self, s: S, left: f32) -> u64 {
        let mut bits = 0;
        for column in 0..COLUMNS {
            let touched = self.0.touches(s, left + (column * BLOCK_WIDTH) as f32);
            bits |= u64::from(s.bits(touched)) << (column * S::LANES);
        }
        bits
    }

    /// Returns the blocks of one tile from `bits`; `row` is its row of tiles within the vector.
    #[inline(always)]
    pub(super) fn of_row(bits: u64, row: usize) -> u32 {
        let bands = bands(S::LANES);
        if bands == S::LANES {
            return bits as u32;
        }
        // Moves four groups of four bits, 16 apart, next to each other.
        let groups = bits >> (bands * row) & 0x000f_000f_000f_000f;
        let pairs = (groups | groups >> 12) & 0x0000_00ff_0000_00ff;
        (pairs | pairs >> 24) as u32 & 0xffff
    }
}

#[cfg(test)]
mod tests;
