//! Tests of edits on generated rooms and on arbitrary splats.

use glam::{DQuat, DVec3, Quat, Vec3};
use proptest::prelude::*;

use super::*;

/// Returns deterministic, evenly distributed numbers in 0..1, without a random generator.
fn even(k: usize) -> Vec3 {
    let fraction = |root: f64| (k as f64 * root).fract() as f32;
    Vec3::new(fraction(0.819_172_513), fraction(0.671_043_607), fraction(0.549_700_478))
}

fn splats(means_m: Vec<Vec3>) -> Splats {
    let count = means_m.len();
    Splats {
        means_m,
        scales_m: vec![Vec3::splat(0.04); count],
        rotations: vec![Quat::IDENTITY; count],
        opacities: vec![0.9; count],
        sh_degree: 1,
        sh: (0..count * 12).map(|k| k as f32 * 1e-4).collect(),
        antialiased: false,
    }
}

/// Returns points on the six faces of a room of 8 x 6 x 3 with a corner at the origin.
fn room() -> Vec<Vec3> {
    let size = Vec3::new(8.0, 6.0, 3.0);
    (0..40_000)
        .map(|k| {
            let mut p = even(k) * size;
            let face = k % 6;
            p[face / 2] = if face % 2 == 0 { 0.0 } else { size[face / 2] };
            p
        })
        .collect()
}

/// Returns the centres of `count` splats on a sphere.
fn ball(count: usize, center: Vec3, radius: f32) -> impl Iterator<Item = Vec3> {
    (0..count).map(move |k| center + (even(k) - 0.5).normalize_or(Vec3::Z) * radius)
}

fn with(more: impl IntoIterator<Item = Vec3>) -> Splats {
    splats(room().into_iter().chain(more).collect())
}

/// Applies a step, and checks that it keeps exactly the splats of the room.
fn check_room_stays(step: &EditStep, mut scene: Splats) {
    let rest = scene.len() - room().len();
    assert_eq!(step.apply(&mut scene), Ok(rest), "{step:?}");
    assert!(scene.means_m == room());
    assert_eq!(step.apply(&mut scene), Ok(0), "again: {step:?}");
}

#[test]
fn removes_floaters_and_unconnected_parts() {
    let inside = Vec3::new(4.0, 3.0, 1.5);
    let floater = ball(20, inside, 0.1);
    check_room_stays(&EditStep::Floaters { cell: 0.2, least: 50 }, with(floater));
    let outside = Vec3::new(12.0, 3.0, 1.5);
    let mut houses = with(ball(4000, outside, 1.0));
    assert_eq!(EditStep::Floaters { cell: 0.2, least: 50 }.apply(&mut houses), Ok(0));
    check_room_stays(&EditStep::Parts { cell: 0.2, keep: 1 }, houses.clone());
    assert_eq!(EditStep::Parts { cell: 0.2, keep: 2 }.apply(&mut houses), Ok(0));
}

#[test]
fn haze_does_not_connect_parts() {
    let wall_to_ball = (0..200).map(|k| Vec3::new(8.0 + k as f32 * 0.015, 3.0, 1.5));
    let far = Vec3::new(12.0, 3.0, 1.5);
    let mut scene = with(wall_to_ball.chain(ball(1000, far, 1.0)));
    let step = EditStep::Parts { cell: 0.2, keep: 1 };
    assert_eq!(step.apply(&mut scene.clone()), Ok(0), "a solid bridge");
    scene.opacities[40_000..40_200].fill(0.05);
    let taken = step.apply(&mut scene).unwrap();
    assert!((1100..1200).contains(&taken), "haze in the open was not removed: {taken}");
}

#[test]
fn connects_parts_by_a_large_splat() {
    let (left, right) = (Vec3::new(-2.0, 0.0, 0.0), Vec3::new(2.0, 0.0, 0.0));
    let mut scene =
        splats(ball(100, left, 0.2).chain(ball(90, right, 0.2)).chain([Vec3::ZERO]).collect());
    let step = EditStep::Parts { cell: 0.3, keep: 1 };
    assert_eq!(step.apply(&mut scene.clone()), Ok(91));
    // A plank along y, rotated to lie along x.
    scene.scales_m[190] = Vec3::new(0.1, 2.0, 0.1);
    scene.rotations[190] = Quat::from_rotation_z(std::f32::consts::FRAC_PI_2);
    assert_eq!(step.apply(&mut scene.clone()), Ok(0));
    scene.rotations[190] = Quat::IDENTITY;
    assert_eq!(step.apply(&mut scene), Ok(91));
}

