//! Pass 3: blends tiles of projected Gaussians to pixels, and propagates the loss gradient at the pixels back to them.
//!
//! A tile consists of blocks 8 pixels wide; their height follows from the vector length. A batch of a tile's list is
//! copied to contiguous memory, with a mask of the blocks that each Gaussian's ellipse overlaps. The forward pass keeps
//! the pixels of a block in registers. The backward pass keeps the sums of a Gaussian in registers. Both go from near to
//! far, so that transmittances are bit-identical; the contribution from behind, `sum_(j > i) w_j q_j`, is obtained by
//! subtraction.
//!
//! Forward channels: red, green, blue, `sum w z`, `sum w z^2`, transmittance. Backward channels: derivatives of the loss
//! by each of them.

use vizflyt_splat::limits::{ALPHA_MAX, TRANSMITTANCE_MIN};
use vizflyt_splat::simd::{Kernel, Simd};

use crate::bin::Bins;
use crate::planes::TILE;
use crate::project::{Flat, FlatGradient, MIN_LEVEL};

/// Channels of an image.
pub(crate) const CHANNELS: usize = 6;
/// Channels of its derivative: those of an image, and the error of the pixel.
pub(crate) const BY_CHANNELS: usize = 7;
const PIXELS: usize = TILE * TILE;
const BLOCK_WIDTH: usize = 8;
/// Maximum number of blocks, with 8 lanes: the bits of a mask.
const MAX_BLOCKS: usize = PIXELS / 8;
const BATCH: usize = 64;

/// Sums over a tile's pixels for one Gaussian: `sum G`, `G u`, `G dy`, `G u^2`, `G u dy`, `G dy^2`
/// with `G` the derivative by its level (without ln 2), then the derivatives by colour and z,
/// then the error seen through it.
pub(crate) type PairSums = [f32; SUMS];
pub(crate) const SUMS: usize = 11;

/// Returns the gradient of a flat Gaussian from the sums of its tiles.
pub(crate) fn flat_gradient(flat: &Flat, sums: &PairSums) -> FlatGradient {
    let [g, gu, gy, guu, guy, gyy, red, green, blue, z, _] = *sums;
    let ln2 = std::f32::consts::LN_2;
    let [fall_x, fall_y] = flat.falloff;
    let by_x = 2.0 * fall_x * gu * ln2;
    FlatGradient {
        mean: [by_x, 2.0 * fall_y * gy * ln2 - flat.shear * by_x],
        shear: 2.0 * fall_x * guy * ln2,
        falloff: [-guu * ln2, -gyy * ln2],
        level: g * ln2,
        z,
        rgb: [red, green, blue],
    }
}

/// Batch of Gaussians of a tile, as columns; means relative to the tile's corner [px].
struct Batch {
    mean_x: [f32; BATCH],
    mean_y: [f32; BATCH],
    shear: [f32; BATCH],
    falloff_x: [f32; BATCH],
    falloff_y: [f32; BATCH],
    level: [f32; BATCH],
    tip_y: [f32; BATCH],
    extent_y: [f32; BATCH],
    z: [f32; BATCH],
    rgb: [[f32; BATCH]; 3],
    /// Blocks that each Gaussian overlaps.
    masks: [u32; BATCH],
}

impl Batch {
    fn new() -> Self {
        let zeros = [0.0; BATCH];
        Self {
            mean_x: zeros,
            mean_y: zeros,
            shear: zeros,
            falloff_x: zeros,
            falloff_y: zeros,
            level: zeros,
            tip_y: zeros,
            extent_y: zeros,
            z: zeros,
            rgb: [zeros; 3],
            masks: [0; BATCH],
        }
    }

