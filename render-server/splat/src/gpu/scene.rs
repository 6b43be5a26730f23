//! Packs a scene for the device, once; then it is only read.
//!
//! As for the processor (`cpu/scene.rs`), splats are put along a Morton curve and cut into blocks of
//! 256 neighbours, culled as one, column after column: the threads of a workgroup read neighbouring
//! words. Blocks of all parts (what stands still, then the objects) lie one after the other in
//! chunks, each of which a binding can hold.
//!
//! Memory on the device: 52 bytes per splat and 6, 24, 54 or 96 for its harmonics as f16: 740 MB for
//! 5 M splats of degree 3. On the host it is packed chunk by chunk and not kept.

use glam::{Mat3, Vec3};
use half::f16;
use rayon::prelude::*;
use zerocopy::{Immutable, IntoBytes};

use super::device::Device;
use crate::limits::{ALPHA_MIN, MAX_SCALE_M};
use crate::{RenderError, Scene, Splats};

/// Splats per block; `BLOCK` in `common.wgsl`.
pub(super) const BLOCK: usize = 256;
/// Words before a block's columns; `HEADER` in `project.wgsl`.
const HEADER: usize = 4;
/// Centre, axes times scales, log2 of the opacity.
const COLUMNS: usize = 13;
/// Words from block to block.
const STRIDE: usize = HEADER + COLUMNS * BLOCK;
/// Blocks that one dispatch can cover.
const MAX_BLOCKS: usize = 65_535;

/// The scene on the device.
#[derive(Debug)]
pub(super) struct GpuScene {
    /// [`Bounds`] of all blocks.
    pub(super) blocks: wgpu::Buffer,
    pub(super) chunks: Vec<Chunk>,
    pub(super) block_count: u32,
    /// Ids of the parts: what stands still, then the objects.
    pub(super) ids: Vec<u16>,
    /// Splats kept.
    pub(super) len: usize,
}

/// Some consecutive blocks.
#[derive(Debug)]
pub(super) struct Chunk {
    /// `Chunk` of `project.wgsl`.
    pub(super) place: wgpu::Buffer,
    pub(super) geometry: wgpu::Buffer,
    pub(super) harmonics: wgpu::Buffer,
    pub(super) blocks: u32,
}

/// `Block` of `cull.wgsl`.
#[derive(Clone, Copy, Debug, IntoBytes, Immutable)]
#[repr(C)]
struct Bounds {
    center_m: [f32; 3],
    reach_m: f32,
    half_m: [f32; 3],
    part: u32,
}

const _: () = assert!(size_of::<Bounds>() == 32);

/// A block before it is packed.
#[derive(Clone, Copy)]
struct Pending<'a> {
    part: u32,
    splats: &'a Splats,
    /// Which of its splats.
    order: &'a [u32],
}

impl Pending<'_> {
    /// Words of its harmonics.
    fn harmonics_words(&self) -> usize {
        self.splats.sh_coefficients() * 3 * BLOCK / 2
    }
}

impl GpuScene {
    /// Packs and uploads a scene.
    pub(super) fn new(device: &Device, scene: Scene<'_>) -> Result<Self, RenderError> {
        let objects = scene.objects.iter().map(|object| &object.splats);
        let parts: Vec<&Splats> = std::iter::once(scene.splats).chain(objects).collect();
        let orders: Vec<Vec<u32>> = parts.iter().map(|splats| morton_order(splats)).collect();
        let pending: Vec<Pending<'_>> = parts
            .iter()
            .zip(&orders)
            .zip(0..)
            .flat_map(|((splats, order), part)| {
                order.chunks(BLOCK).map(move |order| Pending { part, splats, order })
            })
            .collect();
        let bounds: Vec<Bounds> = pending.par_iter().map(bounds).collect();
        let blocks = device.storage("blocks", bounds.len() as u64 * 32);
        device.queue.write_buffer(&blocks, 0, bounds.as_bytes());

        let mut chunks = Vec::new();
        let mut rest = &pending[..];
        while !rest.is_empty() {
            let first = pending.len() - rest.len();
            let (chunk, later) = rest.split_at(fitting(rest, device.binding_bytes));
            if chunk.is_empty() {
                let message = format!(
                    "the graphics device binds {} bytes at once, less than 256 splats take",
                    device.binding_bytes
                );
                return Err(RenderError::DeviceLost(message));
            }
            chunks.push(upload(device, first as u32, chunk));
            rest = later;
        }
        Ok(Self {
            blocks,
            chunks,
            block_count: pending.len() as u32,
            ids: std::iter::once(0).chain(scene.objects.iter().map(|object| object.id)).collect(),
            len: orders.iter().map(Vec::len).sum(),
        })
    }
}

