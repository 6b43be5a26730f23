//! Pass 5: the pixels of each tile, from near to far.
//!
//! A tile is cut into blocks of one vector: 4 pixels wide, 2 or 4 high (squarer than a row, so
//! fewer lanes are spent outside the ellipse). Its list is taken in batches of [`BATCH`]: copied
//! next to each other, then tested, a vector of splats at a time, against every block's rows and
//! columns, which leaves an exact list per block; then each block runs down its list with colour,
//! depths and transmittance in registers, and stops when all its pixels are opaque.
//!
//! Transmittance carries the pixel's end in its sign: the splat that would bring a pixel to 1e-4 is
//! not rendered, and makes it negative. Where depth alone is asked for, a pixel ends once half of its light is gone: neither
//! median depth nor id changes behind that.
//!
//! Budget: some 30 vector instructions per block and splat; 12 kB of tables, all in the L1 cache.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use rayon::prelude::*;

use super::bin::{Bins, TILE};
use super::cull::{ObjectView, Visible};
use super::project::{MIN_LEVEL, Splat2d};
use super::scene::{BLOCK, Part};
use super::simd::{Kernel, Simd};
use crate::RgbdImage;
use crate::limits::{ALPHA_MAX, TRANSMITTANCE_MIN};

/// Splats tested and blended at once; indices into a batch are bytes.
const BATCH: usize = 128;
/// Width of a block. [px]
const BLOCK_WIDTH: usize = 4;
/// Blocks of a tile at most: 8 lanes, 4x2 pixels.
const MAX_BLOCKS: usize = TILE * TILE / 8;
/// Pixels of a tile.
const TILE_PIXELS: usize = TILE * TILE;
/// Red, green, blue, weighted depth, median depth, transmittance, id: per block, vector by vector.
const CHANNELS: usize = 7;
/// Numbers of a tile.
const TILE_NUMBERS: usize = CHANNELS * TILE_PIXELS;
/// How far ahead records of the list are asked for.
const PREFETCH: usize = 12;

/// Which part of the scene a slot is of, and what of it is wanted.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tagged<'a> {
    /// What stands still, then the objects.
    pub(super) parts: &'a [Part],
    /// Per region of slots.
    pub(super) visible: &'a [Visible],
    /// Median depth and id are all that counts.
    pub(super) depth_alone: bool,
}

impl Tagged<'_> {
    fn id(&self, slot: usize) -> u16 {
        self.parts[self.visible[slot / BLOCK].part as usize].id
    }
}

/// Blends all tiles into `image`; `tiles` is kept from image to image.
pub(super) fn blend<S: Simd>(
    simd: S,
    view: &ObjectView,
    splats: &[Splat2d],
    bins: &Bins,
    tagged: &Tagged<'_>,
    tiles: &mut Vec<f32>,
    image: &mut RgbdImage,
) {
    tiles.resize(bins.tiles_x * bins.tiles_y * TILE_NUMBERS, 0.0);
    tiles.par_chunks_mut(TILE_NUMBERS).enumerate().for_each_init(Scratch::new, |scratch, tile| {
        let (index, pixels) = tile;
        let task = BlendTile {
            view,
            splats,
            list: bins.list(index),
            tagged,
            origin: [index % bins.tiles_x * TILE, index / bins.tiles_x * TILE],
            scratch,
            pixels,
        };
        simd.run(task);
    });
    image.resize(view.width_px, view.height_px);
    untile(S::LANES, bins.tiles_x, tiles, image);
}

/// Tables of a batch.
struct Scratch {
    batch: Batch,
    lists: [[u8; BATCH + 8]; MAX_BLOCKS],
}

/// A batch of splats, column by column; means relative to the tile. Columns are 256 long so that a
/// byte can index them without a check.
struct Batch {
    mean_x: [f32; 256],
    mean_y: [f32; 256],
    shear: [f32; 256],
    falloff_x: [f32; 256],
    falloff_y: [f32; 256],
    level: [f32; 256],
    tip_y: [f32; 256],
    extent_y: [f32; 256],
    z_m: [f32; 256],
    red: [f32; 256],
    green: [f32; 256],
    blue: [f32; 256],
    id: [f32; 256],
}