    #[inline(always)]
    fn load<S: Simd>(&mut self, s: S, flats: &[Flat], list: &[u32], origin: [f32; 2]) {
        for (i, &index) in list.iter().enumerate().take(BATCH) {
            let flat = &flats[index as usize];
            self.mean_x[i] = flat.mean[0] - origin[0];
            self.mean_y[i] = flat.mean[1] - origin[1];
            self.shear[i] = flat.shear;
            self.falloff_x[i] = flat.falloff[0];
            self.falloff_y[i] = flat.falloff[1];
            self.level[i] = flat.level;
            self.tip_y[i] = flat.tip_y;
            self.extent_y[i] = flat.extent[1];
            self.z[i] = flat.z;
            for channel in 0..3 {
                self.rgb[channel][i] = flat.rgb[channel];
            }
        }
        for i in list.len()..list.len().next_multiple_of(S::LANES).min(BATCH) {
            self.extent_y[i] = f32::NEG_INFINITY;
        }
        for first in (0..list.len()).step_by(S::LANES) {
            self.mark(s, first);
        }
    }

    /// Finds the blocks that the ellipses alpha >= 1/255 of some lanes reach.
    #[inline(always)]
    fn mark<S: Simd>(&mut self, s: S, first: usize) {
        let height = S::LANES / BLOCK_WIDTH;
        let (mean_x, mean_y) = (s.load(&self.mean_x[first..]), s.load(&self.mean_y[first..]));
        let (shear, tip_y) = (s.load(&self.shear[first..]), s.load(&self.tip_y[first..]));
        let falloff_y = s.load(&self.falloff_y[first..]);
        let extent_y = s.load(&self.extent_y[first..]);
        let reach = s.load(&self.level[first..]) - s.splat(MIN_LEVEL);
        let width2 = s.min(s.splat(1.0) / s.load(&self.falloff_x[first..]), s.splat(1e30));
        let zero = s.splat(0.0);
        let masks = &mut self.masks[first..first + S::LANES];
        masks.fill(0);
        for band in 0..TILE / height {
            let top = s.splat((band * height) as f32 + 0.5) - mean_y;
            let bottom = top + s.splat(height as f32 - 1.0);
            let reaches = s.lt(top, extent_y) & s.lt(zero - extent_y, bottom);
            if !s.any(reaches) {
                continue;
            }
            let dy = s.min(s.max(zero - tip_y, top), bottom);
            let rest = s.max(s.neg_mul_add(falloff_y * dy, dy, reach), zero);
            let left = s.mul_add(shear, dy, mean_x) - s.sqrt(rest * width2);
            let dy = s.min(s.max(tip_y, top), bottom);
            let rest = s.max(s.neg_mul_add(falloff_y * dy, dy, reach), zero);
            let right = s.mul_add(shear, dy, mean_x) + s.sqrt(rest * width2);
            for column in 0..TILE / BLOCK_WIDTH {
                let x = (column * BLOCK_WIDTH) as f32;
                let hit = reaches
                    & s.lt(left, s.splat(x + BLOCK_WIDTH as f32 - 0.5))
                    & s.lt(s.splat(x + 0.5), right);
                let mut bits = s.bits(hit);
                let block = 1 << (band * (TILE / BLOCK_WIDTH) + column);
                while bits != 0 {
                    masks[bits.trailing_zeros() as usize] |= block;
                    bits &= bits - 1;
                }
            }
        }
    }
}

/// Where a block's pixels are within its tile.
#[inline(always)]
fn block_origin(block: usize, height: usize) -> (usize, usize) {
    let across = TILE / BLOCK_WIDTH;
    (block % across * BLOCK_WIDTH, block / across * height)
}

/// Centres of the pixels of the first block.
#[inline(always)]
fn lanes<S: Simd>(s: S) -> (S::F, S::F) {
    let (mut x, mut y) = ([0.0; 16], [0.0; 16]);
    for lane in 0..S::LANES {
        x[lane] = (lane % BLOCK_WIDTH) as f32 + 0.5;
        y[lane] = (lane / BLOCK_WIDTH) as f32 + 0.5;
    }
    (s.load(&x), s.load(&y))
}

/// One block of a tile.
struct Block<S: Simd> {
    s: S,
    /// Centres of its pixels, from the tile's corner [px].
    x: S::F,
    y: S::F,
    /// Index of its first pixel in a channel.
    at: usize,
}

