//! Pass 5 of training: propagates the sums of the tiles to the parameters of the rows.
//!
//! Budget: 52 bytes read per pair in random order, a row and 64 bytes written per visible splat. One thread iterates
//! over the pairs of a splat: one as large as the image takes longest.

use super::super::device::{Device, Groups, Kernel};
use super::bin::BIN;
use super::buffers::TrainingBuffers;
use super::{DEPTH_BITS, sort};

const SOURCE: &str = concat!(
    include_str!("../common.wgsl"),
    include_str!("../scan.wgsl"),
    include_str!("sizes.wgsl"),
    include_str!("photo.wgsl"),
    include_str!("rows.wgsl"),
    include_str!("unproject.wgsl")
);

/// Pass with its kernel.
#[derive(Debug)]
pub(super) struct Unproject {
    kernel: Kernel,
}

impl Unproject {
    pub(super) fn new(device: &Device) -> Self {
        Self { kernel: device.kernel(SOURCE, "unproject", &[]) }
    }

    pub(super) fn bind(&self, device: &Device, training: &TrainingBuffers) -> wgpu::BindGroup {
        let b = &training.shared;
        device.bind(
            &self.kernel,
            &[
                (0, &training.photo),
                (1, &training.rows),
                (2, &b.order[sort::digits(DEPTH_BITS) as usize % 2]),
                (3, &b.counts),
                (4, &training.places),
                (5, &training.pair_sums),
                (6, &b.sizes),
                (7, &training.gradients),
            ],
        )
    }

    pub(super) fn run(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        bindings: &wgpu::BindGroup,
        dispatches: &wgpu::Buffer,
    ) {
        self.kernel.run(pass, bindings, Groups::Counted(dispatches, BIN));
    }
}
