//! Regular grid of voxels in the world: sizes, indices, positions.

use glam::DVec3;

/// Position and size of the grid. Index order: x slowest, z fastest, so that a plane of constant x is
/// contiguous, and also a column of constant x and y.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grid {
    /// Corner of the first voxel with the smallest coordinates. [m, world]
    pub min_m: DVec3,
    /// Side of a voxel. [m]
    pub voxel_m: f64,
    /// Number of voxels along x, y and z, each at least 1.
    pub size: [usize; 3],
}

impl Grid {
    /// Returns the grid that covers the box from `min_m` to `max_m`. [m, world]
    ///
    /// ```
    /// use glam::DVec3;
    /// use vizflyt_arena::grid::Grid;
    /// let grid = Grid::covering(DVec3::ZERO, DVec3::new(1.0, 0.5, 0.26), 0.25);
    /// assert_eq!(grid.size, [4, 2, 2]);
    /// assert_eq!(grid.center_m([1, 0, 0]), DVec3::new(0.375, 0.125, 0.125));
    /// ```
    ///
    /// # Panics
    /// If the box or the voxel is not finite, or the voxel is not positive.
    pub fn covering(min_m: DVec3, max_m: DVec3, voxel_m: f64) -> Self {
        assert!(min_m.is_finite() && max_m.is_finite() && voxel_m.is_finite() && voxel_m > 0.0);
        // The tolerance keeps 1.0 / 0.05 at 20 voxels.
        let size = ((max_m - min_m) / voxel_m - 1e-6).ceil().max(DVec3::ONE);
        Self { min_m, voxel_m, size: [size.x as usize, size.y as usize, size.z as usize] }
    }

    pub fn voxels(&self) -> usize {
        self.size.iter().product()
    }

    /// Returns the number of voxels in a plane of constant x.
    pub fn plane(&self) -> usize {
        self.size[1] * self.size[2]
    }

    /// Returns the index of a voxel in an array.
    pub fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (x * self.size[1] + y) * self.size[2] + z
    }

    /// Returns a voxel's centre. [m, world]
    pub fn center_m(&self, [x, y, z]: [usize; 3]) -> DVec3 {
        self.min_m + (DVec3::new(x as f64, y as f64, z as f64) + 0.5) * self.voxel_m
    }

    /// Returns the corner with the largest coordinates. [m, world]
    pub fn max_m(&self) -> DVec3 {
        let [x, y, z] = self.size;
        self.min_m + DVec3::new(x as f64, y as f64, z as f64) * self.voxel_m
    }

    /// Returns the layer that contains a height, limited to the grid. [m, world]
    pub fn layer_at(&self, z_m: f64) -> usize {
        (((z_m - self.min_m.z) / self.voxel_m).max(0.0) as usize).min(self.size[2] - 1)
    }
}