impl Scratch {
    fn new() -> Self {
        const ZEROS: [f32; 256] = [0.0; 256];
        Self {
            batch: Batch {
                mean_x: ZEROS,
                mean_y: ZEROS,
                shear: ZEROS,
                falloff_x: ZEROS,
                falloff_y: ZEROS,
                level: ZEROS,
                tip_y: ZEROS,
                extent_y: ZEROS,
                z_m: ZEROS,
                red: ZEROS,
                green: ZEROS,
                blue: ZEROS,
                id: ZEROS,
            },
            lists: [[0; BATCH + 8]; MAX_BLOCKS],
        }
    }
}

/// One tile.
struct BlendTile<'a> {
    view: &'a ObjectView,
    splats: &'a [Splat2d],
    list: &'a [AtomicU32],
    tagged: &'a Tagged<'a>,
    /// The tile's first pixel, x and y.
    origin: [usize; 2],
    scratch: &'a mut Scratch,
    pixels: &'a mut [f32],
}

impl Kernel for BlendTile<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { view, splats, list, tagged, origin, scratch, pixels } = self;
        // Ids cost a twentieth of the pass: only where something moves.
        let has_ids = tagged.parts.len() > 1;
        let pixels = &mut pixels[..TILE_NUMBERS];
        let block_height = S::LANES / BLOCK_WIDTH;
        let blocks = TILE_PIXELS / S::LANES;
        // Lane's centre within its block.
        let mut lane_x = [0.0; 16];
        let mut lane_y = [0.0; 16];
        for lane in 0..16 {
            lane_x[lane] = (lane % BLOCK_WIDTH) as f32 + 0.5;
            lane_y[lane] = (lane / BLOCK_WIDTH) as f32 + 0.5;
        }
        let (lane_x, lane_y) = (s.load(&lane_x), s.load(&lane_y));

        // Pixels beyond the image's edge have ended before they start.
        let room_x = (view.width_px as usize - origin[0]).min(TILE) as f32;
        let room_y = (view.height_px as usize - origin[1]).min(TILE) as f32;
        let mut live = 0u32;
        pixels.fill(0.0);
        for block in 0..blocks {
            let (x, y) = block_origin(block, block_height);
            let (x, y) = (lane_x + s.splat(x), lane_y + s.splat(y));
            let exists = s.lt(x, s.splat(room_x)) & s.lt(y, s.splat(room_y));
            live |= u32::from(s.any(exists)) << block;
            let transmittance = s.select(exists, s.splat(1.0), s.splat(-1.0));
            s.store(transmittance, &mut pixels[(block * CHANNELS + 5) * S::LANES..]);
        }

        for (first, slots) in list.chunks(BATCH).enumerate() {
            if live == 0 {
                break;
            }
            let ahead = &list[first * BATCH..];
            load_batch(s, splats, slots, ahead, origin, &mut scratch.batch);
            if has_ids {
                for (id, slot) in scratch.batch.id.iter_mut().zip(slots) {
                    *id = f32::from(tagged.id(slot.load(Relaxed) as usize));
                }
            }
            let mut lengths = [0usize; MAX_BLOCKS];
            list_blocks(s, &scratch.batch, slots.len(), live, &mut scratch.lists, &mut lengths);
            for block in 0..blocks {
                if lengths[block] == 0 {
                    continue;
                }
                let (x, y) = block_origin(block, block_height);
                let (x, y) = (lane_x + s.splat(x), lane_y + s.splat(y));
                let list = &scratch.lists[block][..lengths[block]];
                let state = &mut pixels[block * CHANNELS * S::LANES..][..CHANNELS * S::LANES];
                let batch = &scratch.batch;
                let goes_on = match (has_ids, tagged.depth_alone) {
                    (true, false) => blend_block::<S, true, false>(s, batch, list, x, y, state),
                    (false, false) => blend_block::<S, false, false>(s, batch, list, x, y, state),
                    (true, true) => blend_block::<S, true, true>(s, batch, list, x, y, state),
                    (false, true) => blend_block::<S, false, true>(s, batch, list, x, y, state),
                };
                if !goes_on {
                    live &= !(1 << block);
                }
            }
        }

        for state in pixels.chunks_exact_mut(CHANNELS * S::LANES) {
            finish(s, view, state);
        }
    }
}