fn carve(path: &[[f64; 3]]) -> Carve {
    Carve { path: path.to_vec(), radius: 0.25, depth: 0.3, cell: 0.1, reach: 10.0 }
}

#[test]
fn carves_a_room_from_its_inside() {
    let step = EditStep::Carve(carve(&[[1.0, 1.0, 1.0]]));
    let behind_the_wall = ball(3000, Vec3::new(12.0, 3.0, 1.5), 1.0);
    check_room_stays(&step, with(behind_the_wall));
    // Haze in the middle is removed, solid splats stay. The flood fills the room from a wall to the
    // ceiling.
    let mut hazy = with(ball(500, Vec3::new(4.0, 3.0, 1.5), 0.5));
    hazy.opacities[40_000..].fill(0.1);
    check_room_stays(&step, hazy);
    assert_eq!(step.apply(&mut with(ball(500, Vec3::new(4.0, 3.0, 1.5), 0.2))), Ok(0));
    // Splats on the path do not block it, because the operator walked there.
    let walked = EditStep::Carve(carve(&[[1.0, 1.0, 1.5], [7.0, 5.0, 1.5]]));
    check_room_stays(&walked, with(ball(100, Vec3::new(4.0, 3.0, 1.5), 0.1)));
}

#[test]
fn keeps_splats_beyond_the_grid_of_an_open_scene() {
    let mut means: Vec<Vec3> = room().into_iter().filter(|p| p.z < 3.0).collect();
    let without_ceiling = means.len();
    means.extend(ball(100, Vec3::new(0.0, 0.0, 500.0), 30.0));
    let mut scene = splats(means);
    assert_eq!(EditStep::Carve(carve(&[[4.0, 3.0, 1.0]])).apply(&mut scene), Ok(0));
    assert_eq!(scene.len(), without_ceiling + 100);
}

#[test]
fn reports_why_a_scene_cannot_be_carved() {
    let mut scene = with(ball(2000, Vec3::new(4.0, 3.0, 1.5), 0.3));
    let whole = scene.clone();
    let within = Carve { radius: 0.1, ..carve(&[[4.0, 3.0, 1.5]]) };
    let said = |carve: Carve, scene: &mut Splats| {
        EditStep::Carve(carve).apply(scene).unwrap_err().to_string()
    };
    assert!(said(within, &mut scene).contains("more room"));
    let elsewhere = carve(&[[100.0, 3.0, 1.5]]);
    assert!(said(elsewhere, &mut scene).contains("nothing solid is within 10"));
    let fine = Carve { cell: 1e-3, ..carve(&[[4.0, 3.0, 1.0]]) };
    assert!(said(fine, &mut scene).contains("larger cells"));
    let nowhere = Carve { path: Vec::new(), ..carve(&[]) };
    assert!(said(nowhere, &mut scene).contains("1 to 10000 points"));
    assert!(scene == whole);
}

#[test]
fn selects_splats_within_a_lasso() {
    let mut scene = with([]);
    // From the middle of the room along +x: image right is -y, image down is -z.
    let rotation = DQuat::from_mat3(&glam::DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X));
    let lasso = |visible| Region::View {
        eye: [4.0, 3.0, 1.5],
        rotation: rotation.to_array(),
        outline: vec![[0.0, -0.2], [0.3, -0.2], [0.3, 0.2], [0.0, 0.2]],
        visible,
    };
    scene.means_m.extend([Vec3::new(12.0, 2.0, 1.5), Vec3::new(-3.0, 4.0, 1.5)]);
    let scene = splats(scene.means_m);
    let all = select(&[lasso(false)], &scene);
    let seen = select(&[lasso(true)], &scene);
    for (index, p) in scene.means_m.iter().enumerate() {
        let [x, y, z] = (p.as_dvec3() - DVec3::new(4.0, 3.0, 1.5)).to_array();
        let is_shown = x > 0.0 && -y / x >= 0.0 && -y / x < 0.3 && (z / x).abs() < 0.2;
        assert!(all[index] == is_shown || (-y / x).abs() < 1e-6, "{p}");
        assert!(all[index] || !seen[index]);
    }
    let count = |marks: &[bool]| marks.iter().filter(|mark| **mark).count();
    assert!(all[room().len()] && !seen[room().len()], "behind the wall");
    assert!(!all[room().len() + 1], "behind the camera");
    assert!(
        count(&seen) > 100 && count(&seen) == count(&all) - 1,
        "{} of {}",
        count(&seen),
        count(&all)
    );
}