impl<S: Simd> Block<S> {
    /// Returns block number `block`; `lanes` are the pixels of the first one.
    #[inline(always)]
    fn new(s: S, lanes: (S::F, S::F), block: usize) -> Self {
        let (x, y) = block_origin(block, S::LANES / BLOCK_WIDTH);
        let (x, y) = (lanes.0 + s.splat(x as f32), lanes.1 + s.splat(y as f32));
        Self { s, x, y, at: block * S::LANES }
    }

    /// Blends a list onto the block. Returns whether a pixel still lets light through.
    #[inline(always)]
    fn forward(&self, batch: &Batch, list: &[u8], state: &mut [[f32; PIXELS]; CHANNELS]) -> bool {
        let &Self { s, x, y, at } = self;
        let mut sums = [s.splat(0.0); CHANNELS];
        for channel in 0..CHANNELS {
            sums[channel] = s.load(&state[channel][at..]);
        }
        let [mut red, mut green, mut blue, mut first, mut second, mut transmittance] = sums;
        let mut goes_on = true;
        for &i in list {
            let i = usize::from(i) % BATCH;
            let dy = y - s.splat(batch.mean_y[i]);
            let u = s.neg_mul_add(dy, s.splat(batch.shear[i]), x - s.splat(batch.mean_x[i]));
            let level =
                s.neg_mul_add(dy * s.splat(batch.falloff_y[i]), dy, s.splat(batch.level[i]));
            let level = s.neg_mul_add(u * s.splat(batch.falloff_x[i]), u, level);
            let hit = s.lt(s.splat(MIN_LEVEL), level);
            let alpha = s.keep(hit, s.min(s.exp2(level), s.splat(ALPHA_MAX as f32)));
            let after = s.neg_mul_add(alpha, transmittance, transmittance);
            let live = s.lt(s.splat(TRANSMITTANCE_MIN as f32), after);
            let weight = s.keep(live, alpha * transmittance);
            red = s.mul_add(weight, s.splat(batch.rgb[0][i]), red);
            green = s.mul_add(weight, s.splat(batch.rgb[1][i]), green);
            blue = s.mul_add(weight, s.splat(batch.rgb[2][i]), blue);
            let z = s.splat(batch.z[i]);
            let deep = weight * z;
            first = first + deep;
            second = s.mul_add(deep, z, second);
            transmittance = s.select(live, after, s.negative(transmittance));
            if !s.any(live) {
                goes_on = false;
                break;
            }
        }
        let sums = [red, green, blue, first, second, transmittance];
        for channel in 0..CHANNELS {
            s.store(sums[channel], &mut state[channel][at..]);
        }
        goes_on
    }

