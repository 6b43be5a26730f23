//! Pass 5: blends the pixels of each tile from near to far.
//!
//! A tile is cut into blocks of one vector (`cover`). Its list is processed in batches of [`BATCH`] splats. A batch
//! is copied next to each other, and converted to a row of bits per block: the splats that touch it. Each block then
//! iterates over its bits, with colour, depths and transmittance in registers, and stops when all its pixels are
//! opaque.
//!
//! The sign of the transmittance marks the end of a pixel: the splat that would reduce it to 1e-4 is not rendered,
//! and makes it negative from the next batch on. If only depth is requested, a pixel ends once half of its light is
//! gone, because neither median depth nor id changes after that.
//!
//! Budget: about 26 vector instructions per block and splat; 10 kB of tables, all in the L1 cache.

use std::sync::atomic::AtomicU64;

use rayon::prelude::*;

use super::bin::{Bins, Entry, TILE};
use super::cover::{BLOCK_WIDTH, bands, block_height};
use super::cull::{ObjectView, Visible};
use super::project::{MIN_LEVEL, Splat2d};
use super::scene::{BLOCK, Part};
use super::simd::{Kernel, Simd};
use crate::RgbdImage;
use crate::limits::{ALPHA_MAX, TRANSMITTANCE_MIN};

/// Splats blended at once.
const BATCH: usize = 64 * WORDS;
/// Words in a row of bits.
const WORDS: usize = 2;
/// Maximum number of blocks in a tile: 8 lanes, 4x2 pixels.
const MAX_BLOCKS: usize = TILE * TILE / 8;
/// Pixels of a tile.
const TILE_PIXELS: usize = TILE * TILE;
/// Red, green, blue, weighted depth, median depth, transmittance, id: per block, vector by vector.
const CHANNELS: usize = 7;
/// Values of a tile.
const TILE_NUMBERS: usize = CHANNELS * TILE_PIXELS;
/// Prefetch distance of the list's records.
const PREFETCH: usize = 12;

/// Part of the scene of each slot, and the requested outputs.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tagged<'a> {
    /// Slots.
    pub(super) splats: &'a [Splat2d],
    /// Static part, then the objects.
    pub(super) parts: &'a [Part],
    /// Visible block of each region of slots.
    pub(super) visible: &'a [Visible],
    /// Compute only median depth and id.
    pub(super) depth_alone: bool,
}

impl Tagged<'_> {
    fn id(&self, slot: usize) -> u16 {
        self.parts[self.visible[slot / BLOCK].part as usize].id
    }
}

/// Blends all tiles into `image`; `tiles` is a buffer that is reused for the next image.
pub(super) fn blend<S: Simd>(
    simd: S,
    view: &ObjectView,
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
    splats: [Record; BATCH],
    /// [`Entry::blocks`], byte by byte.
    touched: [[[u8; 64]; WORDS]; 4],
    /// Splats that touch each block, as bits.
    hits: [[u64; WORDS]; MAX_BLOCKS],
}

/// Splat relative to the tile. At pixel (x, y) its level is `level - u^2 - v^2`, with `u = u_x x + u_y y + u_0` and
/// `v = v_y y + v_0`.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
struct Record {
    u_x: f32,
    u_y: f32,
    u_0: f32,
    v_y: f32,
    v_0: f32,
    level: f32,
    z_m: f32,
    rgb: [f32; 3],
    id: f32,
}

impl Scratch {
    fn new() -> Self {
        Self {
            splats: [Record::default(); BATCH],
            touched: [[[0; 64]; WORDS]; 4],
            hits: [[0; WORDS]; MAX_BLOCKS],
        }
    }
}

