//! Pass 2: projects the splats of visible blocks onto the image plane.
//!
//! It also finds the tiles that each splat touches, and counts the splats of each tile.
//!
//! Budget: 52 bytes read per splat of a visible block, and 2 per value of its harmonics if it is visible; 16 bytes
//! written per slot and 48 per survivor, and an atomic per pair. At 1 TB/s: 0.1 ms per million visible splats without
//! harmonics, 0.2 ms with those of degree 3.

use super::buffers::Buffers;
use super::device::{Device, Groups, Kernel};
use super::scene::GpuScene;

const SOURCE: &str = concat!(
    include_str!("common.wgsl"),
    include_str!("scan.wgsl"),
    include_str!("ellipse.wgsl"),
    include_str!("cover.wgsl"),
    include_str!("project.wgsl")
);

/// Pass with its kernel.
#[derive(Debug)]
pub(super) struct Project {
    kernel: Kernel,
}

impl Project {
    pub(super) fn new(device: &Device) -> Self {
        Self { kernel: device.kernel(SOURCE, "project", &[]) }
    }

    /// Returns one set of bindings per chunk.
    pub(super) fn bind(
        &self,
        device: &Device,
        scene: &GpuScene,
        buffers: &Buffers,
    ) -> Vec<wgpu::BindGroup> {
        let bind = |chunk: &super::scene::Chunk| {
            device.bind(
                &self.kernel,
                &[
                    (0, &buffers.tick),
                    (1, &buffers.views),
                    (2, &buffers.regions),
                    (3, &chunk.place),
                    (4, &chunk.geometry),
                    (5, &chunk.harmonics),
                    (6, &buffers.projected),
                    (7, &buffers.covers),
                    (8, &buffers.firsts),
                ],
            )
        };
        scene.chunks.iter().map(bind).collect()
    }

    pub(super) fn run(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        bindings: &[wgpu::BindGroup],
        scene: &GpuScene,
        cameras: u32,
    ) {
        for (chunk, bindings) in scene.chunks.iter().zip(bindings) {
            self.kernel.run(pass, bindings, Groups::Known(chunk.blocks, cameras));
        }
    }
}