/// Returns the first pixel of a block within its tile.
#[inline(always)]
fn block_origin(block: usize, block_height: usize) -> (f32, f32) {
    let across = TILE / BLOCK_WIDTH;
    ((block % across * BLOCK_WIDTH) as f32, (block / across * block_height) as f32)
}

/// Copies the records of a batch next to each other, column by column.
#[inline(always)]
fn load_batch<S: Simd>(
    s: S,
    splats: &[Splat2d],
    slots: &[AtomicU32],
    ahead: &[AtomicU32],
    origin: [usize; 2],
    batch: &mut Batch,
) {
    let (x, y) = (origin[0] as f32, origin[1] as f32);
    for (i, slot) in slots.iter().enumerate().take(BATCH) {
        if let Some(later) = ahead.get(i + PREFETCH) {
            s.prefetch(&splats[later.load(Relaxed) as usize]);
        }
        let splat = &splats[slot.load(Relaxed) as usize];
        batch.mean_x[i] = splat.mean_x - x;
        batch.mean_y[i] = splat.mean_y - y;
        batch.shear[i] = splat.shear;
        batch.falloff_x[i] = splat.falloff_x;
        batch.falloff_y[i] = splat.falloff_y;
        batch.level[i] = splat.level;
        batch.tip_y[i] = splat.tip_y;
        batch.extent_y[i] = splat.extent_y;
        batch.z_m[i] = splat.z_m;
        batch.red[i] = splat.rgb[0];
        batch.green[i] = splat.rgb[1];
        batch.blue[i] = splat.rgb[2];
    }
    // What pads the last vector reaches no row.
    for i in slots.len()..slots.len().next_multiple_of(S::LANES) {
        batch.extent_y[i] = f32::NEG_INFINITY;
    }
}

/// Lists for every live block the splats of the batch whose ellipse alpha >= 1/255 reaches it.
#[inline(always)]
fn list_blocks<S: Simd>(
    s: S,
    batch: &Batch,
    len: usize,
    live: u32,
    lists: &mut [[u8; BATCH + 8]; MAX_BLOCKS],
    lengths: &mut [usize; MAX_BLOCKS],
) {
    let across = TILE / BLOCK_WIDTH;
    let block_height = S::LANES / BLOCK_WIDTH;
    for first in (0..len).step_by(S::LANES) {
        let (mean_x, mean_y) = (s.load(&batch.mean_x[first..]), s.load(&batch.mean_y[first..]));
        let (shear, tip_y) = (s.load(&batch.shear[first..]), s.load(&batch.tip_y[first..]));
        let falloff_x = s.load(&batch.falloff_x[first..]);
        let falloff_y = s.load(&batch.falloff_y[first..]);
        let extent_y = s.load(&batch.extent_y[first..]);
        let reach = s.load(&batch.level[first..]) - s.splat(MIN_LEVEL);
        // Infinite where a splat covers everything evenly: bounded, so that 0 times it is 0.
        let width2 = s.min(s.splat(1.0) / falloff_x, s.splat(1e30));
        let zero = s.splat(0.0);
        for band in 0..TILE / block_height {
            let in_band = (1 << across) - 1;
            if live >> (band * across) & in_band == 0 {
                continue;
            }
            // From the first row's centres to the last's, relative to the means.
            let top = s.splat((band * block_height) as f32 + 0.5) - mean_y;
            let bottom = top + s.splat(block_height as f32 - 1.0);
            let reaches = s.lt(top, extent_y) & s.lt(zero - extent_y, bottom);
            if !s.any(reaches) {
                continue;
            }
            // As `Splat2d::span`.
            let dy = s.min(s.max(zero - tip_y, top), bottom);
            let rest = s.max(s.neg_mul_add(falloff_y * dy, dy, reach), zero);
            let left = s.mul_add(shear, dy, mean_x) - s.sqrt(rest * width2);
            let dy = s.min(s.max(tip_y, top), bottom);
            let rest = s.max(s.neg_mul_add(falloff_y * dy, dy, reach), zero);
            let right = s.mul_add(shear, dy, mean_x) + s.sqrt(rest * width2);
            for column in 0..across {
                let block = band * across + column;
                let x = (column * BLOCK_WIDTH) as f32;
                let hit = reaches
                    & s.lt(left, s.splat(x + BLOCK_WIDTH as f32 - 0.5))
                    & s.lt(s.splat(x + 0.5), right);
                let mut bits = s.bits(hit);
                if live >> block & 1 == 0 {
                    bits = 0;
                }
                let list = &mut lists[block];
                let length = &mut lengths[block];
                for half in 0..S::LANES / 8 {
                    let bits = (bits >> (half * 8)) as usize & 0xff;
                    // Eight positions at once, of which the first so many count.
                    let base = (first + half * 8) as u64 * 0x0101_0101_0101_0101;
                    let positions = POSITIONS[bits].wrapping_add(base).to_le_bytes();
                    // Never more than `first + half * 8`; the bound spares the check.
                    let at = (*length).min(BATCH);
                    list[at..at + 8].copy_from_slice(&positions);
                    *length = at + bits.count_ones() as usize;
                }
            }
        }
    }
}

