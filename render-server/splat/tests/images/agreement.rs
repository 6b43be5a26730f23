//! Comparison of fast renderers with the reference, on random scenes and cameras.

use glam::{DQuat, DVec3, Quat, Vec3};
use proptest::prelude::*;
use vizflyt_protocol::geometry::{Distortion, Intrinsics, Pose};
use vizflyt_splat::{Atmosphere, Camera, CpuRenderer, DepthKind, Rasterizer, RgbdImage, Splats};

use crate::{compare, cuts};

pub(crate) fn splats(count: std::ops::Range<usize>) -> impl Strategy<Value = Splats> {
    let splat = (
        prop::array::uniform3(-4.0..4.0f32),
        // Logarithms of the scales: 1 mm to 1.6 m.
        prop::array::uniform3(-7.0..0.5f32),
        prop::array::uniform4(-1.0..1.0f32),
        0.0..=1.0f32,
        prop::collection::vec(-0.8..0.8f32, 48),
    );
    let rows = prop::collection::vec(splat, count);
    (0..=3u8, any::<bool>(), rows).prop_map(|(sh_degree, antialiased, rows)| {
        let mut splats = Splats { sh_degree, antialiased, ..Splats::default() };
        let numbers = splats.sh_coefficients() * 3;
        for (mean, log_scale, q, opacity, sh) in rows {
            splats.means_m.push(mean.into());
            splats.scales_m.push(Vec3::from(log_scale).exp());
            let q = Quat::from_array(q);
            let unit = if q.length() > 1e-2 { q.normalize() } else { Quat::IDENTITY };
            splats.rotations.push(unit);
            splats.opacities.push(opacity);
            splats.sh.extend(&sh[..numbers]);
        }
        splats
    })
}

/// Returns no lens, or one up to its reach, including extreme ones.
pub(crate) fn distortion() -> impl Strategy<Value = Distortion> {
    let radial = || -0.3..0.3f64;
    let small = || -0.01..0.01f64;
    prop_oneof![
        2 => Just(Distortion::None),
        1 => (radial(), radial(), small(), small(), radial())
            .prop_map(|(k1, k2, p1, p2, k3)| Distortion::BrownConrady { k1, k2, p1, p2, k3 }),
        1 => (radial(), small(), small(), small())
            .prop_map(|(k1, k2, k3, k4)| Distortion::KannalaBrandt { k1, k2, k3, k4 }),
    ]
}

/// Returns clear air, or light and fog from haze to dense fog.
pub(crate) fn atmosphere() -> impl Strategy<Value = Atmosphere> {
    let colour = || prop::array::uniform3(0.0..1.0f32);
    let some = (colour(), prop_oneof![Just(0.0), 0.001..20.0f32], colour())
        .prop_map(|(light, fog_per_m, fog)| Atmosphere { light, fog_per_m, fog });
    prop_oneof![Just(Atmosphere::CLEAR), some]
}

pub(crate) fn camera() -> impl Strategy<Value = Camera> {
    (
        1..70u32,
        1..70u32,
        (1.0..170.0f64, 0.7..1.4f64),
        prop::array::uniform2(-0.5..1.5f64),
        prop::array::uniform3(-6.0..6.0f64),
        prop::array::uniform4(-1.0..1.0f64),
        prop::array::uniform3(0.0..1.0f32),
        distortion(),
        atmosphere(),
    )
        .prop_map(
            |(
                width_px,
                height_px,
                (fov_deg, ratio),
                centre,
                position,
                q,
                background,
                lens,
                atmosphere,
            )| {
                let k = Intrinsics::from_horizontal_fov(width_px, height_px, fov_deg.to_radians());
                let q = DQuat::from_array(q);
                let rotation = if q.length() > 1e-2 { q.normalize() } else { DQuat::IDENTITY };
                Camera {
                    intrinsics: Intrinsics {
                        fy_px: k.fy_px * ratio,
                        cx_px: f64::from(width_px) * centre[0],
                        cy_px: f64::from(height_px) * centre[1],
                        distortion: lens,
                        ..k
                    },
                    world_from_cam: Pose::new(DVec3::from(position), rotation),
                    near_m: 0.01,
                    background,
                    atmosphere,
                }
            },
        )
}

