use proptest::prelude::*;
use vizflyt_protocol::geometry::Volume;

use super::*;
use crate::distance::DistanceField;

const VOXEL_M: f64 = 0.05;

/// A flat Gaussian on a surface, as in trained and generated scenes.
fn disc(center: DVec3, normal: DVec3, spread_m: f32) -> Ellipsoid {
    Ellipsoid {
        center_m: center.as_vec3(),
        scales_m: Vec3::new(spread_m, spread_m, 0.008),
        rotation: Quat::from_rotation_arc(Vec3::Z, normal.as_vec3().normalize()),
        opacity: 0.95,
    }
}

fn field(splats: Vec<Ellipsoid>) -> DistanceField {
    let grid = Grid::covering(DVec3::new(-2.0, -2.0, 0.0), DVec3::new(2.0, 2.0, 3.0), VOXEL_M);
    let spec = BakeSpec { grid, min_opacity: 0.3, floor_z_m: 0.0, min_splats_per_m3: 30.0 };
    DistanceField::of(OccupancyGrid::bake(splats, &spec))
}

/// Returns a trunk: a cylinder around (0, 0), 3 m high.
fn trunk(radius_m: f64) -> (DistanceField, Volume) {
    let around = (std::f64::consts::TAU * radius_m / 0.05).ceil() as usize;
    let splats = (0..60)
        .flat_map(|layer| {
            (0..around).map(move |side| {
                let angle = side as f64 / around as f64 * std::f64::consts::TAU;
                let normal = DVec3::new(angle.cos(), angle.sin(), 0.0);
                disc(normal * radius_m + DVec3::Z * (layer as f64 * 0.05 + 0.025), normal, 0.035)
            })
        })
        .collect();
    let axis = |z: f64| DVec3::new(0.0, 0.0, z);
    (field(splats), Volume::Capsule { a_m: axis(-1.0), b_m: axis(4.0), radius_m })
}

fn wall() -> (DistanceField, Volume) {
    let splats = (-24..24)
        .flat_map(|y| {
            (0..60).flat_map(move |z| {
                let at = DVec3::new(0.0, f64::from(y) * 0.08, f64::from(z) * 0.05);
                [
                    disc(at + DVec3::X * 0.1, DVec3::X, 0.05),
                    disc(at - DVec3::X * 0.1, DVec3::NEG_X, 0.05),
                ]
            })
        })
        .collect();
    let half_m = DVec3::new(0.1, 1.92, 4.0);
    let center_m = DVec3::new(0.0, -0.04, 0.0);
    (field(splats), Volume::Cuboid { center_m, half_m, rotation: glam::DQuat::IDENTITY })
}

/// Compares the result "a sphere of 0.12 m touches" with the truth: no miss beyond one voxel, at most 1 % false
/// alarms beyond a voxel and a half.
fn check(name: &str, (field, truth): &(DistanceField, Volume)) {
    let (mut free, mut false_alarms) = (0, 0);
    for x in -35..35 {
        for y in -30..30 {
            for z in [0.5, 1.23, 2.01] {
                let p = DVec3::new(f64::from(x) * 0.05 + 0.013, f64::from(y) * 0.05 + 0.007, z);
                let true_m = truth.signed_distance_m(p) - 0.12;
                let touches = field.obstacle_distance_m(p) - 0.12 <= 0.0;
                assert!(touches || true_m > -VOXEL_M, "{name}: missed at {p}, {true_m:.3} m deep");
                if true_m > 1.5 * VOXEL_M {
                    free += 1;
                    false_alarms += usize::from(touches);
                }
            }
        }
    }
    assert!(free > 1000, "{name}: too little free space in the test");
    assert!(false_alarms * 100 <= free, "{name}: {false_alarms} false alarms in {free}");
}

#[test]
fn trunks_and_walls_match_the_truth() {
    for radius_m in [0.12, 0.2, 0.3] {
        check(&format!("trunk of {radius_m} m"), &trunk(radius_m));
    }
    check("wall", &wall());
}

#[test]
fn ignores_faint_splats_and_floaters() {
    let faint: Vec<_> = (0..400)
        .map(|i| Ellipsoid {
            opacity: 0.2,
            ..disc(
                DVec3::new(0.0, f64::from(i % 20) * 0.05, 1.0 + f64::from(i / 20) * 0.05),
                DVec3::X,
                0.05,
            )
        })
        .collect();
    let counts = |splats: Vec<Ellipsoid>| {
        let grid = Grid::covering(DVec3::new(-2.0, -2.0, 0.0), DVec3::new(2.0, 2.0, 3.0), VOXEL_M);
        OccupancyGrid::bake(
            splats,
            &BakeSpec { grid, min_opacity: 0.3, floor_z_m: 0.0, min_splats_per_m3: 30.0 },
        )
        .counts()
    };
    let found = counts(faint);
    assert_eq!((found.occupied, found.splats_left_out), (0, 400));
    // One opaque speck in the air.
    let speck = Ellipsoid {
        center_m: Vec3::new(0.0, 0.0, 1.5),
        scales_m: Vec3::splat(0.05),
        rotation: Quat::IDENTITY,
        opacity: 0.99,
    };
    let found = counts(vec![speck]);
    assert!(found.floating > 0, "{found:?}");
    assert_eq!(found.occupied, 0);
    assert_eq!(counts(Vec::new()).occupied, 0);
}