/// Positions of the set bits of every byte, packed as bytes, lowest first.
static POSITIONS: [u64; 256] = {
    let mut table = [0; 256];
    let mut bits = 0;
    while bits < 256 {
        let mut at = 0;
        let mut bit = 0;
        while bit < 8 {
            if bits >> bit & 1 == 1 {
                table[bits] |= bit << (8 * at);
                at += 1;
            }
            bit += 1;
        }
        bits += 1;
    }
    table
};

/// Blends a list onto one block; returns whether any of its pixels goes on.
#[inline(always)]
fn blend_block<S: Simd, const IDS: bool, const DEPTH_ALONE: bool>(
    s: S,
    batch: &Batch,
    list: &[u8],
    x: S::F,
    y: S::F,
    state: &mut [f32],
) -> bool {
    let mut red = s.load(&state[..]);
    let mut green = s.load(&state[S::LANES..]);
    let mut blue = s.load(&state[2 * S::LANES..]);
    let mut depth = s.load(&state[3 * S::LANES..]);
    let mut median = s.load(&state[4 * S::LANES..]);
    let mut transmittance = s.load(&state[5 * S::LANES..]);
    let mut id = s.load(&state[6 * S::LANES..]);
    let mut goes_on = true;
    for &i in list {
        let i = usize::from(i);
        let dy = y - s.splat(batch.mean_y[i]);
        let dx = s.neg_mul_add(dy, s.splat(batch.shear[i]), x - s.splat(batch.mean_x[i]));
        let level = s.neg_mul_add(dy * s.splat(batch.falloff_y[i]), dy, s.splat(batch.level[i]));
        let level = s.neg_mul_add(dx * s.splat(batch.falloff_x[i]), dx, level);
        let hit = s.lt(s.splat(MIN_LEVEL), level);
        let alpha = s.keep(hit, s.min(s.exp2(level), s.splat(ALPHA_MAX as f32)));
        // Not `transmittance - weight`: one latency less from splat to splat.
        let after = s.neg_mul_add(alpha, transmittance, transmittance);
        let end = if DEPTH_ALONE { 0.5 } else { TRANSMITTANCE_MIN as f32 };
        let live = s.lt(s.splat(end), after);
        if !DEPTH_ALONE {
            let weight = s.keep(live, alpha * transmittance);
            red = s.mul_add(weight, s.splat(batch.red[i]), red);
            green = s.mul_add(weight, s.splat(batch.green[i]), green);
            blue = s.mul_add(weight, s.splat(batch.blue[i]), blue);
            depth = s.mul_add(weight, s.splat(batch.z_m[i]), depth);
        }
        // The last splat rendered while more than half of the light passed; `finish` checks that it
        // brought the pixel to half.
        let before_half = hit & s.lt(s.splat(0.5), transmittance);
        median = s.select(before_half, s.splat(batch.z_m[i]), median);
        if IDS {
            id = s.select(before_half, s.splat(batch.id[i]), id);
        }
        transmittance =
            if DEPTH_ALONE { after } else { s.select(live, after, s.negative(transmittance)) };
        if !s.any(live) {
            goes_on = false;
            break;
        }
    }
    let channels = [red, green, blue, depth, median, transmittance, id];
    for channel in 0..CHANNELS {
        s.store(channels[channel], &mut state[channel * S::LANES..]);
    }
    goes_on
}

