//! Pass 4: sorts the list of each tile from near to far.
//!
//! Budget: 16 bytes moved per pair. Comparisons in workgroup memory: about 50 per pair in a list of 1024, one to two
//! microseconds. Longer lists merge their runs of 1024: 16 bytes moved per pair and doubling.

use super::buffers::Buffers;
use super::device::{Device, Groups, Kernel};

const SOURCE: &str = concat!(include_str!("common.wgsl"), include_str!("sort.wgsl"));

/// Pass with its kernel.
#[derive(Debug)]
pub(super) struct Sort {
    kernel: Kernel,
}

impl Sort {
    pub(super) fn new(device: &Device) -> Self {
        Self { kernel: device.kernel(SOURCE, "sort", &[]) }
    }

    pub(super) fn bind(&self, device: &Device, buffers: &Buffers) -> wgpu::BindGroup {
        let b = buffers;
        device.bind(
            &self.kernel,
            &[(0, &b.tick), (1, &b.firsts), (2, &b.ends), (3, &b.pairs[0]), (4, &b.pairs[1])],
        )
    }

    pub(super) fn run(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        bindings: &wgpu::BindGroup,
        tiles: u32,
    ) {
        self.kernel.run(pass, bindings, Groups::of_tiles(tiles));
    }
}

#[cfg(test)]
mod tests;