/// Renders with every instruction set and compares with the reference.
pub(crate) fn check(splats: &Splats, cameras: &[Camera]) {
    let expected: Vec<Vec<RgbdImage>> =
        cameras.iter().map(|camera| cuts::references(splats, &[], camera)).collect();
    for mut renderer in CpuRenderer::every(splats) {
        let mut images = vec![RgbdImage::default(); cameras.len()];
        let times = renderer.render(&[], cameras, &mut images).expect("valid cameras");
        assert!(times.total_ms >= times.blend_ms);
        for (image, expected) in images.iter().zip(&expected) {
            compare::assert_clean(image);
            assert_agrees(&renderer.name(), image, expected);
        }
    }
}

/// Checks that an image agrees with one of [`cuts::references`].
pub(crate) fn assert_agrees(name: &str, actual: &RgbdImage, expected: &[RgbdImage]) {
    let faults: Vec<String> =
        expected.iter().map_while(|expected| disagreement(actual, expected)).collect();
    assert!(faults.len() < expected.len(), "{name}: {}", faults.join("; or "));
}

/// Returns how two images disagree, if they do. Two limits: the share of wrong pixels, which flip at thresholds of
/// f32, and the error of the others.
fn disagreement(actual: &RgbdImage, expected: &RgbdImage) -> Option<String> {
    let pixels = expected.alpha.len();
    // Colours may be large where harmonics add up; errors are relative to the larger of 1 and the colour.
    let off = |i: usize| {
        let near = |a: f32, b: f32, limit: f32| (a - b).abs() <= limit * b.abs().max(1.0);
        let rgb = (0..3).all(|k| near(actual.rgb[i * 3 + k], expected.rgb[i * 3 + k], 4e-3));
        let (a, b) = (actual.depth_expected_m[i], expected.depth_expected_m[i]);
        // Where the alpha is close to 0, one splat more or less determines the depth.
        let depth = expected.alpha[i] < 0.05 || near(a, b, 1e-2);
        !(rgb && near(actual.alpha[i], expected.alpha[i], 2e-3) && depth)
    };
    let outliers = (0..pixels).filter(|&i| off(i)).count();
    // One pixel of a tiny image may flip.
    if outliers > 1 + pixels / 200 {
        return Some(format!("{outliers} of {pixels} pixels are off"));
    }
    // Pixels with transmittance close to one half may differ, among those that reach it.
    let solid = expected.alpha.iter().filter(|&&alpha| alpha > 0.5).count();
    let (a, b) = (&actual.depth_median_m, &expected.depth_median_m);
    let share = compare::depth_off(a, b, &expected.alpha, 1e-3);
    let median_off = (share * solid as f64).round() as usize;
    if median_off > 1 + solid / 100 {
        return Some(format!("{median_off} of {solid} median depths are off"));
    }
    // Pixels where two objects are about equally far, or transmittance is close to one half.
    let ids_off = actual.ids.iter().zip(&expected.ids).filter(|(a, b)| a != b).count();
    (ids_off > 1 + pixels / 100).then(|| format!("{ids_off} of {pixels} ids are off"))
}

/// Returns a configuration with `usual` cases, or with the number in `PROPTEST_CASES`.
pub(crate) fn cases(usual: u32) -> ProptestConfig {
    let asked = std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok());
    ProptestConfig::with_cases(asked.unwrap_or(usual))
}

proptest! {
    #![proptest_config(cases(96))]

    #[test]
    fn fast_equals_reference(
        splats in splats(1..700), cameras in prop::collection::vec(camera(), 1..4),
    ) {
        check(&splats, &cameras);
    }
}

