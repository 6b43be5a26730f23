//! Pass 4: lists, for each tile, the splats that touch it and their blocks of pixels, from near to far.
//!
//! The depth order is cut into slices. Each slice processes its splats from near to far, and appends an entry to the
//! list of every tile in which the ellipse alpha >= 1/255 touches a block. A slice's list of a tile consists of
//! pieces of two cache lines, which are written once and can be anywhere in memory. Then the pieces of a tile are
//! copied next to each other, slice by slice. Lists are in depth order because slices are, so no sorting per tile is
//! needed.
//!
//! Budget: 8 bytes read per splat in random order, 64 for a large one (therefore the prefetch); 16 written per pair.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use rayon::prelude::*;

use super::cover::{self, Bands, COLUMNS};
use super::cull::ObjectView;
use super::project::{Projected, Splat2d, TileBox};
use super::simd::{Kernel, Simd};

/// Side of a tile. [px]
pub(super) const TILE: usize = 16;
/// Near slices contain the large splats: several slices per thread balance the load.
const SLICES_PER_THREAD: usize = 4;
const MAX_SLICES: usize = 32;
const MIN_SLICE: usize = 1024;
/// Entries per piece: two cache lines.
const PIECE: usize = 16;
/// Marks the absence of a piece.
const NONE: u32 = u32::MAX;
/// Prefetch distance of a splat's record, and twice of its cover: about 300 ns of work.
const PREFETCH: usize = 16;

/// Lists of splat slots per tile.
#[derive(Debug, Default)]
pub(super) struct Bins {
    pub(super) tiles_x: usize,
    pub(super) tiles_y: usize,
    slices: Vec<Slice>,
    /// Start of each tile's list, and the end of the last list.
    starts: Vec<u32>,
    entries: Vec<AtomicU64>,
}

/// Splat in the list of a tile.
#[derive(Clone, Copy, Debug)]
pub(super) struct Entry {
    pub(super) slot: usize,
    /// Blocks that the splat touches, by column, then band, the first in the lowest bit.
    pub(super) blocks: u32,
}

impl Entry {
    /// Decodes an entry of [`Bins::list`].
    #[inline(always)]
    pub(super) fn of(entry: &AtomicU64) -> Self {
        let entry = entry.load(Relaxed);
        Self { slot: entry as u32 as usize, blocks: (entry >> 32) as u32 }
    }
}

/// Lists of one slice.
#[derive(Debug, Default)]
struct Slice {
    /// Entries, piece by piece.
    entries: Vec<u64>,
    /// Previous piece of each piece in its tile's list.
    before: Vec<u32>,
    /// Number of pieces.
    pieces: usize,
    /// Per tile: position of the next entry. The piece there is never full.
    next: Vec<u32>,
    /// Per tile: number of entries in its full pieces.
    full: Vec<u32>,
}

impl Bins {
    /// Returns the splats that touch a tile, from near to far; decode each with [`Entry::of`].
    pub(super) fn list(&self, tile: usize) -> &[AtomicU64] {
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
        // Never fewer than before, to keep their buffers.
        if self.slices.len() < count {
            self.slices.resize_with(count, Slice::default);
        }
        let slices = &mut self.slices[..count];
        let tiles_x = self.tiles_x;
        slices.par_iter_mut().enumerate().with_max_len(1).for_each(|(i, slice)| {
            // Extra tiles for windows that start within the last tiles and extend beyond them; they stay empty.
            slice.start(tiles + tiles_x + 2);
            let order = &order[order.len() * i / count..order.len() * (i + 1) / count];
            simd.run(BinSlice { tiles_x, projected, order, slice });
        });

        self.starts.clear();
        let mut place = 0;
        for tile in 0..tiles {
            self.starts.push(place);
            place += slices.iter().map(|slice| slice.len(tile)).sum::<u32>();
        }
        self.starts.push(place);
        if self.entries.len() < place as usize {
            self.entries.resize_with(place as usize, AtomicU64::default);
        }
        let (starts, entries, slices) = (&self.starts, &self.entries, &*slices);
        (0..tiles).into_par_iter().with_min_len(8).for_each(|tile| {
            let mut start = starts[tile] as usize;
            for slice in slices {
                let end = start + slice.len(tile) as usize;
                // Disjoint from all other ranges. Atomic, because the borrow checker cannot prove that.
                slice.copy(tile, &entries[start..end]);
                start = end;
            }
        });
    }
}

impl Slice {
    /// Clears the slice and gives each tile an empty piece.
    fn start(&mut self, tiles: usize) {
        self.pieces = tiles;
        self.next.clear();
        self.next.extend((0..tiles).map(|tile| (tile * PIECE) as u32));
        self.full.clear();
        self.full.resize(tiles, 0);
        self.before.clear();
        self.before.resize(tiles, NONE);
        self.make_room(0);
    }

    /// Returns the number of entries of a tile.
    fn len(&self, tile: usize) -> u32 {
        self.full[tile] + self.next[tile] % PIECE as u32
    }

