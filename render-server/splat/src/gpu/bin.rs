//! Pass 3: lists the splats that touch each tile, in any order.
//!
//! Budget: 16 bytes read per slot; 8 written per pair, at positions that one atomic per pair returns; two dispatches,
//! and 12 bytes per tile.

use super::buffers::Buffers;
use super::device::{Device, Groups, Kernel};

const SOURCE: &str = concat!(
    include_str!("common.wgsl"),
    include_str!("scan.wgsl"),
    include_str!("sizes.wgsl"),
    include_str!("cover.wgsl"),
    include_str!("bin.wgsl")
);

/// Pass with its kernels.
#[derive(Debug)]
pub(super) struct Bin {
    place: Kernel,
    emit: Kernel,
}

/// Bindings of the buffers.
#[derive(Debug)]
pub(super) struct BinBindings {
    place: wgpu::BindGroup,
    emit: wgpu::BindGroup,
}

impl Bin {
    pub(super) fn new(device: &Device) -> Self {
        Self {
            place: device.kernel(SOURCE, "place", &[]),
            emit: device.kernel(SOURCE, "emit", &[]),
        }
    }

    pub(super) fn bind(&self, device: &Device, buffers: &Buffers) -> BinBindings {
        let b = buffers;
        let (tick, sizes, ends) = ((0, &b.tick), (2, &b.sizes), (5, &b.ends));
        let emit = [tick, (1, &b.views), sizes, (3, &b.covers), ends, (6, &b.pairs[0])];
        BinBindings {
            place: device.bind(&self.place, &[tick, sizes, (4, &b.firsts), ends]),
            emit: device.bind(&self.emit, &emit),
        }
    }

    pub(super) fn run(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        bindings: &BinBindings,
        buffers: &Buffers,
    ) {
        self.place.run(pass, &bindings.place, Groups::Known(1, 1));
        self.emit.run(pass, &bindings.emit, Groups::Counted(&buffers.dispatches, 0));
    }
}