/// Blends one tile.
struct BlendTile<'a> {
    view: &'a ObjectView,
    list: &'a [AtomicU64],
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
        let Self { view, list, tagged, origin, scratch, pixels } = self;
        let splats = tagged.splats;
        // Ids cost a twentieth of the pass, so they are computed only if the scene has objects.
        let has_ids = tagged.parts.len() > 1;
        let pixels = &mut pixels[..TILE_NUMBERS];
        let block_height = block_height(S::LANES);
        let blocks = TILE_PIXELS / S::LANES;
        // Pixel centre of each lane within its block.
        let mut lane_x = [0.0; 16];
        let mut lane_y = [0.0; 16];
        for lane in 0..16 {
            lane_x[lane] = (lane % BLOCK_WIDTH) as f32 + 0.5;
            lane_y[lane] = (lane / BLOCK_WIDTH) as f32 + 0.5;
        }
        let (lane_x, lane_y) = (s.load(&lane_x), s.load(&lane_y));

        // Pixels beyond the image's edge start as ended.
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

        for (first, entries) in list.chunks(BATCH).enumerate() {
            if live == 0 {
                break;
            }
            load_batch(s, splats, entries, origin, scratch);
            if has_ids {
                for (splat, entry) in scratch.splats.iter_mut().zip(entries) {
                    splat.id = f32::from(tagged.id(Entry::of(entry).slot));
                }
            }
            find_hits(s, entries.len(), blocks, scratch);
            let mut next = list[((first + 1) * BATCH).min(list.len())..].iter();
            for block in 0..blocks {
                for later in next.by_ref().take(BATCH / blocks) {
                    s.prefetch(&splats[Entry::of(later).slot]);
                }
                let hits = scratch.hits[block];
                if live >> block & 1 == 0 || hits == [0; WORDS] {
                    continue;
                }
                let (x, y) = block_origin(block, block_height);
                let (x, y) = (lane_x + s.splat(x), lane_y + s.splat(y));
                let state = &mut pixels[block * CHANNELS * S::LANES..][..CHANNELS * S::LANES];
                let batch = &scratch.splats;
                let goes_on = match (tagged.depth_alone, has_ids) {
                    (false, false) => blend_block::<S, false, false>(s, batch, hits, x, y, state),
                    (false, true) => blend_block::<S, false, true>(s, batch, hits, x, y, state),
                    (true, false) => blend_block::<S, true, false>(s, batch, hits, x, y, state),
                    (true, true) => blend_block::<S, true, true>(s, batch, hits, x, y, state),
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
    let bands = TILE / block_height;
    ((block / bands * BLOCK_WIDTH) as f32, (block % bands * block_height) as f32)
}

/// Copies the splats of a batch next to each other.
#[inline(always)]
fn load_batch<S: Simd>(
    s: S,
    splats: &[Splat2d],
    batch: &[AtomicU64],
    origin: [usize; 2],
    scratch: &mut Scratch,
) {
    let (x, y) = (origin[0] as f32, origin[1] as f32);
    for (i, entry) in batch.iter().enumerate().take(BATCH) {
        if let Some(later) = batch.get(i + PREFETCH) {
            s.prefetch(&splats[Entry::of(later).slot]);
        }
        let Entry { slot, blocks } = Entry::of(entry);
        let splat = &splats[slot];
        let (mean_x, mean_y) = (splat.mean_x - x, splat.mean_y - y);
        scratch.splats[i] = Record {
            u_x: splat.scale_x,
            u_y: -splat.shear * splat.scale_x,
            u_0: (splat.shear * mean_y - mean_x) * splat.scale_x,
            v_y: splat.scale_y,
            v_0: -mean_y * splat.scale_y,
            level: splat.level,
            z_m: splat.z_m,
            rgb: splat.rgb,
            id: 0.0,
        };
        for (bytes, byte) in scratch.touched.iter_mut().zip(blocks.to_le_bytes()) {
            bytes[i / 64][i % 64] = byte;
        }
    }
}

/// Converts the blocks of each of `len` splats into the splats of each block.
#[inline(always)]
fn find_hits<S: Simd>(s: S, len: usize, blocks: usize, scratch: &mut Scratch) {
    for byte in 0..blocks / 8 {
        for word in 0..WORDS {
            let planes = s.bit_planes(&scratch.touched[byte][word]);
            // Entries behind the batch's end are from an earlier batch.
            let count = len.saturating_sub(64 * word).min(64);
            let there = if count == 64 { u64::MAX } else { (1 << count) - 1 };
            for (hits, plane) in scratch.hits[byte * 8..].iter_mut().zip(planes) {
                hits[word] = plane & there;
            }
        }
    }
}

/// Blends the splats whose bits are set onto one block. Returns whether any of its pixels continues.
#[inline(always)]
fn blend_block<S: Simd, const DEPTH_ALONE: bool, const IDS: bool>(
    s: S,
    batch: &[Record; BATCH],
    hits: [u64; WORDS],
    x: S::F,
    y: S::F,
    state: &mut [f32],
) -> bool {
    // After half of the light, neither median depth nor id changes.
    let transmittance = s.load(&state[5 * S::LANES..]);
    if s.any(s.lt(s.splat(0.5), transmittance)) {
        blend_hits::<S, DEPTH_ALONE, true, IDS>(s, batch, hits, x, y, state)
    } else {
        blend_hits::<S, DEPTH_ALONE, false, false>(s, batch, hits, x, y, state)
    }
}

#[inline(always)]
fn blend_hits<S: Simd, const DEPTH_ALONE: bool, const MEDIAN: bool, const IDS: bool>(
    s: S,
    batch: &[Record; BATCH],
    hits: [u64; WORDS],
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
    let end = s.splat(if DEPTH_ALONE { 0.5 } else { TRANSMITTANCE_MIN as f32 });
    // Continues to fall after the pixel's end, so that consecutive splats are only one operation's latency apart.
    // `shown` is the value before the end.
    let mut shown = transmittance;
    'batch: for (word, mut bits) in hits.into_iter().enumerate() {
        while bits != 0 {
            let splat = &batch[(word * 64 + bits.trailing_zeros() as usize) % BATCH];
            bits &= bits - 1;
            let u = s.mul_add(y, s.splat(splat.u_y), s.splat(splat.u_0));
            let u = s.mul_add(x, s.splat(splat.u_x), u);
            let v = s.mul_add(y, s.splat(splat.v_y), s.splat(splat.v_0));
            let level = s.neg_mul_add(u, u, s.neg_mul_add(v, v, s.splat(splat.level)));
            let hit = s.lt(s.splat(MIN_LEVEL), level);
            let alpha = s.keep(hit, s.min(s.exp2(level), s.splat(ALPHA_MAX as f32)));
            // Not `transmittance - weight`: that adds the latency of one operation.
            let after = s.neg_mul_add(alpha, transmittance, transmittance);
            // Far below the end, but not subnormal: subnormal numbers are a hundred times slower.
            let after = s.max(after, s.splat(1e-30));
            let live = s.lt(end, after);
            if !DEPTH_ALONE {
                let weight = s.keep(live, alpha * transmittance);
                red = s.mul_add(weight, s.splat(splat.rgb[0]), red);
                green = s.mul_add(weight, s.splat(splat.rgb[1]), green);
                blue = s.mul_add(weight, s.splat(splat.rgb[2]), blue);
                depth = s.mul_add(weight, s.splat(splat.z_m), depth);
            }
            // Last splat that is rendered while more than half of the light is left. `finish` checks that it reduced
            // the light to half.
            if MEDIAN {
                let before_half = hit & s.lt(s.splat(0.5), transmittance);
                median = s.select(before_half, s.splat(splat.z_m), median);
                if IDS {
                    id = s.select(before_half, s.splat(splat.id), id);
                }
            }
            shown = if DEPTH_ALONE { after } else { s.select(live, after, shown) };
            transmittance = after;
            if !s.any(live) {
                break 'batch;
            }
        }
    }
    let live = s.lt(end, transmittance);
    let shown = s.select(live, shown, s.negative(shown));
    let channels = [red, green, blue, depth, median, shown, id];
    for channel in 0..CHANNELS {
        s.store(channels[channel], &mut state[channel * S::LANES..]);
    }
    s.any(live)
}

/// Converts the sums of a block into image values: RGB on the background, expected depth, median depth, alpha, id.
#[inline(always)]
fn finish<S: Simd>(s: S, view: &ObjectView, state: &mut [f32]) {
    let transmittance = s.splat(0.0) - s.negative(s.load(&state[5 * S::LANES..]));
    let alpha = s.splat(1.0) - transmittance;
    for channel in 0..3 {
        let sum = s.load(&state[channel * S::LANES..]);
        let rgb = s.mul_add(transmittance, s.splat(view.background[channel]), sum);
        s.store(rgb, &mut state[channel * S::LANES..]);
    }
    // Limits values that rounding increased beyond the maximum of f32.
    let depth = s.min(s.load(&state[3 * S::LANES..]) / alpha, s.splat(f32::MAX));
    let covered = s.lt(s.splat(0.0), alpha);
    s.store(s.keep(covered, depth), &mut state[3 * S::LANES..]);
    // Exactly half counts as reached.
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
    let block_height = block_height(lanes);
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
                    let block = x % TILE / BLOCK_WIDTH * bands(lanes) + row / block_height;
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
