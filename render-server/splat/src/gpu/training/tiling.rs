//! Buffers between `project`, `sort`, `bin` and `blend`; reused for each photo, and only ever grown.
//!
//! The number of pairs (of tile and row) of a photo is known only on the device: it counts the required number and
//! uses the available room. If the room was too small, the buffers grow and the photo is rendered again.
//!
//! Memory: 68 bytes per row, 16 per pair, 8 per tile.

use super::super::buffers::{SIZES_BYTES, grown};
use super::super::device::Device;
use super::super::view::GpuView;
use super::sort;
use crate::blocks::BLOCK;

/// Capacity of the buffers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Capacity {
    /// Number of blocks of rows.
    pub(super) regions: u64,
    pub(super) pairs: u64,
    pub(super) tiles: u64,
    /// Number of digits of a tile's index; must be equal, instead of at least as large.
    pub(super) tile_digits: u32,
}

impl Capacity {
    /// Returns the maximum capacity of a device.
    pub(super) fn limit(binding_bytes: u64) -> Self {
        // Binning runs one workgroup of 256 threads per 256 visible splats, at most 65535.
        let slots = (binding_bytes / 16).min(65_535 * 256);
        Self {
            regions: slots / BLOCK as u64,
            // The counts of the sort take half a byte per pair; fewer than 65535 groups sort them.
            pairs: (binding_bytes / 4).min(65_535 * sort::SORT_GROUP),
            tiles: binding_bytes / 8,
            tile_digits: 4,
        }
    }

    /// Returns whether it is at least as large as another capacity.
    pub(super) fn holds(&self, other: &Self) -> bool {
        self.pairwise(other).iter().all(|(has, wants)| has >= wants)
            && self.tile_digits == other.tile_digits
    }

    /// Returns whether it is within the device's limit.
    pub(super) fn is_within(&self, limit: &Self) -> bool {
        self.pairwise(limit).iter().all(|(wants, limit)| wants <= limit)
    }

    /// Returns a capacity that also holds `other`; sizes that must grow get a quarter more, within the limit.
    pub(super) fn grown_to(&self, other: &Self, limit: &Self) -> Self {
        Self {
            regions: grown(self.regions, other.regions, limit.regions),
            pairs: grown(self.pairs, other.pairs, limit.pairs),
            tiles: grown(self.tiles, other.tiles, limit.tiles),
            tile_digits: other.tile_digits,
        }
    }

    fn pairwise(&self, other: &Self) -> [(u64, u64); 3] {
        [(self.regions, other.regions), (self.pairs, other.pairs), (self.tiles, other.tiles)]
    }
}

/// Buffers, named as in the shaders.
#[derive(Debug)]
pub(super) struct Buffers {
    pub(super) capacity: Capacity,
    pub(super) tick: wgpu::Buffer,
    pub(super) views: wgpu::Buffer,
    pub(super) sizes: wgpu::Buffer,
    pub(super) dispatches: wgpu::Buffer,
    pub(super) shapes: wgpu::Buffer,
    pub(super) extents: wgpu::Buffer,
    pub(super) colours: wgpu::Buffer,
    pub(super) keys: [wgpu::Buffer; 2],
    pub(super) order: [wgpu::Buffer; 2],
    /// Digit counts of sorts.
    pub(super) digits: wgpu::Buffer,
    /// Number of tiles of each splat.
    pub(super) counts: wgpu::Buffer,
    pub(super) tiles: [wgpu::Buffer; 2],
    pub(super) slots: [wgpu::Buffer; 2],
    pub(super) lists: wgpu::Buffer,
}

impl Buffers {
    pub(super) fn new(device: &Device, capacity: Capacity) -> Self {
        let storage = |label: &str, words: u64| device.storage(label, words * 4);
        let counted = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
        let slots = capacity.regions * BLOCK as u64;
        Self {
            capacity,
            tick: device.uniform("tick", &[0; 32]),
            views: device.storage("views", size_of::<GpuView>() as u64),
            sizes: device.buffer("sizes", SIZES_BYTES, counted | wgpu::BufferUsages::COPY_SRC),
            dispatches: device.buffer("dispatches", 64, counted | wgpu::BufferUsages::INDIRECT),
            shapes: storage("shapes", slots * 4),
            extents: storage("extents", slots * 4),
            colours: storage("colours", slots * 4),
            keys: [storage("keys", slots), storage("keys", slots)],
            order: [storage("order", slots), storage("order", slots)],
            digits: device.storage("digits", sort::count_bytes(slots.max(capacity.pairs))),
            counts: storage("counts", slots + slots.div_ceil(256)),
            tiles: [storage("tiles", capacity.pairs), storage("tiles", capacity.pairs)],
            slots: [storage("slots", capacity.pairs), storage("slots", capacity.pairs)],
            lists: storage("lists", capacity.tiles * 2),
        }
    }
}
