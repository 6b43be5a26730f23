//! Pass 1: finds the blocks that each camera may see, at the coarsest sufficient level.
//!
//! Budget: 48 bytes read per camera and block of 256 splats, and for its ancestors in adaptive detail; 4 written; two
//! dispatches, about 5 us per million splats.

use super::buffers::Buffers;
use super::device::{Device, Groups, Kernel};
use super::scene::GpuScene;

const SOURCE: &str = concat!(
    include_str!("common.wgsl"),
    include_str!("scan.wgsl"),
    include_str!("sizes.wgsl"),
    include_str!("cull.wgsl")
);

/// Pass with its kernels.
#[derive(Debug)]
pub(super) struct Cull {
    cull: Kernel,
    place: Kernel,
}

/// Bindings of the buffers.
#[derive(Debug)]
pub(super) struct CullBindings {
    cull: wgpu::BindGroup,
    place: wgpu::BindGroup,
}

impl Cull {
    pub(super) fn new(device: &Device) -> Self {
        Self {
            cull: device.kernel(SOURCE, "cull", &[]),
            place: device.kernel(SOURCE, "place", &[]),
        }
    }

    pub(super) fn bind(
        &self,
        device: &Device,
        scene: &GpuScene,
        buffers: &Buffers,
    ) -> CullBindings {
        CullBindings {
            cull: device.bind(
                &self.cull,
                &[
                    (0, &buffers.tick),
                    (1, &buffers.views),
                    (2, &scene.blocks),
                    (3, &buffers.regions),
                ],
            ),
            place: device.bind(
                &self.place,
                &[
                    (0, &buffers.tick),
                    (3, &buffers.regions),
                    (4, &buffers.sizes),
                    (5, &buffers.dispatches),
                ],
            ),
        }
    }

    /// Runs the pass for `count` pairs of camera and block.
    pub(super) fn run(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        bindings: &CullBindings,
        count: u32,
    ) {
        self.cull.run(pass, &bindings.cull, Groups::Known(count.div_ceil(256), 1));
        self.place.run(pass, &bindings.place, Groups::Known(1, 1));
    }
}
