//! Bakes splats on known solids and compares the result with the solids' own distance: straight and oblique
//! walls, beams, trunks down to the thinnest, at several voxel sizes.

use glam::{DQuat, DVec3, Quat, Vec3};
use vizflyt_arena::grid::Grid;
use vizflyt_arena::occupancy::FLOOR_BAND_M;
use vizflyt_arena::{BakeSpec, DistanceField, Ellipsoid, OccupancyGrid};
use vizflyt_protocol::geometry::Volume;

const TAU: f64 = std::f64::consts::TAU;

/// A deterministic generator of numbers.
struct Random(u64);

impl Random {
    /// Returns the next number in 0..1.
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }
    fn within(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.next()
    }
}

/// A disc on a surface, with the spread of sizes and opacities of trained scenes.
fn disc(center_m: DVec3, normal: DVec3, random: &mut Random) -> Ellipsoid {
    let onto = DQuat::from_rotation_arc(DVec3::Z, normal.normalize());
    let turn = DQuat::from_rotation_z(random.within(0.0, TAU));
    let mut wide = || random.within(0.02, 0.04);
    let (a, b) = (wide(), wide());
    Ellipsoid {
        center_m: center_m.as_vec3(),
        scales_m: DVec3::new(a, b, random.within(0.001, 0.006)).as_vec3(),
        rotation: (onto * turn).as_quat(),
        opacity: random.within(0.75, 0.99) as f32,
    }
}

/// Discs over a box, one per 3 cm square; stratified, to prevent random holes.
fn over_box(
    center_m: DVec3,
    half_m: DVec3,
    rotation: DQuat,
    random: &mut Random,
) -> Vec<Ellipsoid> {
    let mut discs = Vec::new();
    for axis in 0..3 {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let cells = |half_m: f64| (2.0 * half_m / 0.03).ceil() as usize;
        let (across, down) = (cells(half_m[u]), cells(half_m[v]));
        for (side, n) in
            [-1.0, 1.0].into_iter().flat_map(|s| (0..across * down).map(move |n| (s, n)))
        {
            let mut place =
                |n: usize, of: usize| 2.0 * (n as f64 + random.next()) / of as f64 - 1.0;
            let (mut local, mut normal) = (DVec3::ZERO, DVec3::ZERO);
            local[u] = half_m[u] * place(n % across, across);
            local[v] = half_m[v] * place(n / across, down);
            (local[axis], normal[axis]) = (side * half_m[axis], side);
            discs.push(disc(center_m + rotation * local, rotation * normal, random));
        }
    }
    discs
}

/// Discs around an upright cylinder, from z = 0 up.
fn over_trunk(foot: DVec3, radius_m: f64, height_m: f64, random: &mut Random) -> Vec<Ellipsoid> {
    let around = (TAU * radius_m / 0.03).ceil() as usize;
    let up = (height_m / 0.03).ceil() as usize;
    (0..around * up)
        .map(|n| {
            let angle = TAU * ((n % around) as f64 + random.next()) / around as f64;
            let z = height_m * ((n / around) as f64 + random.next()) / up as f64;
            let normal = DVec3::new(angle.cos(), angle.sin(), 0.0);
            disc(foot + DVec3::Z * z + normal * radius_m, normal, random)
        })
        .collect()
}

fn hall(random: &mut Random) -> (Vec<Volume>, Vec<Ellipsoid>) {
    let (mut solids, mut splats) = (Vec::new(), Vec::new());
    for (center_m, half_m, turn) in [
        (DVec3::new(1.0, 2.0, 1.0), DVec3::new(0.02, 1.0, 1.2), 0.0),
        (DVec3::new(2.5, 2.0, 1.0), DVec3::new(0.03, 1.0, 1.2), 0.6),
        (DVec3::new(4.0, 1.0, 1.2), DVec3::new(0.05, 0.6, 0.05), 0.3),
    ] {
        let rotation = DQuat::from_rotation_z(turn) * DQuat::from_rotation_y(turn * 0.4);
        solids.push(Volume::Cuboid { center_m, half_m, rotation });
        splats.extend(over_box(center_m, half_m, rotation, random));
    }
    for (x, y, radius_m) in [(4.0, 3.0, 0.12), (4.6, 2.2, 0.25), (5.3, 1.2, 0.06)] {
        let foot = DVec3::new(x, y, 0.0);
        solids.push(Volume::Capsule { a_m: foot, b_m: foot + DVec3::Z * 3.0, radius_m });
        splats.extend(over_trunk(foot, radius_m, 3.0, random));
    }
    (solids, splats)
}

