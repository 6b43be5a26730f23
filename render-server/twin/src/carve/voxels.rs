//! A grid of voxels along the world's axes, with one bit per voxel.

use glam::DVec3;

/// Position and size of a grid. Order: x slowest, z fastest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Voxels {
    /// Minimum corner of the grid. [m, world]
    pub min_m: DVec3,
    /// Side of a voxel. [m]
    pub side_m: f64,
    /// Number of voxels along x, y and z, each at least 1.
    pub size: [usize; 3],
}

impl Voxels {
    /// Returns the number of voxels.
    pub fn len(&self) -> usize {
        self.size.iter().product()
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the centre of a voxel. [m, world]
    pub fn center_m(&self, [x, y, z]: [usize; 3]) -> DVec3 {
        self.min_m + (DVec3::new(x as f64, y as f64, z as f64) + 0.5) * self.side_m
    }

    /// Returns the voxels whose centres lie between two corners, as ranges along x, y and z. [m, world]
    pub(super) fn within(&self, low_m: DVec3, high_m: DVec3) -> [std::ops::Range<usize>; 3] {
        let first = ((low_m - self.min_m) / self.side_m - 0.5).ceil().max(DVec3::ZERO);
        let end = ((high_m - self.min_m) / self.side_m + 0.5).floor().max(DVec3::ZERO);
        let range = |first: f64, end: f64, size: usize| {
            let end = (end as usize).min(size);
            (first as usize).min(end)..end
        };
        let [nx, ny, nz] = self.size;
        [range(first.x, end.x, nx), range(first.y, end.y, ny), range(first.z, end.z, nz)]
    }
}

/// Voxels that were seen to be free.
#[derive(Clone, Debug, PartialEq)]
pub struct Seen {
    pub voxels: Voxels,
    /// One bit per voxel in their order, low bit first, `ceil(voxels / 8)` bytes; unused bits are 0.
    pub bits: Vec<u8>,
}

impl Seen {
    /// Returns a grid without seen voxels.
    pub(super) fn nothing(voxels: Voxels) -> Self {
        Self { voxels, bits: vec![0; voxels.len().div_ceil(8)] }
    }

    pub fn is_seen(&self, [x, y, z]: [usize; 3]) -> bool {
        let [_, ny, nz] = self.voxels.size;
        let at = (x * ny + y) * nz + z;
        self.bits[at / 8] >> (at % 8) & 1 == 1
    }

    /// Returns the number of seen voxels.
    pub fn count(&self) -> usize {
        self.bits.iter().map(|byte| byte.count_ones() as usize).sum()
    }

    pub(super) fn mark(&mut self, [x, y, z]: [usize; 3]) {
        let [_, ny, nz] = self.voxels.size;
        let at = (x * ny + y) * nz + z;
        self.bits[at / 8] |= 1 << (at % 8);
    }
}
