//! Pass 4: which splats touch which tile, each list nearest first.
//!
//! The depth order is cut into slices. Each slice walks its splats from near to far and notes a
//! (tile, slot) pair for every tile that the ellipse alpha >= 1/255 really touches; the counts give
//! each slice its places in every tile's list; then all slices scatter. Lists come out ordered
//! because slices are, so nothing is sorted per tile.
//!
//! Budget: 48 bytes read per splat in random order (hence the prefetch), 12 written per pair.

use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use rayon::prelude::*;

use super::cull::ObjectView;
use super::project::{MIN_LEVEL, Projected, Splat2d};
use super::simd::{Kernel, Simd};

/// Side of a tile. [px]
pub(super) const TILE: usize = 16;
/// Near slices hold the large splats: several per thread even the load.
const SLICES_PER_THREAD: usize = 4;
const MAX_SLICES: usize = 32;
const MIN_SLICE: usize = 1024;
/// How far ahead a splat's record is asked for: some 100 ns of work.
const PREFETCH: usize = 8;

/// Lists of slots per tile.
#[derive(Debug, Default)]
pub(super) struct Bins {
    pub(super) tiles_x: usize,
    pub(super) tiles_y: usize,
    slices: Vec<Slice>,
    /// Where each tile's list starts; one more than there are tiles.
    starts: Vec<u32>,
    entries: Vec<AtomicU32>,
}

#[derive(Debug, Default)]
struct Slice {
    /// Tile in the upper half, slot in the lower.
    pairs: Vec<u64>,
    /// Per tile: how many pairs; later, the place of the next.
    places: Vec<u32>,
}

impl Bins {
    /// Returns the slots of the splats that touch a tile, nearest first.
    pub(super) fn list(&self, tile: usize) -> &[AtomicU32] {
        &self.entries[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }

    /// Returns the number of (tile, splat) pairs.
    pub(super) fn pairs(&self) -> usize {
        self.starts.last().map_or(0, |&end| end as usize)
    }

    /// Bins all splats in depth order.
    pub(super) fn bin<S: Simd>(
        &mut self,
        simd: S,
        view: &ObjectView,
        projected: &Projected,
        order: &[AtomicU32],
    ) {
        self.tiles_x = (view.width_px as usize).div_ceil(TILE);
        self.tiles_y = (view.height_px as usize).div_ceil(TILE);
        let tiles = self.tiles_x * self.tiles_y;
        let wanted = rayon::current_num_threads() * SLICES_PER_THREAD;
        let count = (order.len() / MIN_SLICE).clamp(1, wanted.min(MAX_SLICES));
        // Never fewer than before: their buffers are kept.
        if self.slices.len() < count {
            self.slices.resize_with(count, Slice::default);
        }
        let slices = &mut self.slices[..count];
        let tiles_x = self.tiles_x;
        slices.par_iter_mut().enumerate().with_max_len(1).for_each(|(i, slice)| {
            slice.places.clear();
            slice.places.resize(tiles, 0);
            let order = &order[order.len() * i / count..order.len() * (i + 1) / count];
            simd.run(BinSlice { view, tiles_x, projected, order, slice });
        });

        self.starts.clear();
        let mut place = 0;
        for tile in 0..tiles {
            self.starts.push(place);
            for slice in &mut *slices {
                let pairs = slice.places[tile];
                slice.places[tile] = place;
                place += pairs;
            }
        }
        self.starts.push(place);
        if self.entries.len() < place as usize {
            self.entries.resize_with(place as usize, AtomicU32::default);
        }
        let entries = &self.entries;
        slices.par_iter_mut().with_max_len(1).for_each(|slice| {
            for &pair in &slice.pairs {
                let place = &mut slice.places[(pair >> 32) as usize];
                // Disjoint from all other places; atomic because no borrow can say so.
                entries[*place as usize].store(pair as u32, Relaxed);
                *place += 1;
            }
        });
    }
}

/// Notes the pairs of one slice.
struct BinSlice<'a> {
    view: &'a ObjectView,
    tiles_x: usize,
    projected: &'a Projected,
    order: &'a [AtomicU32],
    slice: &'a mut Slice,
}

impl Kernel for BinSlice<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { view, tiles_x, projected, order, slice } = self;
        let width = view.width_px as f32;
        let mut len = 0;
        for (i, slot) in order.iter().enumerate() {
            if let Some(ahead) = order.get(i + PREFETCH) {
                s.prefetch(&projected.boxes[ahead.load(Relaxed) as usize]);
            }
            let slot = slot.load(Relaxed);
            let tiles = projected.boxes[slot as usize];
            let (left, right) = (usize::from(tiles.left), usize::from(tiles.right));
            let (top, bottom) = (usize::from(tiles.top), usize::from(tiles.bottom));
            if top == bottom || left == right {
                // In one row or column of tiles an ellipse touches all that its box does.
                for tile_y in top..=bottom {
                    note(slice, &mut len, tile_y * tiles_x, left, right, slot);
                }
                continue;
            }
            let splat = &projected.splats[slot as usize];
            for tile_y in top..=bottom {
                let first = (tile_y * TILE) as f32 + 0.5;
                let last = first + (TILE - 1) as f32;
                let (low, high) = splat.span(first, last);
                let columns = centres(low, high, width);
                if !columns.is_empty() {
                    let (left, right) = (columns.start / TILE, (columns.end - 1) / TILE);
                    note(slice, &mut len, tile_y * tiles_x, left, right, slot);
                }
            }
        }
        slice.pairs.truncate(len);
    }
}

/// Notes a pair for each tile from `left` to `right` of a row of tiles.
#[inline(always)]
fn note(slice: &mut Slice, len: &mut usize, row: usize, left: usize, right: usize, slot: u32) {
    // At least one: where rounding leaves none, the pair is of a tile next to the splat.
    let count = right.saturating_sub(left) + 1;
    if slice.pairs.len() < *len + count {
        slice.pairs.resize((*len + count) * 2, 0);
    }
    let tiles = row + left..row + left + count;
    for (pair, tile) in slice.pairs[*len..*len + count].iter_mut().zip(tiles) {
        *pair = (tile as u64) << 32 | u64::from(slot);
        slice.places[tile] += 1;
    }
    *len += count;
}

/// Returns the pixels of a row (or column) of `size` whose centres lie from `low` to `high`.
#[inline(always)]
fn centres(low: f32, high: f32, size: f32) -> Range<usize> {
    // Clamped below at 0, where truncation is rounding down; `as` saturates above.
    let low = (low - 0.5).max(0.0).min(size);
    let high = (high + 0.5).max(0.0).min(size);
    let start = low as usize;
    start + usize::from((start as f32) < low)..high as usize
}

impl Splat2d {
    /// Returns the leftmost and rightmost x of the ellipse alpha >= 1/255 between two ys that it
    /// reaches. [px]
    #[inline(always)]
    fn span(&self, top: f32, bottom: f32) -> (f32, f32) {
        let (top, bottom) = (top - self.mean_y, bottom - self.mean_y);
        // The outermost points are the ellipse's tips, or where it leaves the band next to them.
        (
            self.edge((-self.tip_y).max(top).min(bottom), -1.0),
            self.edge(self.tip_y.max(top).min(bottom), 1.0),
        )
    }

    /// Returns the x of the ellipse's left (-1) or right (1) edge at a height. [px]
    #[inline(always)]
    fn edge(&self, dy: f32, side: f32) -> f32 {
        let left = (self.level - MIN_LEVEL - self.falloff_y * dy * dy).max(0.0);
        self.mean_x + self.shear * dy + side * (left / self.falloff_x).sqrt()
    }
}
