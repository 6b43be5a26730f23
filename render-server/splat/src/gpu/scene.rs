//! Packs a scene for the device, once; then it is only read.
//!
//! As for the processor, splats stand in blocks ([`crate::blocks`]), here column after column: the threads of a workgroup read neighbouring
//! words. Blocks of all parts (what stands still, then the objects) lie one after the other in
//! chunks, each of which a binding can hold.
//!
//! Memory on the device: 52 bytes per splat and 6, 24, 54 or 96 for its harmonics as f16: 740 MB for
//! 5 M splats of degree 3. On the host it is packed chunk by chunk and not kept.

use half::f16;
use rayon::prelude::*;
use zerocopy::{Immutable, IntoBytes};

use super::device::Device;
use crate::blocks::{self, BLOCK};
use crate::{RenderError, Scene, Splats};

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
    /// [`Splats::antialiased`] of the parts.
    pub(super) antialiased: Vec<bool>,
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
        let orders: Vec<Vec<u32>> = parts.iter().map(|splats| blocks::order(splats)).collect();
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
                return Err(RenderError::Device(message));
            }
            chunks.push(upload(device, first as u32, chunk));
            rest = later;
        }
        Ok(Self {
            blocks,
            chunks,
            block_count: pending.len() as u32,
            ids: std::iter::once(0).chain(scene.objects.iter().map(|object| object.id)).collect(),
            antialiased: parts.iter().map(|splats| splats.antialiased).collect(),
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
        let axes = blocks::axes(splats, i);
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

fn bounds(block: &Pending<'_>) -> Bounds {
    let blocks::Bounds { center_m, half_m, reach_m } = blocks::bounds(block.splats, block.order);
    Bounds { center_m: center_m.to_array(), reach_m, half_m: half_m.to_array(), part: block.part }
}
