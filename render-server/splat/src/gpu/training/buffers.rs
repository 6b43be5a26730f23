//! Buffers between the passes of training, in addition to [`Buffers`].
//!
//! Memory: 132 bytes per row plus twice its values, 76 per pair, 52 per pixel.

use super::super::buffers::grown;
use super::super::device::Device;
use super::photo::PHOTO_BYTES;
use super::tiling::{Buffers, Capacity};
use super::{BY_CHANNELS, CHANNELS, RowGradient};
use crate::blocks::BLOCK;

/// Number of words of a pair's sums.
const PAIR_WORDS: u64 = 12;

/// Capacity of the buffers, in addition to the shared [`Capacity`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct TrainingCapacity {
    pub(super) shared: Capacity,
    /// Number of values of all rows.
    pub(super) row_words: u64,
    /// Number of values of a channel.
    pub(super) plane: u64,
}

impl TrainingCapacity {
    /// Returns the maximum capacity of a device.
    pub(super) fn limit(binding_bytes: u64) -> Self {
        // Reduced so that the sums of pairs, the largest buffer per pair, also fit.
        let shared = Capacity::limit(binding_bytes / PAIR_WORDS);
        let channels = BY_CHANNELS as u64;
        Self { shared, row_words: binding_bytes / 4, plane: binding_bytes / (4 * channels) }
    }

    /// Returns whether it is at least as large as another capacity.
    pub(super) fn holds(&self, other: &Self) -> bool {
        self.shared.holds(&other.shared)
            && self.row_words >= other.row_words
            && self.plane >= other.plane
    }

    /// Returns whether it is within the device's limit.
    pub(super) fn is_within(&self, limit: &Self) -> bool {
        self.shared.is_within(&limit.shared)
            && self.shared.tile_digits <= limit.shared.tile_digits
            && self.row_words <= limit.row_words
            && self.plane <= limit.plane
    }

    /// Returns a capacity that also holds `other`; sizes that must grow get a quarter more, within the limit.
    pub(super) fn grown_to(&self, other: &Self, limit: &Self) -> Self {
        Self {
            shared: self.shared.grown_to(&other.shared, &limit.shared),
            row_words: grown(self.row_words, other.row_words, limit.row_words),
            plane: grown(self.plane, other.plane, limit.plane),
        }
    }
}

/// Buffers, named as in the shaders.
#[derive(Debug)]
pub(super) struct TrainingBuffers {
    pub(super) capacity: TrainingCapacity,
    pub(super) shared: Buffers,
    pub(super) photo: wgpu::Buffer,
    pub(super) rows: wgpu::Buffer,
    /// Changed rows.
    pub(super) changes: wgpu::Buffer,
    pub(super) image: wgpu::Buffer,
    pub(super) by: wgpu::Buffer,
    /// Indices of pairs, before and after each digit of the sort by tile.
    pub(super) permutation: [wgpu::Buffer; 2],
    pub(super) places: wgpu::Buffer,
    pub(super) pair_sums: wgpu::Buffer,
    pub(super) gradients: wgpu::Buffer,
}

impl TrainingBuffers {
    pub(super) fn new(device: &Device, capacity: TrainingCapacity) -> Self {
        let storage = |label: &str, words: u64| device.storage(label, words * 4);
        let source = |label: &str, bytes: u64| {
            let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC;
            device.buffer(label, bytes, usage)
        };
        let Capacity { pairs, regions, .. } = capacity.shared;
        let slots = regions * BLOCK as u64;
        Self {
            shared: Buffers::new(device, capacity.shared),
            photo: device.uniform("photo", &[0; PHOTO_BYTES]),
            rows: storage("rows", capacity.row_words),
            changes: storage("changes", capacity.row_words),
            image: source("image", capacity.plane * CHANNELS as u64 * 4),
            by: storage("by", capacity.plane * BY_CHANNELS as u64),
            permutation: [storage("permutation", pairs), storage("permutation", pairs)],
            places: storage("places", pairs),
            pair_sums: storage("pair sums", pairs * PAIR_WORDS),
            gradients: source("gradients", slots * size_of::<RowGradient>() as u64),
            capacity,
        }
    }
}
