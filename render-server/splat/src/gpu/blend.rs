//! Pass 5: the pixels of each tile, from near to far.
//!
//! Budget: 48 bytes read per pair that is not behind opaque ones, 16 written per pixel (20 with
//! ids). Bound by arithmetic: some 20 operations per pair and pixel of the tile; a thread has four pixels, for whom it fetches each splat once.

use super::buffers::Buffers;
use super::device::{Device, Groups, Kernel};

const SOURCE: &str = concat!(include_str!("common.wgsl"), include_str!("blend.wgsl"));

/// Workgroups along x; `GRID` in `blend.wgsl`.
const GRID: u32 = 32_768;

/// The pass.
#[derive(Debug)]
pub(super) struct Blend {
    kernel: Kernel,
}

impl Blend {
    pub(super) fn new(device: &Device) -> Self {
        Self { kernel: device.kernel(SOURCE, "blend", &[]) }
    }

    pub(super) fn bind(&self, device: &Device, buffers: &Buffers) -> wgpu::BindGroup {
        let b = buffers;
        device.bind(
            &self.kernel,
            &[
                (0, &b.tick),
                (1, &b.views),
                (2, &b.shapes),
                (3, &b.extents),
                (4, &b.colours),
                (5, &b.slots[b.capacity.tile_digits as usize % 2]),
                (6, &b.lists),
                (7, &b.pixels),
                (8, &b.ids),
            ],
        )
    }

    pub(super) fn run(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        bindings: &wgpu::BindGroup,
        tiles: u32,
    ) {
        let groups = Groups::Known(tiles.min(GRID), tiles.div_ceil(GRID));
        self.kernel.run(pass, bindings, groups);
    }
}
