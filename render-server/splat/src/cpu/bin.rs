//! Pass 4: which splats touch which tile, and which of its blocks, each list nearest first.
//!
//! The depth order is cut into slices. Each slice walks its splats from near to far and notes a
//! pair for every tile of which the ellipse alpha >= 1/255 touches a block; the counts give
//! each slice its places in every tile's list; then all slices scatter. Lists come out ordered
//! because slices are, so nothing is sorted per tile.
//!
//! Budget: 8 bytes read per splat in random order, 64 of a large one (hence the prefetch); 20 written per pair.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use rayon::prelude::*;

use super::cover::{self, Bands, COLUMNS};
use super::cull::ObjectView;
use super::project::{Projected, Splat2d, TileBox};
use super::simd::{Kernel, Simd};

/// Side of a tile. [px]
pub(super) const TILE: usize = 16;
/// Near slices hold the large splats: several per thread even the load.
const SLICES_PER_THREAD: usize = 4;
const MAX_SLICES: usize = 32;
const MIN_SLICE: usize = 1024;
/// How far ahead a splat's record is asked for, and twice as far its cover: some 300 ns of work.
const PREFETCH: usize = 16;

/// Lists of slots per tile.
#[derive(Debug, Default)]
pub(super) struct Bins {
    pub(super) tiles_x: usize,
    pub(super) tiles_y: usize,
    slices: Vec<Slice>,
    /// Where each tile's list starts; one more than there are tiles.
    starts: Vec<u32>,
    entries: Vec<AtomicU64>,
}

/// A splat of a tile's list.
#[derive(Clone, Copy, Debug)]
pub(super) struct Entry {
    pub(super) slot: usize,
    /// The blocks it touches, by column, then band, the first lowest.
    pub(super) blocks: u32,
}

impl Entry {
    /// Takes an entry of [`Bins::list`] apart.
    #[inline(always)]
    pub(super) fn of(entry: &AtomicU64) -> Self {
        let entry = entry.load(Relaxed);
        Self { slot: entry as u32 as usize, blocks: (entry >> 32) as u32 }
    }
}

#[derive(Debug, Default)]
struct Slice {
    pairs: Vec<Pair>,
    /// Per tile: how many pairs; later, the place of the next.
    places: Vec<u32>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Pair {
    tile: u32,
    slot: u32,
    /// [`Entry::blocks`].
    blocks: u32,
}

impl Bins {
    /// Returns the splats that touch a tile, nearest first, each to be read by [`Entry::of`].
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
        // Never fewer than before: their buffers are kept.
        if self.slices.len() < count {
            self.slices.resize_with(count, Slice::default);
        }
        let slices = &mut self.slices[..count];
        let tiles_x = self.tiles_x;
        slices.par_iter_mut().enumerate().with_max_len(1).for_each(|(i, slice)| {
            slice.places.clear();
            // Where a window that lies within the last tiles would go on: never more than 0.
            slice.places.resize(tiles + tiles_x + 2, 0);
            let order = &order[order.len() * i / count..order.len() * (i + 1) / count];
            simd.run(BinSlice { tiles_x, projected, order, slice });
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
            self.entries.resize_with(place as usize, AtomicU64::default);
        }
        let entries = &self.entries;
        slices.par_iter_mut().with_max_len(1).for_each(|slice| {
            for &Pair { tile, slot, blocks } in &slice.pairs {
                let place = &mut slice.places[tile as usize];
                // Disjoint from all other places; atomic because no borrow can say so.
                let entry = u64::from(blocks) << 32 | u64::from(slot);
                entries[*place as usize].store(entry, Relaxed);
                *place += 1;
            }
        });
    }
}

/// Notes the pairs of one slice.
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
        let mut len = 0;
        for (i, slot) in order.iter().enumerate() {
            if let Some(ahead) = order.get(i + 2 * PREFETCH) {
                s.prefetch(&projected.covers[ahead.load(Relaxed) as usize]);
            }
            if let Some(ahead) = order.get(i + PREFETCH) {
                // Of a small splat, what is there already: no branch to foretell.
                let ahead = ahead.load(Relaxed) as usize;
                let is_large = projected.covers[ahead].blocks == 0;
                s.prefetch(&projected.splats[if is_large { ahead } else { 0 }]);
            }
            let slot = slot.load(Relaxed);
            let cover = projected.covers[slot as usize];
            if cover.blocks == 0 {
                note_large(s, tiles_x, &projected.splats[slot as usize], slot, slice, &mut len);
                continue;
            }
            let column = usize::from(cover.left) / COLUMNS;
            let row = usize::from(cover.top) / cover::bands(S::LANES);
            let tile = row * tiles_x + column;
            let [first, right, below, last] = cover.split(S::LANES);
            make_room(slice, len, 4);
            for (tile, blocks) in [
                (tile, first),
                (tile + 1, right),
                (tile + tiles_x, below),
                (tile + tiles_x + 1, last),
            ] {
                note(slice, &mut len, tile, slot, blocks);
            }
        }
        slice.pairs.truncate(len);
    }
}

/// Notes the pairs of a splat that may touch any number of tiles.
#[inline(always)]
fn note_large<S: Simd>(
    s: S,
    tiles_x: usize,
    splat: &Splat2d,
    slot: u32,
    slice: &mut Slice,
    len: &mut usize,
) {
    let TileBox { left, right, top, bottom } = splat.tiles;
    let columns = usize::from(left)..usize::from(right) + 1;
    let last_row = usize::from(bottom);
    // A vector of bands is some rows of tiles.
    let step = S::LANES / cover::bands(S::LANES);
    for row in (usize::from(top)..=last_row).step_by(step) {
        let bands = Bands::new(s, splat, (row * TILE) as f32);
        make_room(slice, *len, columns.len() * step);
        for column in columns.clone() {
            let bits = bands.of_column(s, (column * TILE) as f32);
            for (i, row) in (row..=last_row).take(step).enumerate() {
                note(slice, len, row * tiles_x + column, slot, Bands::<S>::of_row(bits, i));
            }
        }
    }
}

/// Makes room for more pairs.
#[inline(always)]
fn make_room(slice: &mut Slice, len: usize, count: usize) {
    if slice.pairs.len() < len + count {
        slice.pairs.resize((len + count) * 2, Pair::default());
    }
}

/// Notes a pair if it has blocks, without a branch; there must be room.
#[inline(always)]
fn note(slice: &mut Slice, len: &mut usize, tile: usize, slot: u32, blocks: u32) {
    let counts = blocks != 0;
    slice.pairs[*len] = Pair { tile: tile as u32, slot, blocks };
    slice.places[tile] += u32::from(counts);
    *len += usize::from(counts);
}