/// Returns how many of the next blocks one chunk can hold.
fn fitting(blocks: &[Pending<'_>], binding_bytes: u64) -> usize {
    let words = usize::try_from(binding_bytes / 4).unwrap_or(usize::MAX);
    let most = (words / STRIDE).min(MAX_BLOCKS);
    let mut harmonics = 0;
    let fits = |block: &&Pending<'_>| {
        harmonics += block.harmonics_words();
        harmonics <= words
    };
    blocks.iter().take(most).take_while(fits).count()
}

/// Packs a chunk and uploads it in slices, so that the host holds little twice.
fn upload(device: &Device, first_block: u32, blocks: &[Pending<'_>]) -> Chunk {
    let words: usize = blocks.iter().map(Pending::harmonics_words).sum();
    let geometry = device.storage("geometry", (blocks.len() * STRIDE * 4) as u64);
    let harmonics = device.storage("harmonics", (words * 4) as u64);
    let (mut block_at, mut harmonics_at) = (0, 0);
    for slice in blocks.chunks(BLOCKS_PER_UPLOAD) {
        let packed: Vec<(Vec<u32>, Vec<u32>)> = slice.par_iter().map(pack).collect();
        let mut numbers = Vec::with_capacity(slice.len() * STRIDE);
        let mut halves = Vec::new();
        for (mut columns, block_halves) in packed {
            // The header names the place that only the whole chunk knows.
            columns[1] = (harmonics_at + halves.len()) as u32;
            numbers.append(&mut columns);
            halves.extend(block_halves);
        }
        let queue = &device.queue;
        queue.write_buffer(&geometry, (block_at * STRIDE * 4) as u64, numbers.as_bytes());
        queue.write_buffer(&harmonics, (harmonics_at * 4) as u64, halves.as_bytes());
        // Lets go of the staging memory of this slice.
        queue.submit([]);
        block_at += slice.len();
        harmonics_at += halves.len();
    }
    let place = device.uniform("chunk", [first_block, STRIDE as u32, 0, 0].as_bytes());
    Chunk { place, geometry, harmonics, blocks: blocks.len() as u32 }
}

/// 25 MB of geometry.
const BLOCKS_PER_UPLOAD: usize = 2048;

/// Returns a block's header and columns, and its harmonics.
fn pack(block: &Pending<'_>) -> (Vec<u32>, Vec<u32>) {
    let Pending { part, splats, order } = *block;
    let coefficients = splats.sh_coefficients();
    let numbers = coefficients * 3;
    let mut columns = vec![0; STRIDE];
    columns[..HEADER].copy_from_slice(&[part, 0, coefficients as u32, order.len() as u32]);
    let mut halves = vec![0u32; block.harmonics_words()];
    for (lane, &i) in order.iter().enumerate() {
        let i = i as usize;
        let scale_m = splats.scales_m[i].min(Vec3::splat(MAX_SCALE_M));
        let axes = Mat3::from_quat(splats.rotations[i].normalize()) * Mat3::from_diagonal(scale_m);
        let values = splats.means_m[i].to_array().into_iter().chain(axes.to_cols_array());
        for (column, value) in values.chain([splats.opacities[i].log2()]).enumerate() {
            columns[HEADER + column * BLOCK + lane] = value.to_bits();
        }
        for (k, &value) in splats.sh[i * numbers..(i + 1) * numbers].iter().enumerate() {
            // Clamped: f16 ends at 65504, and an infinity would become NaN.
            let bits = f16::from_f32(value.clamp(-6e4, 6e4)).to_bits();
            halves[k * BLOCK / 2 + lane / 2] |= u32::from(bits) << (lane % 2 * 16);
        }
    }
    (columns, halves)
}

/// Returns the indices of the splats that can be seen at all, along a Morton curve. The rules are
/// those of `cpu/scene.rs`; a test compares the numbers kept.
fn morton_order(splats: &Splats) -> Vec<u32> {
    let numbers = splats.sh_coefficients() * 3;
    let visible = |&i: &u32| {
        let i = i as usize;
        let q = splats.rotations[i];
        f64::from(splats.opacities[i]) >= ALPHA_MIN
            && splats.opacities[i] <= 1.0
            && splats.means_m[i].is_finite()
            && !splats.scales_m[i].is_nan()
            && splats.scales_m[i].min_element() >= 0.0
            && (q.length_squared() - 1.0).abs() < 1e-2
            && splats.sh[i * numbers..(i + 1) * numbers].iter().all(|v| v.is_finite())
    };
    let count = u32::try_from(splats.len()).expect("fewer than 2^32 splats");
    let kept: Vec<u32> = (0..count).into_par_iter().filter(visible).collect();
    let (low, high) = kept.iter().fold((Vec3::MAX, Vec3::MIN), |(low, high), &i| {
        let mean = splats.means_m[i as usize];
        (low.min(mean), high.max(mean))
    });
    // One scale for all axes keeps blocks roundish.
    let side = (high - low).max_element().max(f32::MIN_POSITIVE);
    let mut keyed: Vec<(u64, u32)> = kept
        .par_iter()
        .map(|&i| {
            let cell = (splats.means_m[i as usize] - low) / side * ((1 << 21) - 1) as f32;
            let [x, y, z] = cell.to_array().map(|v| spread(v as u64));
            (x | y << 1 | z << 2, i)
        })
        .collect();
    keyed.par_sort_unstable();
    keyed.into_iter().map(|(_, i)| i).collect()
}

/// Spreads 21 bits so that two zeros follow each.
fn spread(v: u64) -> u64 {
    let v = v & 0x1f_ffff;
    let v = (v | v << 32) & 0x001f_0000_0000_ffff;
    let v = (v | v << 16) & 0x001f_0000_ff00_00ff;
    let v = (v | v << 8) & 0x100f_00f0_0f00_f00f;
    let v = (v | v << 4) & 0x10c3_0c30_c30c_30c3;
    (v | v << 2) & 0x1249_2492_4924_9249
}

fn bounds(block: &Pending<'_>) -> Bounds {
    let splats = block.splats;
    let (mut low, mut high, mut reach_m) = (Vec3::MAX, Vec3::MIN, 0f32);
    for &i in block.order {
        let i = i as usize;
        low = low.min(splats.means_m[i]);
        high = high.max(splats.means_m[i]);
        // alpha >= 1/255 within this many standard deviations.
        let deviations = (2.0 * (splats.opacities[i] * 255.0).ln().max(0.0)).sqrt();
        let largest_m = splats.scales_m[i].max_element().min(MAX_SCALE_M);
        reach_m = reach_m.max(deviations * largest_m);
    }
    // Halved before they are added: no sum overflows. Widened by their own rounding.
    let center_m = low * 0.5 + high * 0.5;
    let half_m = (high * 0.5 - low * 0.5) + center_m.abs() * 1e-6;
    Bounds {
        center_m: center_m.to_array(),
        reach_m: reach_m * 1.0001,
        half_m: half_m.to_array(),
        part: block.part,
    }
}