fn bake(splats: Vec<Ellipsoid>, max_m: DVec3, voxel_m: f64) -> DistanceField {
    let grid = Grid::covering(DVec3::ZERO, max_m, voxel_m);
    let spec = BakeSpec { grid, min_opacity: 0.3, floor_z_m: 0.0, min_splats_per_m3: 30.0 };
    DistanceField::of(OccupancyGrid::bake(splats, &spec))
}

#[test]
fn detects_bodies_within_a_voxel_without_false_alarms() {
    const BODY_M: f64 = 0.12;
    for (voxel_m, seed) in [(0.05, 1), (0.05, 2), (0.08, 3), (0.03, 4)] {
        let mut random = Random(seed);
        let (solids, splats) = hall(&mut random);
        let max_m = DVec3::new(6.0, 4.0, 2.5);
        let field = bake(splats, max_m, voxel_m);
        let (mut touching, mut clear, mut alarms) = (0, 0, 0);
        while touching < 10_000 || clear < 10_000 {
            let p = DVec3::new(random.next(), random.next(), random.next()) * max_m;
            let truth = solids.iter().map(|s| s.signed_distance_m(p)).fold(f64::INFINITY, f64::min);
            // Only positions of a free body, near an obstacle, and above the band of litter.
            if !(0.0..0.6).contains(&truth) || p.z < FLOOR_BAND_M {
                continue;
            }
            let flagged = !(field.obstacle_distance_m(p) > BODY_M);
            if truth < BODY_M - voxel_m {
                touching += 1;
                assert!(flagged, "missed at {p}, {truth:.3} m from a solid, voxel {voxel_m} m");
            } else if truth > BODY_M + 1.5 * voxel_m {
                clear += 1;
                alarms += usize::from(flagged);
            }
        }
        println!("voxel {voxel_m} m: {alarms} false alarms of {clear}");
        assert!(alarms * 100 <= clear, "{alarms} false alarms of {clear} at {voxel_m} m");
    }
}

#[test]
fn walls_have_no_holes_and_are_accurate_to_a_voxel() {
    for shift in 0..10u32 {
        let mut random = Random(u64::from(shift));
        let x_m = 1.0 + 0.005 * f64::from(shift);
        let (center_m, half_m) = (DVec3::new(x_m, 1.0, 1.0), DVec3::new(0.001, 0.9, 0.9));
        let wall = over_box(center_m, half_m, DQuat::IDENTITY, &mut random);
        let grid = Grid::covering(DVec3::ZERO, DVec3::splat(2.0), 0.05);
        let spec = BakeSpec { grid, min_opacity: 0.3, floor_z_m: 0.0, min_splats_per_m3: 30.0 };
        let baked = OccupancyGrid::bake(wall, &spec);
        for (y, z) in (8..32).flat_map(|y| (8..32).map(move |z| (y, z))) {
            let solid = |&x: &usize| baked.is_occupied([x, y, z]);
            let first = (0..40).find(solid).unwrap_or_else(|| panic!("hole at {y} {z}, {x_m} m"));
            let end = 1 + (0..40).rfind(solid).unwrap_or(first);
            let (low_m, high_m) = (0.05 * first as f64, 0.05 * end as f64);
            assert!(low_m > x_m - 0.0751 && high_m < x_m + 0.0751, "{low_m}..{high_m} at {x_m}");
        }
    }
}

#[test]
fn overlapping_splats_do_not_extend_obstacles() {
    let fat = Ellipsoid {
        center_m: Vec3::ONE,
        scales_m: Vec3::splat(0.1),
        rotation: Quat::IDENTITY,
        opacity: 0.9,
    };
    let field = bake(vec![fat; 1000], DVec3::splat(2.0), 0.05);
    assert!(field.obstacle_distance_m(DVec3::new(1.26, 1.0, 1.0)) > 0.0);
    assert!(field.obstacle_distance_m(DVec3::new(1.14, 1.0, 1.0)) < 0.0);
}