/// Turns a block's sums into what an image holds: RGB on the background, expected depth, median
/// depth, alpha, id.
#[inline(always)]
fn finish<S: Simd>(s: S, view: &ObjectView, state: &mut [f32]) {
    let transmittance = s.splat(0.0) - s.negative(s.load(&state[5 * S::LANES..]));
    let alpha = s.splat(1.0) - transmittance;
    for channel in 0..3 {
        let sum = s.load(&state[channel * S::LANES..]);
        let rgb = s.mul_add(transmittance, s.splat(view.background[channel]), sum);
        s.store(rgb, &mut state[channel * S::LANES..]);
    }
    let depth = s.load(&state[3 * S::LANES..]) / alpha;
    let covered = s.lt(s.splat(0.0), alpha);
    s.store(s.keep(covered, depth), &mut state[3 * S::LANES..]);
    // Half itself counts as reached.
    let reached = s.lt(transmittance, s.splat(0.5 + f32::EPSILON / 2.0));
    let median = s.load(&state[4 * S::LANES..]);
    s.store(s.keep(reached, median), &mut state[4 * S::LANES..]);
    let id = s.load(&state[6 * S::LANES..]);
    s.store(s.keep(reached, id), &mut state[6 * S::LANES..]);
    s.store(alpha, &mut state[5 * S::LANES..]);
}

/// Copies tiles of blocks to rows of pixels.
fn untile(lanes: usize, tiles_x: usize, tiles: &[f32], image: &mut RgbdImage) {
    let width = image.width_px as usize;
    let block_height = lanes / BLOCK_WIDTH;
    let band = TILE * width;
    image
        .rgb
        .par_chunks_mut(3 * band)
        .zip(image.depth_expected_m.par_chunks_mut(band))
        .zip(image.depth_median_m.par_chunks_mut(band))
        .zip(image.alpha.par_chunks_mut(band))
        .zip(image.ids.par_chunks_mut(band))
        .zip(tiles.par_chunks(tiles_x * TILE_NUMBERS))
        .for_each(|(((((rgb, expected), median), alpha), ids), tiles)| {
            for row in 0..alpha.len() / width {
                for x in (0..width).step_by(BLOCK_WIDTH) {
                    let tile = &tiles[x / TILE * TILE_NUMBERS..][..TILE_NUMBERS];
                    let across = TILE / BLOCK_WIDTH;
                    let block = row / block_height * across + x % TILE / BLOCK_WIDTH;
                    let lane = row % block_height * BLOCK_WIDTH;
                    let state = &tile[block * CHANNELS * lanes..][..CHANNELS * lanes];
                    let channel = |k: usize| &state[k * lanes + lane..][..BLOCK_WIDTH];
                    let count = BLOCK_WIDTH.min(width - x);
                    let at = row * width + x;
                    let (red, green, blue) = (channel(0), channel(1), channel(2));
                    for (i, pixel) in rgb[at * 3..(at + count) * 3].chunks_exact_mut(3).enumerate()
                    {
                        pixel.copy_from_slice(&[red[i], green[i], blue[i]]);
                    }
                    expected[at..at + count].copy_from_slice(&channel(3)[..count]);
                    median[at..at + count].copy_from_slice(&channel(4)[..count]);
                    alpha[at..at + count].copy_from_slice(&channel(5)[..count]);
                    for (id, &value) in ids[at..at + count].iter_mut().zip(channel(6)) {
                        *id = value as u16;
                    }
                }
            }
        });
}
