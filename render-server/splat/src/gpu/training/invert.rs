//! After pass 2 of training: writes the lists of slots, and the position of each splat's pairs in them.
//!
//! Budget: 20 bytes moved per pair, half of them in random order.

use super::super::device::{Device, Groups, Kernel};
use super::bin::PAIRS;
use super::buffers::TrainingBuffers;

const SOURCE: &str = concat!(
    include_str!("../common.wgsl"),
    include_str!("sizes.wgsl"),
    include_str!("invert.wgsl")
);

/// Pass with its kernel.
#[derive(Debug)]
pub(super) struct Invert {
    kernel: Kernel,
}

impl Invert {
    pub(super) fn new(device: &Device) -> Self {
        Self { kernel: device.kernel(SOURCE, "invert", &[]) }
    }

    pub(super) fn bind(&self, device: &Device, training: &TrainingBuffers) -> wgpu::BindGroup {
        let b = &training.shared;
        let sorted = b.capacity.tile_digits as usize % 2;
        device.bind(
            &self.kernel,
            &[
                (0, &b.sizes),
                (1, &b.slots[0]),
                (2, &training.permutation[sorted]),
                (3, &b.tiles[sorted]),
                (4, &b.slots[1]),
                (5, &training.places),
                (6, &b.tick),
            ],
        )
    }

    pub(super) fn run(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        bindings: &wgpu::BindGroup,
        dispatches: &wgpu::Buffer,
    ) {
        self.kernel.run(pass, bindings, Groups::Counted(dispatches, PAIRS.groups));
    }
}
