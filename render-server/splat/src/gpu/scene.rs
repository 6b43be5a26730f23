//! Uploads the packed scene of the CPU renderer (`scene` of [`crate::cpu`]) once; it is read-only afterwards.
//!
//! Contains the same blocks, and their coarser levels in adaptive detail, but stored column by column, so that the
//! threads of a workgroup read neighbouring words. The blocks of all parts (the static part, then the objects) are
//! stored one after the other in chunks, each of which fits a binding.
//!
//! Memory on the device: 52 bytes per splat, and 6, 24, 54 or 96 for its harmonics as f16, plus a third with coarser
//! blocks. 5 M splats of degree 3 take 740 MB in full detail.

use rayon::prelude::*;
use zerocopy::{Immutable, IntoBytes};

use super::device::Device;
use crate::RenderError;
use crate::blocks::BLOCK;
use crate::cpu::detail::BRANCH;
use crate::cpu::scene::{Block, GROUP, GROUP_NUMBERS, Part, column};

/// Number of words before a block's columns; `HEADER` in `project.wgsl`.
const HEADER: usize = 4;
/// Number of words from block to block.
const STRIDE: usize = HEADER + column::COUNT * BLOCK;
/// Maximum number of blocks per dispatch.
const MAX_BLOCKS: usize = 65_535;

/// Scene on the device.
#[derive(Debug)]
pub(super) struct GpuScene {
    /// [`Bounds`] of all blocks.
    pub(super) blocks: wgpu::Buffer,
    pub(super) chunks: Vec<Chunk>,
    pub(super) block_count: u32,
    /// Ids of the parts: static part, then the objects.
    pub(super) ids: Vec<u16>,
    /// [`crate::Splats::antialiased`] of the parts.
    pub(super) antialiased: Vec<bool>,
    /// Number of packed splats.
    pub(super) len: usize,
    /// Maximum error of the position of splats. [px]
    pub(super) max_error_px: f32,
}

/// Range of consecutive blocks.
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
    error_m: f32,
    /// Parent block, or [`NONE`].
    parent: u32,
    padding: [u32; 2],
}

const _: () = assert!(size_of::<Bounds>() == 48);

/// `NONE` of `cull.wgsl`.
const NONE: u32 = u32::MAX;

/// Block before its upload.
#[derive(Clone, Copy)]
struct Pending<'a> {
    part: u32,
    packed: &'a Part,
    /// Block index within the part.
    block: usize,
}

impl Pending<'_> {
    /// Returns the number of words of its harmonics.
    fn harmonics_words(&self) -> usize {
        self.packed.sh_numbers() * BLOCK / 2
    }
}

impl GpuScene {
    /// Uploads packed parts.
    pub(super) fn new(
        device: &Device,
        parts: &[Part],
        max_error_px: f32,
    ) -> Result<Self, RenderError> {
        let mut pending = Vec::new();
        let mut bounds = Vec::new();
        for (part, packed) in (0..).zip(parts) {
            let first = pending.len();
            let blocks = 0..packed.blocks.len();
            pending.extend(blocks.map(|block| Pending { part, packed, block }));
            bounds.extend(all_bounds(part, packed, first));
        }
        let blocks = device.storage("blocks", size_of_val(&bounds[..]) as u64);
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
            ids: parts.iter().map(|part| part.id).collect(),
            antialiased: parts.iter().map(|part| part.antialiased).collect(),
            len: parts.iter().map(|part| part.len).sum(),
            max_error_px,
        })
    }
}

/// Returns the bounds of a part's blocks; `first` is the scene's index of its first block.
fn all_bounds(part: u32, packed: &Part, first: usize) -> impl Iterator<Item = Bounds> {
    let begins = packed.levels.iter().copied();
    let ends = begins.clone().skip(1).chain([packed.blocks.len()]);
    begins.zip(ends).flat_map(move |(begin, end)| {
        packed.blocks[begin..end].iter().enumerate().map(move |(i, block)| {
            let Block { center_m, half_m, reach_m, error_m } = *block;
            // Blocks of the coarsest level have no parent.
            let is_last = end == packed.blocks.len();
            let parent = if is_last { NONE } else { (first + end + i / BRANCH) as u32 };
            let (center_m, half_m) = (center_m.to_array(), half_m.to_array());
            Bounds { center_m, reach_m, half_m, part, error_m, parent, padding: [0; 2] }
        })
    })
}