#[test]
fn decimation_keeps_large_and_opaque_splats_in_order() {
    let mut scene = splats((0..100).map(even).collect());
    for k in 0..100 {
        scene.scales_m[k] = Vec3::splat(0.01 * (k % 10 + 1) as f32);
        scene.opacities[k] = if k < 50 { 0.9 } else { 0.1 };
    }
    let whole = scene.clone();
    assert_eq!(EditStep::Decimate { count: 10 }.apply(&mut scene), Ok(90));
    // The largest are numbers 9, 19, ...; then 8, 18, ... of the opaque ones.
    let kept = [8, 9, 18, 19, 28, 29, 38, 39, 48, 49].map(|k: usize| whole.means_m[k]);
    assert_eq!(scene.means_m, kept);
    assert_eq!(EditStep::Decimate { count: 1000 }.apply(&mut scene), Ok(0));
}

#[test]
fn rejects_a_step_that_removes_everything() {
    let mut scene = with([]);
    let whole = scene.clone();
    for step in [
        EditStep::Faint { below: 1.0 },
        EditStep::Large { above: 1e-3 },
        EditStep::Small { below: 9.0 },
    ] {
        let error = step.apply(&mut scene).unwrap_err();
        assert_eq!(error, EditError::NothingLeft(whole.len()));
        assert!(scene == whole);
    }
}

#[test]
fn rejects_parameters_out_of_range() {
    let check = |step: EditStep, key: &str| {
        let error = step.check().unwrap_err();
        assert_eq!(error.key, key, "{error}");
        assert!(step.apply(&mut with([])).is_err());
    };
    let prism = |outline: Vec<[f64; 2]>, high| EditStep::Crop {
        within: vec![Region::Prism { axis: Axis::Z, outline, low: 0.0, high }],
    };
    check(EditStep::Faint { below: f64::NAN }, "below");
    check(EditStep::Large { above: f64::INFINITY }, "above");
    check(EditStep::Decimate { count: 0 }, "count");
    check(EditStep::Turn { rotation: [0.0; 4] }, "rotation");
    check(EditStep::Scale { factor: 0.0 }, "factor");
    check(EditStep::Move { by: [1e9, 0.0, 0.0] }, "by");
    check(EditStep::Crop { within: vec![] }, "within");
    check(
        EditStep::Crop { within: vec![Region::Box { min: [0.0; 3], max: [1.0, 0.0, 1.0] }] },
        "max",
    );
    check(
        EditStep::Crop { within: vec![Region::Sphere { center: [0.0; 3], radius: -1.0 }] },
        "radius",
    );
    check(prism(vec![[0.0; 2]; 2], 1.0), "outline");
    check(prism(vec![[0.0; 2]; 3000], 1.0), "outline");
    check(prism(vec![[0.0; 2], [1.0, 0.0], [0.0, f64::NAN]], 1.0), "outline");
    check(prism(vec![[0.0; 2], [1.0, 0.0], [0.0, 1.0]], 0.0), "high");
}