#[test]
fn trunks_are_solid_down_to_the_floor_and_litter_is_ignored() {
    let mut random = Random(5);
    let middle = DVec3::new(1.0, 1.0, 0.0);
    let mut splats = over_trunk(middle, 0.3, 1.9, &mut random);
    for n in 0..200 {
        let (x, y) = (random.within(0.1, 0.6), random.within(0.1, 1.9));
        splats.push(disc(DVec3::new(x, y, 0.002 * f64::from(n % 100)), DVec3::Z, &mut random));
    }
    // Closed on top, so that its inside is a void.
    for _ in 0..600 {
        let (r, angle) = (0.3 * random.next().sqrt(), random.within(0.0, TAU));
        let at = middle + DVec3::new(r * angle.cos(), r * angle.sin(), 1.9);
        splats.push(disc(at, DVec3::Z, &mut random));
    }
    let field = bake(splats, DVec3::new(2.0, 2.0, 2.3), 0.05);
    assert!(field.obstacle_distance_m(middle + DVec3::Z) < -0.2, "solid inside");
    assert!(field.obstacle_distance_m(middle + DVec3::Z * 0.05) < -0.2, "solid foot");
    assert!(field.obstacle_distance_m(DVec3::new(0.3, 1.0, 0.1)) > 0.2, "litter is floor");
}

#[test]
fn removes_large_haze_and_keeps_thin_dense_objects() {
    let grid = Grid::covering(DVec3::ZERO, DVec3::splat(3.0), 0.05);
    let spec = BakeSpec { grid, min_opacity: 0.3, floor_z_m: 0.0, min_splats_per_m3: 30.0 };
    let counts = |splats: &[Ellipsoid], spec: &BakeSpec| {
        OccupancyGrid::bake(splats.iter().copied(), spec).counts()
    };
    let blob = |z: f32| Ellipsoid {
        center_m: Vec3::new(1.5, 1.5, z),
        scales_m: Vec3::splat(0.4),
        rotation: Quat::IDENTITY,
        opacity: 0.8,
    };
    let haze = counts(&[blob(1.6), blob(1.7)], &spec);
    assert!(haze.occupied == 0 && haze.floating > 1000, "{haze:?}");
    let kept = counts(&[blob(1.6)], &BakeSpec { min_splats_per_m3: 0.0, ..spec });
    assert!(kept.occupied > 1000, "{kept:?}");
    // On the floor it may be a stone; at the boundary of the grid, a part of something.
    assert!(counts(&[blob(0.2)], &spec).occupied > 1000);
    let aside = Ellipsoid { center_m: Vec3::new(0.1, 1.5, 1.6), ..blob(0.0) };
    assert!(counts(&[aside], &spec).occupied > 1000);
    // A hanging board.
    let mut random = Random(3);
    let half_m = DVec3::new(0.02, 0.4, 0.4);
    let board = over_box(DVec3::splat(1.5), half_m, DQuat::IDENTITY, &mut random);
    let board = counts(&board, &spec);
    assert!(board.floating == 0 && board.occupied > 200, "{board:?}");
}

#[test]
fn removes_specks_in_the_air_and_keeps_twigs_on_trunks() {
    let grid = Grid::covering(DVec3::ZERO, DVec3::splat(2.0), 0.05);
    let spec = BakeSpec { grid, min_opacity: 0.3, floor_z_m: 0.0, min_splats_per_m3: 30.0 };
    let occupied =
        |splats: &[Ellipsoid]| OccupancyGrid::bake(splats.iter().copied(), &spec).counts().occupied;
    let mut random = Random(9);
    // 8 cm from the bark, with a radius of 8 cm.
    let speck = Ellipsoid {
        scales_m: Vec3::new(0.04, 0.04, 0.005),
        ..disc(DVec3::new(0.52, 0.45, 1.02), DVec3::X, &mut random)
    };
    assert_eq!(occupied(&[speck]), 0);
    let mut tree = over_trunk(DVec3::new(0.5, 0.65, 0.0), 0.12, 1.9, &mut random);
    let bare = occupied(&tree);
    tree.push(speck);
    assert!(occupied(&tree) > bare);
}
