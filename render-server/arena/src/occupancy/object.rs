//! Voxels of one object, in its own frame: all components are kept, however small, and there is no floor.

use super::components::{Connectivity, Runs};
use super::{BakeCounts, BakeSpec, Ellipsoid, OccupancyGrid, Prepared, splat_into};
use crate::grid::Grid;

impl OccupancyGrid {
    /// Bakes the splats of an object into voxels of the object's frame.
    pub fn bake_object(
        ellipsoids: impl IntoIterator<Item = Ellipsoid>,
        grid: Grid,
        min_opacity: f32,
    ) -> Self {
        let floor_z_m = grid.min_m.z - NO_FLOOR_M;
        let spec = BakeSpec { grid, min_opacity, floor_z_m, min_splats_per_m3: 0.0 };
        let mut counts = BakeCounts::default();
        let mut prepared = Vec::new();
        for ellipsoid in ellipsoids {
            match Prepared::new(&ellipsoid, &spec) {
                Some(splat) => prepared.push(splat),
                None => counts.splats_left_out += 1,
            }
        }
        counts.splats_used = prepared.len();
        let mut cells = vec![0; grid.voxels()];
        splat_into(&prepared, &grid, &mut cells, &|_| ());
        // Free components that do not reach the grid's sides are inside.
        let inside = |low: &u32, high: &u32, size: usize| *low > 0 && (*high as usize) < size;
        counts.enclosed =
            Runs::of(&cells, &grid, 0, Connectivity::Faces).overwrite(&mut cells, 1, |component| {
                let sides = component.low.iter().zip(&component.high).zip(grid.size);
                sides.into_iter().all(|((low, high), size)| inside(low, high, size))
            });
        counts.occupied = cells.iter().map(|&cell| usize::from(cell)).sum();
        Self { grid, cells, floor_z_m, unseen: Vec::new(), counts }
    }
}

/// Depth of the floor below an object, out of reach of every query. [m]
const NO_FLOOR_M: f64 = 1e4;

#[cfg(test)]
mod tests {
    use glam::{DVec3, Quat, Vec3};

    use super::*;
    use crate::distance::DistanceField;

    #[test]
    fn keeps_the_smallest_object() {
        let grid = Grid::covering(DVec3::splat(-0.5), DVec3::splat(0.5), 0.02);
        let dot = Ellipsoid {
            center_m: Vec3::ZERO,
            scales_m: Vec3::splat(0.02),
            rotation: Quat::IDENTITY,
            opacity: 0.95,
        };
        let baked = OccupancyGrid::bake_object([dot], grid, 0.3);
        assert!((1..200).contains(&baked.counts().occupied), "{:?}", baked.counts());
        let field = DistanceField::of(baked);
        assert!(field.obstacle_distance_m(DVec3::ZERO) < 0.0);
        let beside_m = field.distance_m(DVec3::new(0.3, 0.0, 0.0));
        assert!((0.24..0.3).contains(&beside_m), "no floor, but the dot: {beside_m}");
    }
}