/// Returns a large splat next to a small image, with its mean 5e-7 beyond the reach of the lens, less than f32
/// resolves. Found by [`fast_equals_reference`].
fn by_the_reach() -> (Splats, Camera) {
    let splats = Splats {
        means_m: vec![Vec3::new(0.9338181, 3.8448615, 1.2943631)],
        scales_m: vec![Vec3::ONE],
        rotations: vec![Quat::from_xyzw(0.0, 0.0, 0.0, 1.0)],
        opacities: vec![0.30605033],
        sh_degree: 0,
        sh: vec![0.0; 3],
        antialiased: false,
    };
    let lens = Distortion::BrownConrady {
        k1: -0.2768923729305929,
        k2: -0.05322143311001923,
        p1: -0.005714570218494323,
        p2: -0.0086611520135239,
        k3: -0.09645652001481568,
    };
    let intrinsics = Intrinsics {
        width_px: 1,
        height_px: 2,
        fx_px: 57.29432506465481,
        fy_px: 40.106027545258364,
        cx_px: 0.0,
        cy_px: 0.0,
        distortion: lens,
    };
    let position = DVec3::new(4.585101963181261, 5.303650787527003, -3.0269367755290775);
    let rotation = DQuat::from_xyzw(
        0.17379250345579175,
        -0.5419183635659254,
        -0.442462972166965,
        0.6930708269966164,
    );
    (splats, Camera::new(intrinsics, Pose::new(position, rotation), 0.01))
}

#[test]
fn renders_or_omits_a_splat_on_the_reach() {
    let (splats, camera) = by_the_reach();
    assert_eq!(cuts::references(&splats, &[], &camera).len(), 2, "the splat is not on the cut");
    check(&splats, &[camera]);
}

/// At a distance from a cut greater than the rounding of f32, the result is unique.
#[test]
fn splat_next_to_a_cut_matches_the_reference() {
    let (found, camera) = by_the_reach();
    let forward = camera.world_from_cam.rotation * DVec3::Z;
    let mean = found.means_m[0].as_dvec3();
    let z_m = forward.dot(mean - camera.world_from_cam.translation_m);
    // Distances from the reach and from the near plane, as shares of z; slopes shrink with them.
    for (reach, near, shown) in
        [(-5e-6, 0.5, false), (5e-6, 0.5, true), (5e-6, 5e-6, true), (5e-6, -5e-6, false)]
    {
        let mut splats = found.clone();
        splats.means_m[0] = (mean + forward * (z_m * reach)).as_vec3();
        let camera = Camera { near_m: (z_m * (1.0 + reach - near)) as f32, ..camera };
        let expected = cuts::references(&splats, &[], &camera);
        assert_eq!(expected.len(), 1, "{reach} {near}: on a cut");
        assert_eq!(expected[0].alpha.iter().all(|&alpha| alpha > 8e-3), shown, "{reach} {near}");
        check(&splats, &[camera]);
    }
}

/// Among few pixels that reach half, one may flip within the rounding of f32, but no more.
#[test]
fn comparison_allows_one_flipped_median_depth() {
    let mut expected = RgbdImage::default();
    expected.resize(10, 52);
    expected.alpha[..63].fill(0.9);
    expected.depth_median_m[..63].fill(1.0);
    let mut actual = expected.clone();
    actual.depth_median_m[7] = 1.5;
    assert_eq!(disagreement(&actual, &expected), None);
    actual.depth_median_m[8] = 1.5;
    assert_eq!(disagreement(&actual, &expected).unwrap(), "2 of 63 median depths are off");
}