    /// Adds the derivatives at the block's pixels by Gaussian `i` to `sums`. `rest` is the light behind each pixel's
    /// last Gaussian, weighted by `by`; `through` its transmittance. Returns whether a pixel still lets light through.
    #[inline(always)]
    fn backward(
        &self,
        batch: &Batch,
        i: usize,
        by: &[[f32; PIXELS]; BY_CHANNELS],
        rest: &mut [f32; PIXELS],
        through: &mut [f32; PIXELS],
        sums: &mut [S::F; SUMS],
    ) -> bool {
        let &Self { s, x, y, at } = self;
        let one = s.splat(1.0);
        let dy = y - s.splat(batch.mean_y[i]);
        let u = s.neg_mul_add(dy, s.splat(batch.shear[i]), x - s.splat(batch.mean_x[i]));
        let level = s.neg_mul_add(dy * s.splat(batch.falloff_y[i]), dy, s.splat(batch.level[i]));
        let level = s.neg_mul_add(u * s.splat(batch.falloff_x[i]), u, level);
        let hit = s.lt(s.splat(MIN_LEVEL), level);
        let full = s.exp2(level);
        let alpha = s.keep(hit, s.min(full, s.splat(ALPHA_MAX as f32)));
        let transmittance = s.load(&through[at..]);
        let after = s.neg_mul_add(alpha, transmittance, transmittance);
        let live = s.lt(s.splat(TRANSMITTANCE_MIN as f32), after);
        let weight = s.keep(live, alpha * transmittance);

        let load = |channel: usize| s.load(&by[channel][at..]);
        let (red, green, blue) = (load(0), load(1), load(2));
        let (first, second) = (load(3), load(4));
        let z = s.splat(batch.z[i]);
        // What one unit of weight is worth here.
        let worth = red * s.splat(batch.rgb[0][i]);
        let worth = s.mul_add(green, s.splat(batch.rgb[1][i]), worth);
        let worth = s.mul_add(blue, s.splat(batch.rgb[2][i]), worth);
        let worth = s.mul_add(s.mul_add(second, z, first), z, worth);
        let behind = s.neg_mul_add(weight, worth, s.load(&rest[at..]));
        let by_alpha = s.neg_mul_add(behind, one / (one - alpha), transmittance * worth);
        // Cut off at its greatest, alpha does not change with the level.
        let free = live & s.lt(full, s.splat(ALPHA_MAX as f32));
        let g = s.keep(free, by_alpha * alpha);
        let (gu, gy) = (g * u, g * dy);
        sums[0] = sums[0] + g;
        sums[1] = sums[1] + gu;
        sums[2] = sums[2] + gy;
        sums[3] = s.mul_add(gu, u, sums[3]);
        sums[4] = s.mul_add(gu, dy, sums[4]);
        sums[5] = s.mul_add(gy, dy, sums[5]);
        sums[6] = s.mul_add(weight, red, sums[6]);
        sums[7] = s.mul_add(weight, green, sums[7]);
        sums[8] = s.mul_add(weight, blue, sums[8]);
        sums[9] = s.mul_add(weight, s.mul_add(second + second, z, first), sums[9]);

        sums[10] = s.mul_add(weight, load(6), sums[10]);

        s.store(behind, &mut rest[at..]);
        s.store(s.select(live, after, s.negative(transmittance)), &mut through[at..]);
        s.any(live)
    }
}

/// Copies between a tile of a band, row by row, and a channel of blocks.
#[inline(always)]
fn for_rows(lanes: usize, stride: usize, tile_x: usize, mut copy: impl FnMut(usize, usize)) {
    let height = lanes / BLOCK_WIDTH;
    for block in 0..PIXELS / lanes {
        let (x, y) = block_origin(block, height);
        for row in 0..height {
            copy(block * lanes + row * BLOCK_WIDTH, (y + row) * stride + tile_x * TILE + x);
        }
    }
}

/// Renders one band of tiles.
pub(crate) struct Forward<'a> {
    pub(crate) flats: &'a [Flat],
    pub(crate) bins: &'a Bins,
    pub(crate) band: usize,
    pub(crate) stride: usize,
    /// The band of the image.
    pub(crate) out: &'a mut [f32],
}

impl Kernel for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let blocks = PIXELS / S::LANES;
        let lanes = lanes(s);
        let mut batch = Batch::new();
        let mut state = [[0.0; PIXELS]; CHANNELS];
        let mut lists = [[0u8; BATCH]; MAX_BLOCKS];
        for tile_x in 0..self.bins.tiles_x {
            let tile = self.band * self.bins.tiles_x + tile_x;
            let list = self.bins.starts[tile] as usize..self.bins.starts[tile + 1] as usize;
            let list = &self.bins.entries[list];
            let origin = [(tile_x * TILE) as f32, (self.band * TILE) as f32];
            state[..5].fill([0.0; PIXELS]);
            state[5].fill(1.0);
            let mut live = u32::MAX >> (32 - blocks);
            for list in list.chunks(BATCH) {
                if live == 0 {
                    break;
                }
                batch.load(s, self.flats, list, origin);
                let mut lengths = [0usize; MAX_BLOCKS];
                for i in 0..list.len() {
                    let mut bits = batch.masks[i] & live;
                    while bits != 0 {
                        let block = bits.trailing_zeros() as usize % MAX_BLOCKS;
                        bits &= bits - 1;
                        lists[block][lengths[block] % BATCH] = i as u8;
                        lengths[block] += 1;
                    }
                }
                for block in 0..blocks {
                    let list = &lists[block][..lengths[block].min(BATCH)];
                    if list.is_empty() {
                        continue;
                    }
                    if !Block::new(s, lanes, block).forward(&batch, list, &mut state) {
                        live &= !(1 << block);
                    }
                }
            }
            for (channel, values) in state.iter().enumerate() {
                let out = &mut self.out[channel * TILE * self.stride..][..TILE * self.stride];
                for_rows(S::LANES, self.stride, tile_x, |from, to| {
                    for k in 0..BLOCK_WIDTH {
                        // The sign says that the pixel has ended.
                        out[to + k] =
                            if channel == 5 { values[from + k].abs() } else { values[from + k] };
                    }
                });
            }
        }
    }
}

