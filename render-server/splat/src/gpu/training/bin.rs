//! Pass 4: lists the splats that touch each tile, from near to far.
//!
//! Budget: 36 bytes read twice per visible splat in random order, 8 written per pair, then two digits of a sort
//! (three above 65 k tiles) at 20 bytes per pair. One thread iterates over the rows of tiles of a splat: a splat as
//! large as the image takes longest, about 1 us per hundred tiles.

use super::super::device::{Device, Groups, Kernel};
use super::sort::{Count, Digit, Pairs, Sort};
use super::tiling::Buffers;

const SOURCE: &str = concat!(
    include_str!("../common.wgsl"),
    include_str!("../scan.wgsl"),
    include_str!("sizes.wgsl"),
    include_str!("../ellipse.wgsl"),
    include_str!("bin.wgsl")
);

/// Words of `sizes` and `dispatches`, as in `sizes.wgsl`.
pub(super) const PAIRS: Count = Count { size: 4, groups: 12 };
pub(super) const BIN: u32 = 8;

/// Pass with its kernels.
#[derive(Debug)]
pub(super) struct Bin {
    count_visible: Kernel,
    count_tiles: Kernel,
    place_pairs: Kernel,
    emit: Kernel,
    bound: Kernel,
}

/// Bindings of the buffers.
#[derive(Debug)]
pub(super) struct BinBindings {
    count_visible: wgpu::BindGroup,
    count_tiles: wgpu::BindGroup,
    place_pairs: wgpu::BindGroup,
    emit: wgpu::BindGroup,
    digits: Vec<Digit>,
    bound: wgpu::BindGroup,
}

impl Bin {
    pub(super) fn new(device: &Device) -> Self {
        let kernel = |entry: &str| device.kernel(SOURCE, entry, &[]);
        Self {
            count_visible: kernel("count_visible"),
            count_tiles: kernel("count_tiles"),
            place_pairs: kernel("place_pairs"),
            emit: kernel("emit"),
            bound: kernel("bound"),
        }
    }

    /// Binds the buffers; `order` is the result of the sort by depth. With a `permutation`, the sort by tile writes
    /// the indices of pairs there, and leaves their slots in `slots[0]` in the order in which they were emitted.
    pub(super) fn bind(
        &self,
        device: &Device,
        sort: &Sort,
        buffers: &Buffers,
        order: &wgpu::Buffer,
        permutation: Option<[&wgpu::Buffer; 2]>,
    ) -> BinBindings {
        let b = buffers;
        let pairs = Pairs {
            keys: [&b.tiles[0], &b.tiles[1]],
            values: permutation.unwrap_or([&b.slots[0], &b.slots[1]]),
            counts: &b.digits,
            sizes: &b.sizes,
        };
        let sorted = b.capacity.tile_digits as usize % 2;
        let tile_bits = b.capacity.tile_digits * 8;
        let (tick, views, sizes) = ((0, &b.tick), (1, &b.views), (2, &b.sizes));
        let (dispatches, order, counts) = ((3, &b.dispatches), (4, order), (7, &b.counts));
        let (shapes, extents) = ((5, &b.shapes), (6, &b.extents));
        BinBindings {
            count_visible: device.bind(&self.count_visible, &[sizes, dispatches, (10, &b.digits)]),
            count_tiles: device
                .bind(&self.count_tiles, &[tick, views, sizes, order, shapes, extents, counts]),
            place_pairs: device.bind(&self.place_pairs, &[tick, sizes, dispatches, counts]),
            emit: device.bind(
                &self.emit,
                &[
                    tick,
                    views,
                    sizes,
                    order,
                    shapes,
                    extents,
                    counts,
                    (8, &b.tiles[0]),
                    (9, &b.slots[0]),
                ],
            ),
            digits: sort.bind(device, pairs, tile_bits, [PAIRS; 2], permutation.is_some()),
            bound: device.bind(&self.bound, &[tick, sizes, (11, &b.tiles[sorted]), (12, &b.lists)]),
        }
    }

    /// Counts the visible splats, from the counts of the first digit of the sort by depth.
    pub(super) fn count_visible(&self, pass: &mut wgpu::ComputePass<'_>, bindings: &BinBindings) {
        self.count_visible.run(pass, &bindings.count_visible, Groups::Known(1, 1));
    }

    pub(super) fn run(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        bindings: &BinBindings,
        sort: &Sort,
        buffers: &Buffers,
    ) {
        let dispatches = &buffers.dispatches;
        self.count_tiles.run(pass, &bindings.count_tiles, Groups::Counted(dispatches, BIN));
        self.place_pairs.run(pass, &bindings.place_pairs, Groups::Known(1, 1));
        self.emit.run(pass, &bindings.emit, Groups::Counted(dispatches, BIN));
        for digit in &bindings.digits {
            sort.run(pass, digit, dispatches);
        }
        self.bound.run(pass, &bindings.bound, Groups::Counted(dispatches, PAIRS.groups));
    }
}
