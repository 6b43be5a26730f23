use proptest::prelude::*;

use super::*;
use crate::occupancy::occupancy_of;

/// Distance by a search over all voxels: the definition.
fn brute_force_m(solid: &[bool], grid: &Grid, at: [usize; 3]) -> f64 {
    let [nx, ny, nz] = grid.size;
    let inside = solid[grid.index(at)];
    let mut least = f64::INFINITY;
    for x in 0..nx {
        for y in 0..ny {
            for z in 0..nz {
                if solid[grid.index([x, y, z])] != inside {
                    least = least.min((grid.center_m([x, y, z]) - grid.center_m(at)).length());
                }
            }
        }
    }
    let to_face_m = least - grid.voxel_m / 2.0;
    if inside { -to_face_m } else { to_face_m }
}

fn check(size: [usize; 3], cells: &[bool]) -> Result<(), TestCaseError> {
    let voxel_m = 0.1;
    let extent = DVec3::new(size[0] as f64, size[1] as f64, size[2] as f64) * voxel_m;
    let grid = Grid::covering(DVec3::ZERO, extent - 1e-6, voxel_m);
    prop_assert_eq!(grid.size, size);
    let solid = |p: DVec3| {
        let at = (p / voxel_m).floor();
        cells[grid.index([at.x as usize, at.y as usize, at.z as usize])]
    };
    let field = DistanceField::of(occupancy_of(grid, 0.0, solid));
    let (most_m, deepest_m) = (field.max_distance_m(), distance_voxels(0) * voxel_m);
    for x in 0..size[0] {
        for y in 0..size[1] {
            for z in 0..size[2] {
                let expected = brute_force_m(cells, &grid, [x, y, z]).clamp(deepest_m, most_m);
                let found = field.obstacle_distance_m(grid.center_m([x, y, z]));
                // A code has a resolution of a tenth of a voxel.
                prop_assert!(
                    (found - expected).abs() <= 0.11 * voxel_m,
                    "at {:?}: {} for {}",
                    [x, y, z],
                    found,
                    expected
                );
            }
        }
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn transform_is_exact(
        size in prop::array::uniform3(1usize..9),
        seed in prop::collection::vec(any::<bool>(), 9 * 9 * 9),
        density in 0usize..4,
    ) {
        let voxels = size.iter().product::<usize>();
        // Sparse to dense: all of `density` neighbours in the seed must be set.
        let cells: Vec<bool> = (0..voxels)
            .map(|i| (0..=density).all(|k| seed[(i * 7 + k * 31) % seed.len()]))
            .collect();
        check(size, &cells)?;
    }
}

#[test]
fn full_and_empty_grids_saturate() {
    check([5, 4, 3], &[true; 60]).unwrap();
    check([5, 4, 3], &[false; 60]).unwrap();
}

#[test]
fn queries_between_and_outside_voxels_are_accurate() {
    let grid = Grid::covering(DVec3::ZERO, DVec3::splat(2.0), 0.05);
    // A ball with a radius of 0.5 m.
    let field = DistanceField::of(occupancy_of(grid, 0.0, |p| (p - DVec3::ONE).length() < 0.5));
    for (p, expected_m) in [
        (DVec3::new(1.9, 1.0, 1.0), 0.4),
        (DVec3::new(1.0, 0.31, 1.0), 0.19),
        (DVec3::new(1.0, 1.0, 1.3), -0.2),
    ] {
        let found_m = field.obstacle_distance_m(p);
        assert!((found_m - expected_m).abs() < 0.05, "{found_m} for {expected_m}");
    }
    assert!(field.obstacle_distance_m(DVec3::NAN).is_nan());
    assert!(field.obstacle_distance_m(DVec3::splat(1e9)).is_finite());
    // Only `distance_m` includes the floor.
    let low = DVec3::new(0.1, 0.1, 0.02);
    assert!(field.obstacle_distance_m(low) > 0.5);
    assert!((field.distance_m(low) - 0.02).abs() < 1e-9);
}

#[test]
fn slice_contains_the_solid_cells_at_its_height() {
    let grid = Grid::covering(DVec3::ZERO, DVec3::new(1.0, 0.5, 2.0), 0.1);
    let field = DistanceField::of(occupancy_of(grid, 0.0, |p| p.z < 1.0 && p.x < 0.5));
    let occupied = |z_m: f64| {
        let slice = field.obstacle_slice(z_m);
        (0..slice.rows)
            .flat_map(|row| (0..slice.columns).map(move |column| (column, row)))
            .filter(|&(column, row)| slice.is_occupied(column, row))
            .count()
    };
    assert_eq!(occupied(0.55), 5 * 5);
    assert_eq!(occupied(1.55), 0);
}
