//! Passes 3 and 4 of training: renders the pixels of each tile from its list, and propagates the derivative of a loss
//! by the pixels back to the list.
//!
//! Backward, the sums of a splat over the 256 pixels of a tile are added in workgroup memory in a fixed order, and
//! written to the pair's own place: no atomics, and bit-identical results in every run.
//!
//! Budget: 48 bytes read per pair that is not hidden by opaque ones, 24 written per pixel; backward 52 read per pixel
//! and 48 written per pair. Limited by arithmetic: about 25 operations per pair and pixel forward, 70 backward, and
//! 64 additions by each of 44 threads for four pairs.

use super::super::device::{Device, Groups, Kernel};
use super::buffers::TrainingBuffers;

const SOURCE: &str =
    concat!(include_str!("../common.wgsl"), include_str!("photo.wgsl"), include_str!("blend.wgsl"));

/// Passes with their kernels.
#[derive(Debug)]
pub(super) struct Blend {
    forward: Kernel,
    back: Kernel,
}

/// Bindings of the buffers.
#[derive(Debug)]
pub(super) struct BlendBindings {
    forward: wgpu::BindGroup,
    back: wgpu::BindGroup,
}

impl Blend {
    pub(super) fn new(device: &Device) -> Self {
        let kernel = |entry: &str| device.kernel(SOURCE, entry, &[]);
        Self { forward: kernel("blend"), back: kernel("blend_back") }
    }

    pub(super) fn bind(&self, device: &Device, training: &TrainingBuffers) -> BlendBindings {
        let b = &training.shared;
        let both = [
            (0, &training.photo),
            (1, &b.shapes),
            (2, &b.extents),
            (3, &b.colours),
            (4, &b.slots[1]),
            (5, &b.lists),
            (6, &training.image),
        ];
        let back = [&both[..], &[(7, &training.by), (8, &training.pair_sums)]].concat();
        BlendBindings {
            forward: device.bind(&self.forward, &both),
            back: device.bind(&self.back, &back),
        }
    }

    pub(super) fn run(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        bindings: &BlendBindings,
        tiles: u32,
    ) {
        self.forward.run(pass, &bindings.forward, Groups::of_tiles(tiles));
    }

    pub(super) fn run_back(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        bindings: &BlendBindings,
        tiles: u32,
    ) {
        self.back.run(pass, &bindings.back, Groups::of_tiles(tiles));
    }
}