#[test]
fn transforms_are_reversible() {
    let whole = with([]);
    let mut scene = whole.clone();
    let turn = DQuat::from_euler(glam::EulerRot::XYZ, 0.4, -1.2, 2.0);
    let steps = [
        EditStep::Turn { rotation: turn.to_array() },
        EditStep::Scale { factor: 2.5 },
        EditStep::Move { by: [1.0, -2.0, 3.0] },
        EditStep::Move { by: [-1.0, 2.0, -3.0] },
        EditStep::Scale { factor: 0.4 },
        EditStep::Turn { rotation: turn.inverse().to_array() },
    ];
    for (done, step) in steps.iter().enumerate() {
        assert_eq!(step.apply(&mut scene), Ok(0));
        assert!(scene != whole || done == 5);
    }
    for k in 0..whole.len() {
        assert!(scene.means_m[k].abs_diff_eq(whole.means_m[k], 1e-5));
        assert!(scene.scales_m[k].abs_diff_eq(whole.scales_m[k], 1e-6));
        assert!(scene.rotations[k].abs_diff_eq(whole.rotations[k], 1e-5));
    }
    assert!(scene.sh.iter().zip(&whole.sh).all(|(a, b)| (a - b).abs() < 1e-4 * (1.0 + b.abs())));
}

/// Generates numbers that a file may contain, including NaN.
fn number() -> impl Strategy<Value = f32> {
    prop_oneof![8 => -10.0f32..10.0, 1 => prop::num::f32::NORMAL, 1 => Just(f32::NAN)]
}

fn anything() -> impl Strategy<Value = Splats> {
    let one = (
        prop::array::uniform3(number()),
        prop::array::uniform3(number()),
        prop::array::uniform4(-1.0f32..1.0),
        prop_oneof![0.0f32..1.0, Just(f32::NAN)],
    );
    prop::collection::vec(one, 1..60).prop_map(|all| {
        let count = all.len();
        let mut made = splats(all.iter().map(|(mean, ..)| Vec3::from(*mean)).collect());
        for (k, (_, scales, rotation, opacity)) in all.into_iter().enumerate() {
            made.scales_m[k] = Vec3::from(scales).abs();
            made.rotations[k] = Quat::from_array(rotation).normalize();
            made.opacities[k] = opacity;
        }
        assert_eq!(made.len(), count);
        made
    })
}

fn length() -> impl Strategy<Value = f64> {
    prop_oneof![0.05..5.0f64, Just(1e-9), Just(1e7)]
}

fn point() -> impl Strategy<Value = [f64; 3]> {
    prop::array::uniform3(-10.0..10.0f64)
}

fn outline() -> impl Strategy<Value = Vec<[f64; 2]>> {
    prop::collection::vec(prop::array::uniform2(-5.0..5.0f64), 3..9)
}

fn region() -> impl Strategy<Value = Region> {
    let axis = prop_oneof![Just(Axis::X), Just(Axis::Y), Just(Axis::Z)];
    let turn = (point(), -3.0..3.0f64).prop_map(|(axis, angle)| {
        DQuat::from_axis_angle(DVec3::from(axis).normalize_or(DVec3::X), angle).to_array()
    });
    prop_oneof![
        (point(), prop::array::uniform3(0.1..9.0f64)).prop_map(|(min, size)| Region::Box {
            min,
            max: (DVec3::from(min) + DVec3::from(size)).to_array(),
        }),
        (point(), length()).prop_map(|(center, radius)| Region::Sphere { center, radius }),
        (axis, outline(), -5.0..0.0f64, 0.1..5.0f64)
            .prop_map(|(axis, outline, low, high)| Region::Prism { axis, outline, low, high }),
        (point(), turn, outline(), any::<bool>()).prop_map(|(eye, rotation, outline, visible)| {
            Region::View { eye, rotation, outline, visible }
        }),
    ]
}

/// Generates steps that remove splats and do not change the others.
fn removal() -> impl Strategy<Value = EditStep> {
    let within = || prop::collection::vec(region(), 1..3);
    prop_oneof![
        within().prop_map(|within| EditStep::Crop { within }),
        within().prop_map(|within| EditStep::Remove { within }),
        (0.0..1.0f64).prop_map(|below| EditStep::Faint { below }),
        length().prop_map(|above| EditStep::Large { above }),
        length().prop_map(|below| EditStep::Small { below }),
        (length(), 1..9u32).prop_map(|(cell, least)| EditStep::Floaters { cell, least }),
        (length(), 1..4u32).prop_map(|(cell, keep)| EditStep::Parts { cell, keep }),
        (1..70u32).prop_map(|count| EditStep::Decimate { count }),
        (prop::collection::vec(point(), 1..4), length(), 0.3..2.0f64).prop_map(
            |(path, depth, cell)| EditStep::Carve(Carve {
                path,
                radius: 0.3,
                depth,
                cell,
                reach: 15.0
            })
        ),
    ]
}