/// Takes the derivative at the pixels of one band of tiles back to the pairs of its lists.
pub(crate) struct Backward<'a> {
    pub(crate) flats: &'a [Flat],
    pub(crate) bins: &'a Bins,
    pub(crate) band: usize,
    pub(crate) stride: usize,
    /// The band as [`Forward`] rendered it.
    pub(crate) image: &'a [f32],
    /// The derivative of the loss by it.
    pub(crate) by: &'a [f32],
    /// Of the band's pairs, as they stand in the lists.
    pub(crate) out: &'a mut [PairSums],
}

impl Kernel for Backward<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let blocks = PIXELS / S::LANES;
        let tiles_x = self.bins.tiles_x;
        let lanes = lanes(s);
        let mut batch = Batch::new();
        // The derivative by each channel, transmittance, and what is still to come.
        let mut by = [[0.0; PIXELS]; BY_CHANNELS];
        let mut image = [[0.0; PIXELS]; CHANNELS];
        let mut rest = [0.0; PIXELS];
        let mut transmittance = [1.0; PIXELS];
        let band_start = self.bins.starts[self.band * tiles_x] as usize;
        for tile_x in 0..tiles_x {
            let tile = self.band * tiles_x + tile_x;
            let range = self.bins.starts[tile] as usize..self.bins.starts[tile + 1] as usize;
            let origin = [(tile_x * TILE) as f32, (self.band * TILE) as f32];
            for channel in 0..BY_CHANNELS {
                let plane = channel * TILE * self.stride..(channel + 1) * TILE * self.stride;
                let from_by = &self.by[plane.clone()];
                let from_image = self.image.get(plane);
                for_rows(S::LANES, self.stride, tile_x, |to, from| {
                    if let Some(from_image) = from_image {
                        image[channel][to..to + BLOCK_WIDTH]
                            .copy_from_slice(&from_image[from..from + BLOCK_WIDTH]);
                    }
                    by[channel][to..to + BLOCK_WIDTH]
                        .copy_from_slice(&from_by[from..from + BLOCK_WIDTH]);
                });
            }
            transmittance.fill(1.0);
            for i in 0..PIXELS {
                rest[i] = (0..CHANNELS).map(|channel| image[channel][i] * by[channel][i]).sum();
            }
            let mut live = u32::MAX >> (32 - blocks);
            let out = &mut self.out[range.start - band_start..range.end - band_start];
            for (list, out) in self.bins.entries[range].chunks(BATCH).zip(out.chunks_mut(BATCH)) {
                if live == 0 {
                    out.fill([0.0; SUMS]);
                    continue;
                }
                batch.load(s, self.flats, list, origin);
                for (i, out) in out.iter_mut().enumerate() {
                    let mut sums = [s.splat(0.0); SUMS];
                    let mut bits = batch.masks[i % BATCH] & live;
                    while bits != 0 {
                        let block = bits.trailing_zeros() as usize % blocks;
                        bits &= bits - 1;
                        let block_pixels = Block::new(s, lanes, block);
                        let (rest, transmittance) = (&mut rest, &mut transmittance);
                        if !block_pixels.backward(
                            &batch,
                            i % BATCH,
                            &by,
                            rest,
                            transmittance,
                            &mut sums,
                        ) {
                            live &= !(1 << block);
                        }
                    }
                    for (out, sum) in out.iter_mut().zip(sums) {
                        *out = s.sum(sum);
                    }
                }
            }
        }
    }
}
