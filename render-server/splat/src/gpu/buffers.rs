//! Buffers between passes; reused for each tick, and only ever grown.
//!
//! Two sizes depend on what a camera sees, and are known only on the device: regions (256 slots, one per visible
//! block) and pairs (of tile and splat). The device counts the required number and uses the available room. The
//! counts are read with the images; if the room was too small, the buffers grow and the tick is rendered again
//! (`read.rs`).
//!
//! Memory: 64 bytes per slot, 16 per pair, 4 per camera and block, 8 per tile; 16 per pixel (20 with objects) for
//! each of two staging buffers, and once more if shaders cannot write to these.

use super::device::Device;
use super::view::GpuView;
use crate::blocks::BLOCK;

/// Capacity of the buffers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Capacity {
    /// Cameras times parts.
    pub(super) views: u64,
    /// Cameras times blocks.
    pub(super) camera_blocks: u64,
    pub(super) regions: u64,
    pub(super) pairs: u64,
    pub(super) tiles: u64,
    pub(super) pixels: u64,
}

impl Capacity {
    /// Returns the maximum capacity of a device.
    pub(super) fn limit(binding_bytes: u64) -> Self {
        // One workgroup writes the pairs of a region, and a dispatch has at most 65535 workgroups.
        let regions = (binding_bytes / PROJECTED_BYTES / BLOCK as u64).min(65_535);
        Self {
            views: binding_bytes / size_of::<GpuView>() as u64,
            // Ranks, and one number per workgroup.
            camera_blocks: (binding_bytes / 4 * 255 / 256).min(65_535 * 256),
            regions,
            pairs: binding_bytes / 8,
            tiles: binding_bytes / 4 - 1,
            pixels: binding_bytes / 16,
        }
    }

    /// Returns whether it is at least as large as another capacity.
    pub(super) fn holds(&self, other: &Self) -> bool {
        self.pairwise(other).iter().all(|(has, wants)| has >= wants)
    }

    /// Returns whether it is within the device's limit.
    pub(super) fn is_within(&self, limit: &Self) -> bool {
        self.pairwise(limit).iter().all(|(wants, limit)| wants <= limit)
    }

    /// Returns a capacity that also holds `other`; sizes that must grow get a quarter more, within the limit.
    pub(super) fn grown_to(&self, other: &Self, limit: &Self) -> Self {
        Self {
            views: grown(self.views, other.views, limit.views),
            camera_blocks: grown(self.camera_blocks, other.camera_blocks, limit.camera_blocks),
            regions: grown(self.regions, other.regions, limit.regions),
            pairs: grown(self.pairs, other.pairs, limit.pairs),
            tiles: grown(self.tiles, other.tiles, limit.tiles),
            pixels: grown(self.pixels, other.pixels, limit.pixels),
        }
    }

    fn pairwise(&self, other: &Self) -> [(u64, u64); 6] {
        [
            (self.views, other.views),
            (self.camera_blocks, other.camera_blocks),
            (self.regions, other.regions),
            (self.pairs, other.pairs),
            (self.tiles, other.tiles),
            (self.pixels, other.pixels),
        ]
    }
}

/// Returns the new size of a buffer: unchanged if sufficient, otherwise a quarter more than wanted, within the limit.
pub(super) fn grown(has: u64, wants: u64, limit: u64) -> u64 {
    if has >= wants { has } else { (wants + wants / 4).min(limit) }
}

/// Buffers, named as in the shaders.
#[derive(Debug)]
pub(super) struct Buffers {
    pub(super) capacity: Capacity,
    pub(super) tick: wgpu::Buffer,
    pub(super) views: wgpu::Buffer,
    pub(super) regions: wgpu::Buffer,
    pub(super) sizes: wgpu::Buffer,
    pub(super) dispatches: wgpu::Buffer,
    pub(super) projected: wgpu::Buffer,
    pub(super) covers: wgpu::Buffer,
    /// Splats per tile and of all images; later the first pair of each tile.
    pub(super) firsts: wgpu::Buffer,
    /// End of the pairs of each tile.
    pub(super) ends: wgpu::Buffer,
    pub(super) pairs: [wgpu::Buffer; 2],
    pub(super) pixels: wgpu::Buffer,
    pub(super) ids: wgpu::Buffer,
}

/// Size of `Projected` of `common.wgsl`. [byte]
const PROJECTED_BYTES: u64 = 48;
/// Size of `sizes`. [byte]
pub(super) const SIZES_BYTES: u64 = 32;

impl Buffers {
    pub(super) fn new(device: &Device, capacity: Capacity, has_ids: bool) -> Self {
        let storage = |label: &str, words: u64| device.storage(label, words * 4);
        let source = |label: &str, words: u64| {
            let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC;
            device.buffer(label, words * 4, usage)
        };
        let counted = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
        let slots = capacity.regions * BLOCK as u64;
        Self {
            capacity,
            tick: device.uniform("tick", &[0; 32]),
            views: storage("views", capacity.views * (size_of::<GpuView>() / 4) as u64),
            regions: storage(
                "regions",
                capacity.camera_blocks + capacity.camera_blocks.div_ceil(256),
            ),
            sizes: device.buffer("sizes", SIZES_BYTES, counted | wgpu::BufferUsages::COPY_SRC),
            dispatches: device.buffer("dispatches", 64, counted | wgpu::BufferUsages::INDIRECT),
            projected: device.storage("projected", slots * PROJECTED_BYTES),
            covers: storage("covers", slots * 4),
            firsts: storage("firsts", capacity.tiles + 1),
            ends: storage("ends", capacity.tiles),
            pairs: [storage("pairs", capacity.pairs * 2), storage("pairs", capacity.pairs * 2)],
            pixels: source("pixels", if device.maps_storage { 0 } else { capacity.pixels * 4 }),
            ids: source("ids", if has_ids && !device.maps_storage { capacity.pixels } else { 0 }),
        }
    }
}