proptest! {
    /// An invalid splat affects only itself.
    #[test]
    fn accepts_any_splat(
        center in prop::array::uniform3(prop_oneof![Just(f32::NAN), Just(f32::INFINITY), -5.0f32..5.0]),
        scales in prop::array::uniform3(prop_oneof![Just(f32::NAN), Just(0.0f32), Just(1e-30), Just(1e30), 0.01f32..1.0]),
        opacity in prop_oneof![Just(f32::NAN), Just(f32::INFINITY), 0.0f32..1.0],
    ) {
        let strange = Ellipsoid {
            center_m: center.into(),
            scales_m: scales.into(),
            rotation: Quat::IDENTITY,
            opacity,
        };
        let grid = Grid::covering(DVec3::splat(-0.5), DVec3::splat(0.5), 0.1);
        let spec = BakeSpec { grid, min_opacity: 0.3, floor_z_m: -0.5, min_splats_per_m3: 30.0 };
        let baked = OccupancyGrid::bake([strange], &spec);
        prop_assert!(baked.counts().occupied <= grid.voxels());
        let field = DistanceField::of(baked);
        prop_assert!(field.obstacle_distance_m(DVec3::ZERO).is_finite());
    }
}

#[test]
fn unseen_space_is_solid_if_requested() {
    use crate::config::SceneConfig;
    use crate::seen::{ScenePlace, SeenSpace};

    let grid = Grid::covering(DVec3::new(-2.0, -2.0, 0.0), DVec3::new(2.0, 2.0, 3.0), VOXEL_M);
    // West of x = 1, everything except a pocket was seen; east of it, only a bubble.
    let is_seen = |p: DVec3| {
        let (pocket, bubble) = (DVec3::new(-1.0, 0.0, 1.5), DVec3::new(1.5, 0.0, 1.5));
        if p.x < 1.0 { p.distance(pocket) > 0.3 } else { p.distance(bubble) < 0.2 }
    };
    let [_, ny, nz] = grid.size;
    let mut bits = vec![0u8; grid.voxels().div_ceil(8)];
    for n in 0..grid.voxels() {
        let center_m = grid.center_m([n / (ny * nz), n / nz % ny, n % nz]);
        bits[n / 8] |= u8::from(is_seen(center_m)) << (n % 8);
    }
    let place = ScenePlace::of(&SceneConfig::in_world("a.ply"));
    let seen = SeenSpace::new(grid, place, [0; 32], bits);
    // A post that extends into unseen space, east of x = 1.
    let post: Vec<Ellipsoid> = (0..60)
        .flat_map(|layer| {
            let at = DVec3::new(0.9, 1.0, f64::from(layer) * 0.05 + 0.025);
            [disc(at, DVec3::X, 0.05), disc(at + DVec3::X * 0.2, DVec3::X, 0.05)]
        })
        .collect();
    let spec = BakeSpec { grid, min_opacity: 0.3, floor_z_m: 0.0, min_splats_per_m3: 30.0 };
    let without = OccupancyGrid::bake(post.iter().copied(), &spec).counts();
    assert_eq!(without.unseen, 0);
    let baked = OccupancyGrid::bake_with(post, &spec, Some(seen.at(&place)), &|_| ());
    let counts = baked.counts();
    // Voxels of splats do not count as unseen; a seen bubble inside unseen space does.
    assert_eq!(counts.occupied - counts.unseen, without.occupied);
    assert!(counts.enclosed > 100, "{counts:?}");
    let field = DistanceField::of(baked);
    assert_eq!(field.unseen_voxels(), counts.unseen);
    let at = |x: f64, y: f64, z: f64| {
        let p_m = DVec3::new(x, y, z);
        (field.obstacle_distance_m(p_m) < 0.0, field.is_unseen_nearest(p_m, 0.3))
    };
    assert_eq!(at(-1.0, 0.0, 1.5), (true, true), "the pocket");
    assert_eq!(at(1.5, 0.0, 1.5), (true, true), "the bubble");
    assert_eq!(at(0.9, 1.0, 1.5), (true, false), "the post");
    assert_eq!(at(0.0, -1.0, 1.5), (false, false), "seen, and far from all");
    assert_eq!(at(0.9, 0.0, 1.5), (false, true), "seen, beside the unseen");
    // The band above the floor equals the voxels above it.
    assert_eq!((at(0.0, -1.0, 0.1).0, at(1.5, -1.0, 0.1)), (false, (true, true)));
    // Serialization keeps unseen space.
    let (header, codes, unseen) = field.as_bytes();
    let bytes = [&header[..], codes, unseen].concat();
    assert_eq!(DistanceField::from_bytes(&bytes), Ok(field.clone()));
    assert!(DistanceField::from_bytes(&bytes[..bytes.len() - 1]).is_err());
}