    /// Copies the entries of a tile to `to`, which has the same length.
    fn copy(&self, tile: usize, mut to: &[AtomicU64]) {
        let next = self.next[tile] as usize;
        let (mut piece, mut count) = (next / PIECE, next % PIECE);
        // Starts at the last piece, the only one that the tile refers to.
        loop {
            let (earlier, later) = to.split_at(to.len() - count);
            for (to, &entry) in later.iter().zip(&self.entries[piece * PIECE..]) {
                to.store(entry, Relaxed);
            }
            if self.before[piece] == NONE {
                return;
            }
            (to, piece, count) = (earlier, self.before[piece] as usize, PIECE);
        }
    }

    /// Reserves memory for `count` more entries, each of which may start a piece.
    #[inline(always)]
    fn make_room(&mut self, count: usize) {
        let pieces = self.pieces + count;
        if self.entries.len() < pieces * PIECE {
            self.entries.resize(2 * pieces * PIECE, 0);
        }
        if self.before.len() < pieces {
            self.before.resize(2 * pieces, NONE);
        }
    }

    /// Adds an entry if it has blocks. Branch-free, because the branch is hard to predict. Requires room.
    #[inline(always)]
    fn note(&mut self, tile: usize, slot: u32, blocks: u32) {
        let place = self.next[tile];
        self.entries[place as usize] = u64::from(blocks) << 32 | u64::from(slot);
        let next = place + u32::from(blocks != 0);
        self.next[tile] = next;
        if next / PIECE as u32 != place / PIECE as u32 {
            self.before[self.pieces] = place / PIECE as u32;
            self.next[tile] = (self.pieces * PIECE) as u32;
            self.full[tile] += PIECE as u32;
            self.pieces += 1;
        }
    }
}

/// Adds the pairs of one slice.
struct BinSlice<'a> {
    tiles_x: usize,
    projected: &'a Projected,
    order: &'a [AtomicU32],
    slice: &'a mut Slice,
}

impl Kernel for BinSlice<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { tiles_x, projected, order, slice } = self;
        for (i, slot) in order.iter().enumerate() {
            if let Some(ahead) = order.get(i + 2 * PREFETCH) {
                s.prefetch(&projected.covers[ahead.load(Relaxed) as usize]);
            }
            if let Some(ahead) = order.get(i + PREFETCH) {
                // For a small splat, prefetches a line that is already cached: avoids an unpredictable branch.
                let ahead = ahead.load(Relaxed) as usize;
                let is_large = projected.covers[ahead].blocks == 0;
                s.prefetch(&projected.splats[if is_large { ahead } else { 0 }]);
            }
            let slot = slot.load(Relaxed);
            let cover = projected.covers[slot as usize];
            if cover.blocks == 0 {
                note_large(s, tiles_x, &projected.splats[slot as usize], slot, slice);
                continue;
            }
            let column = usize::from(cover.left) / COLUMNS;
            let row = usize::from(cover.top) / cover::bands(S::LANES);
            let tile = row * tiles_x + column;
            let [first, right, below, last] = cover.split(S::LANES);
            slice.make_room(4);
            for (tile, blocks) in [
                (tile, first),
                (tile + 1, right),
                (tile + tiles_x, below),
                (tile + tiles_x + 1, last),
            ] {
                slice.note(tile, slot, blocks);
            }
        }
    }
}

/// Adds the pairs of a splat that may touch any number of tiles.
#[inline(always)]
fn note_large<S: Simd>(s: S, tiles_x: usize, splat: &Splat2d, slot: u32, slice: &mut Slice) {
    let TileBox { left, right, top, bottom } = splat.tiles;
    let columns = usize::from(left)..usize::from(right) + 1;
    let last_row = usize::from(bottom);
    // Rows of tiles in a vector of bands.
    let step = S::LANES / cover::bands(S::LANES);
    for row in (usize::from(top)..=last_row).step_by(step) {
        let bands = Bands::new(s, splat, (row * TILE) as f32);
        slice.make_room(columns.len() * step);
        for column in columns.clone() {
            let bits = bands.of_column(s, (column * TILE) as f32);
            for (i, row) in (row..=last_row).take(step).enumerate() {
                slice.note(row * tiles_x + column, slot, Bands::<S>::of_row(bits, i));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn pieces_keep_entries_with_blocks_in_order(
            noted in prop::collection::vec((0usize..5, 0u32..3), 0..400),
        ) {
            let mut slice = Slice::default();
            // The content of an earlier image must not matter.
            for _ in 0..2 {
                slice.start(5);
                for (slot, &(tile, blocks)) in noted.iter().enumerate() {
                    slice.make_room(1);
                    slice.note(tile, slot as u32, blocks);
                }
            }
            for tile in 0..5 {
                let entries: Vec<AtomicU64> =
                    (0..slice.len(tile)).map(|_| AtomicU64::default()).collect();
                slice.copy(tile, &entries);
                let kept = entries.iter().map(Entry::of).map(|e| (e.slot, e.blocks));
                let of_tile = noted.iter().enumerate().filter(|(_, of)| of.0 == tile);
                let expected =
                    of_tile.map(|(slot, of)| (slot, of.1)).filter(|&(_, blocks)| blocks != 0);
                prop_assert!(kept.eq(expected), "tile {}", tile);
            }
        }
    }
}