/// Returns a wall of identical small splats, and a camera that looks straight at it.
fn wall() -> (Splats, Camera) {
    let mut splats = Splats::default();
    for y in -40..=40 {
        for x in -60..=60 {
            // A slight slope, so that no two depths are equal and the order is unique.
            let z = 2.0 + x as f32 * 1e-3 + y as f32 * 3e-5;
            splats.means_m.push(Vec3::new(x as f32 * 0.02, y as f32 * 0.02, z));
            splats.scales_m.push(Vec3::new(0.012, 0.012, 0.001));
            splats.rotations.push(Quat::IDENTITY);
            splats.opacities.push(0.9);
            splats.sh.extend([x as f32 * 0.02, y as f32 * 0.02, 0.3]);
        }
    }
    let camera = Camera::new(Intrinsics::from_horizontal_fov(160, 120, 1.0), Pose::IDENTITY, 0.01);
    (splats, camera)
}

#[test]
fn images_do_not_depend_on_earlier_images() {
    let (splats, camera) = wall();
    for mut renderer in CpuRenderer::every(&splats) {
        let small = Camera {
            intrinsics: Intrinsics::from_horizontal_fov(33, 7, 2.0),
            world_from_cam: Pose::new(DVec3::new(0.3, 0.1, 1.0), DQuat::from_rotation_y(0.4)),
            ..camera
        };
        let away = Camera {
            world_from_cam: Pose::new(DVec3::ZERO, DQuat::from_rotation_y(3.0)),
            ..camera
        };
        let mut first = [RgbdImage::default()];
        renderer.render(&[], &[camera], &mut first).unwrap();
        let mut several = vec![RgbdImage::default(); 4];
        renderer.render(&[], &[away, small, camera, small], &mut several).unwrap();
        assert_eq!(several[2], first[0], "{}", renderer.name());
        assert_eq!(several[1], several[3], "{}", renderer.name());
        // The camera that looks away sees only the background.
        assert!(several[0].rgb.iter().chain(&several[0].alpha).all(|&v| v == 0.0));
        // An image that was larger before contains only the new image.
        let mut reused = [first[0].clone()];
        renderer.render(&[], &[small], &mut reused).unwrap();
        assert_eq!(reused[0], several[1], "{}", renderer.name());
    }
}

#[test]
fn depth_of_a_wall_is_correct() {
    let (splats, camera) = wall();
    check(&splats, &[camera]);
    let mut image = [RgbdImage::default()];
    CpuRenderer::new(&splats).render(&[], &[camera], &mut image).unwrap();
    let mut mm = Vec::new();
    for kind in [DepthKind::Median, DepthKind::Expected] {
        image[0].write_depth_mm(kind, &mut mm);
        let centre = mm[60 * 160 + 80];
        assert!((1990..=2010).contains(&centre), "{kind:?}: {centre} mm");
    }
}

/// A splat within the lens's reach whose slope, clamped to the image, is beyond it. Found by
/// [`fast_equals_reference`]: the reference shortened the slope only for the lens, not for the pinhole.
#[test]
fn shortens_a_slope_clamped_beyond_the_reach() {
    let splats = Splats {
        means_m: vec![Vec3::new(-2.180_503_4, -2.445_525_4, 3.006_775_6)],
        scales_m: vec![Vec3::ONE],
        rotations: vec![Quat::IDENTITY],
        opacities: vec![0.859_059],
        sh: vec![-0.07, -0.04, 0.5],
        ..Splats::default()
    };
    let intrinsics = Intrinsics {
        width_px: 55,
        height_px: 18,
        fx_px: 19.157_670,
        fy_px: 14.380_070,
        cx_px: -21.799_552,
        cy_px: 5.003_484,
        distortion: Distortion::BrownConrady {
            k1: -0.001_332_827_4,
            k2: 0.165_174_56,
            p1: 0.008_645_694,
            p2: -0.007_483_336,
            k3: -0.105_031_63,
        },
    };
    let position = DVec3::new(-1.999_427_5, -0.948_017_58, 3.667_386_2);
    let q = DQuat::from_xyzw(-0.163_841_51, 0.623_167_31, -0.734_391_65, 0.213_277_69).normalize();
    check(&splats, &[Camera::new(intrinsics, Pose::new(position, q), 0.01)]);
}