/// Returns the number of the next blocks that fit one chunk.
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

/// Packs a chunk and uploads it in slices, so that the host holds only a small part of it twice.
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
            // The header contains the position within the chunk, which is known only here.
            columns[1] = (harmonics_at + halves.len()) as u32;
            numbers.append(&mut columns);
            halves.extend(block_halves);
        }
        let queue = &device.queue;
        queue.write_buffer(&geometry, (block_at * STRIDE * 4) as u64, numbers.as_bytes());
        queue.write_buffer(&harmonics, (harmonics_at * 4) as u64, halves.as_bytes());
        // Frees the staging memory of this slice.
        queue.submit([]);
        block_at += slice.len();
        harmonics_at += halves.len();
    }
    let place = device.uniform("chunk", [first_block, STRIDE as u32, 0, 0].as_bytes());
    Chunk { place, geometry, harmonics, blocks: blocks.len() as u32 }
}

/// Blocks per slice: 25 MB of geometry.
const BLOCKS_PER_UPLOAD: usize = 2048;

/// Returns the header and columns of a block, and its harmonics.
fn pack(block: &Pending<'_>) -> (Vec<u32>, Vec<u32>) {
    let Pending { part, packed, block } = *block;
    let numbers = packed.sh_numbers();
    let groups = BLOCK / GROUP;
    let geometry = &packed.geometry[block * groups * GROUP_NUMBERS..][..groups * GROUP_NUMBERS];
    let sh = &packed.sh[block * BLOCK * numbers..][..BLOCK * numbers];
    let mut columns = vec![0; STRIDE];
    let mut halves = vec![0u32; numbers * BLOCK / 2];
    let mut splats = 0;
    for (group, geometry) in geometry.chunks_exact(GROUP_NUMBERS).enumerate() {
        splats += geometry[column::MEAN..][..GROUP].iter().filter(|x| !x.is_nan()).count();
        for (column, values) in geometry.chunks_exact(GROUP).enumerate() {
            let to = &mut columns[HEADER + column * BLOCK + group * GROUP..][..GROUP];
            to.iter_mut().zip(values).for_each(|(to, value)| *to = value.to_bits());
        }
        for k in 0..numbers {
            let from = &sh[(group * numbers + k) * GROUP..][..GROUP];
            let to = &mut halves[k * (BLOCK / 2) + group * (GROUP / 2)..][..GROUP / 2];
            for (to, pair) in to.iter_mut().zip(from.chunks_exact(2)) {
                *to = u32::from(pair[0]) | u32::from(pair[1]) << 16;
            }
        }
    }
    columns[..HEADER].copy_from_slice(&[part, 0, packed.coefficients as u32, splats as u32]);
    (columns, halves)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CpuRenderer, Detail, Splats};

    #[test]
    fn blocks_lie_within_their_parent() {
        for count in [0usize, 100, 256, 1024, 5000, 20_000] {
            let mut splats = Splats::default();
            for i in 0..count {
                let at = |share: f64| (share * i as f64).fract() as f32 * 10.0;
                splats.means_m.push(glam::Vec3::new(at(0.819_172), at(0.671_043), at(0.549_7)));
                splats.scales_m.push(glam::Vec3::splat(0.02));
                splats.rotations.push(glam::Quat::IDENTITY);
                splats.opacities.push(0.8);
                splats.sh.extend([0.1; 3]);
            }
            let packed = CpuRenderer::with_detail(&splats, Detail::ADAPTIVE);
            let part = &packed.packed().expect("it is in memory").0[0];
            let bounds: Vec<Bounds> = all_bounds(3, part, 7).collect();
            assert_eq!(bounds.len(), part.blocks.len());
            for (i, block) in bounds.iter().enumerate() {
                assert_eq!(block.part, 3);
                if block.parent == NONE {
                    assert_eq!(i + 1, bounds.len(), "one block represents all");
                    continue;
                }
                let above = &bounds[block.parent as usize - 7];
                assert!(above.error_m >= block.error_m);
                for k in 0..3 {
                    let off_m = (block.center_m[k] - above.center_m[k]).abs();
                    assert!(off_m + block.half_m[k] <= above.half_m[k] + 1e-5);
                }
            }
        }
    }
}
