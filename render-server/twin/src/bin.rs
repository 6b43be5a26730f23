//! Pass 2: bins projected Gaussians into tiles, nearest first, and indexes the bins by Gaussian for the backward pass.
//!
//! Single-threaded: a radix sort by depth, then the pairs in that order, scattered to tiles. It takes about 10 ns per
//! Gaussian and 5 ns per pair.

use crate::planes::TILE;
use crate::project::{Flat, MIN_LEVEL};

/// Gaussians of each tile, and the entries of each Gaussian in these lists.
#[derive(Debug, Default)]
pub(crate) struct Bins {
    pub(crate) tiles_x: usize,
    /// Start of each tile's list in `entries`; length: number of tiles + 1.
    pub(crate) starts: Vec<u32>,
    /// Indices of flat Gaussians, tile by tile, nearest first.
    pub(crate) entries: Vec<u32>,
    /// Start of each Gaussian's indices in `places`; length: number of Gaussians + 1.
    pub(crate) firsts: Vec<u32>,
    /// Indices into `entries`, Gaussian by Gaussian.
    pub(crate) places: Vec<u32>,
    /// Indices in order of depth, and the sort's second buffer.
    order: Vec<u32>,
    spare: Vec<u32>,
    /// Tile of each pair, Gaussian by Gaussian in order of depth.
    tiles: Vec<u32>,
    counts: Vec<u32>,
}

impl Bins {
    /// Bins the projected Gaussians of an image.
    pub(crate) fn bin(&mut self, flats: &[Flat], width: usize, height: usize) {
        self.tiles_x = width.div_ceil(TILE);
        let tiles = self.tiles_x * height.div_ceil(TILE);
        self.sort(flats);
        self.tiles.clear();
        self.counts.clear();
        self.counts.resize(tiles, 0);
        self.firsts.clear();
        self.firsts.resize(flats.len() + 1, 0);
        for &i in &self.order {
            let before = self.tiles.len();
            note(&flats[i as usize], self.tiles_x, width, height, &mut self.tiles);
            for &tile in &self.tiles[before..] {
                self.counts[tile as usize] += 1;
            }
            self.firsts[i as usize + 1] = (self.tiles.len() - before) as u32;
        }
        for i in 1..self.firsts.len() {
            self.firsts[i] += self.firsts[i - 1];
        }
        self.starts.clear();
        let mut place = 0;
        for count in &mut self.counts {
            self.starts.push(place);
            place += std::mem::replace(count, place);
        }
        self.starts.push(place);
        self.entries.resize(place as usize, 0);
        self.places.resize(place as usize, 0);
        let mut pair = 0;
        for &i in &self.order {
            let (first, end) = (self.firsts[i as usize], self.firsts[i as usize + 1]);
            for place in &mut self.places[first as usize..end as usize] {
                let next = &mut self.counts[self.tiles[pair] as usize];
                self.entries[*next as usize] = i;
                *place = *next;
                *next += 1;
                pair += 1;
            }
        }
    }

    /// Sorts by z, then by index: positive floats have the same order as their bits.
    fn sort(&mut self, flats: &[Flat]) {
        const BITS: u32 = 11;
        self.order.clear();
        self.order.extend(0..flats.len() as u32);
        self.spare.resize(flats.len(), 0);
        for shift in [0, BITS, 2 * BITS] {
            let digit =
                |i: u32| (flats[i as usize].z.to_bits() >> shift & ((1 << BITS) - 1)) as usize;
            let mut places = [0u32; 1 << BITS];
            for &i in &self.order {
                places[digit(i)] += 1;
            }
            let mut sum = 0;
            for place in &mut places {
                sum += std::mem::replace(place, sum);
            }
            for &i in &self.order {
                let place = &mut places[digit(i)];
                self.spare[*place as usize] = i;
                *place += 1;
            }
            std::mem::swap(&mut self.order, &mut self.spare);
        }
    }
}

/// Appends the tiles touched by the ellipse alpha >= 1/255.
fn note(flat: &Flat, tiles_x: usize, width: usize, height: usize, tiles: &mut Vec<u32>) {
    // Pixels whose centres lie in the range, both ends included; `None` if there are none.
    let centers = |low: f32, high: f32, size: usize| {
        let first = (low - 0.5).ceil().max(0.0) as usize;
        let last = (high - 0.5).floor().min(size as f32 - 1.0);
        (last >= 0.0 && first <= last as usize).then_some((first, last as usize))
    };
    let [mx, my] = flat.mean;
    let Some((top, bottom)) = centers(my - flat.extent[1], my + flat.extent[1], height) else {
        return;
    };
    let edge = |dy: f32, side: f32| {
        let left = (flat.level - MIN_LEVEL - flat.falloff[1] * dy * dy).max(0.0);
        mx + flat.shear * dy + side * (left / flat.falloff[0]).sqrt()
    };
    for tile_y in top / TILE..=bottom / TILE {
        let high = (tile_y * TILE) as f32 + 0.5 - my;
        let low = high + (TILE - 1) as f32;
        let left = edge((-flat.tip_y).max(high).min(low), -1.0);
        let right = edge(flat.tip_y.max(high).min(low), 1.0);
        // Slightly wider than the ellipse, so that rounding loses no pixel.
        if let Some((left, right)) = centers(left - 1e-3, right + 1e-3, width) {
            let row = tile_y * tiles_x;
            tiles.extend((row + left / TILE..=row + right / TILE).map(|tile| tile as u32));
        }
    }
}