/// Returns whether a step depends on occlusion or free space. Repeating such a step can remove more
/// splats.
fn looks(step: &EditStep) -> bool {
    let sees = |region: &Region| matches!(region, Region::View { visible: true, .. });
    match step {
        EditStep::Crop { within } | EditStep::Remove { within } => within.iter().any(sees),
        EditStep::Carve(_) => true,
        _ => false,
    }
}

fn bits(splats: &Splats) -> Vec<Vec<u32>> {
    let numbers = splats.sh_coefficients() * 3;
    (0..splats.len())
        .map(|k| {
            let vectors =
                splats.means_m[k].to_array().into_iter().chain(splats.scales_m[k].to_array());
            let rest = splats.rotations[k].to_array().into_iter().chain([splats.opacities[k]]);
            let sh = splats.sh[k * numbers..][..numbers].iter().copied();
            vectors.chain(rest).chain(sh).map(f32::to_bits).collect()
        })
        .collect()
}

proptest! {
    /// For any splats, a step keeps a subset in order and bit by bit, is deterministic, and removes
    /// nothing when repeated.
    #[test]
    fn keeps_an_unchanged_subset_in_order(whole in anything(), step in removal()) {
        prop_assert_eq!(step.check(), Ok(()));
        let mut left = whole.clone();
        let taken = step.apply(&mut left);
        match taken {
            Ok(taken) => {
                prop_assert_eq!(left.len() + taken, whole.len());
                let all = bits(&whole);
                let mut rest = all.iter();
                for one in bits(&left) {
                    prop_assert!(rest.any(|other| *other == one), "out of order");
                }
            }
            Err(_) => prop_assert!(bits(&left) == bits(&whole)),
        }
        let mut again = whole.clone();
        prop_assert_eq!(step.apply(&mut again), taken.clone());
        prop_assert!(bits(&again) == bits(&left));
        if taken.is_ok() && !looks(&step) {
            prop_assert_eq!(step.apply(&mut left), Ok(0));
        }
    }

    /// Cropping to regions and removing the same regions partition the splats.
    #[test]
    fn crop_and_removal_partition_the_splats(whole in anything(), within in prop::collection::vec(region(), 1..3)) {
        let left = |step: EditStep| step.apply(&mut whole.clone()).map_or(0, |taken| whole.len() - taken);
        let [kept, rest] = [EditStep::Crop { within: within.clone() }, EditStep::Remove { within }].map(left);
        prop_assert_eq!(kept + rest, whole.len());
    }

    /// Compares connected parts with a brute-force search.
    #[test]
    fn parts_match_a_brute_force_search(
        points in prop::collection::vec(prop::array::uniform3(-3.0..3.0f32), 1..60), keep in 1..4usize,
    ) {
        let scene = splats(points.into_iter().map(Vec3::from).collect());
        let cell = |k: usize| scene.means_m[k].as_dvec3().floor().as_ivec3();
        let mut part: Vec<usize> = (0..scene.len()).collect();
        for _ in 0..scene.len() {
            for a in 0..scene.len() {
                for b in 0..scene.len() {
                    if (cell(a) - cell(b)).abs().max_element() <= 1 {
                        part[a] = part[a].min(part[b]);
                    }
                }
            }
        }
        let size = |of: usize| part.iter().filter(|other| **other == part[of]).count();
        let mut sizes: Vec<usize> = (0..scene.len()).filter(|k| part[*k] == *k).map(size).collect();
        sizes.sort_unstable_by(|a, b| b.cmp(a));
        let expected: usize = sizes.iter().take(keep).sum();
        let kept = parts::largest(&scene, 1.0, keep);
        prop_assert_eq!(kept.iter().filter(|kept| **kept).count(), expected);
        for (k, kept) in parts::of_at_least(&scene, 1.0, keep + 1).iter().enumerate() {
            prop_assert_eq!(*kept, size(k) > keep);
        }
    }
}
