//! Fast renderers against the plain one, on random scenes and cameras.

use glam::{DQuat, DVec3, Quat, Vec3};
use proptest::prelude::*;
use vizflyt_protocol::geometry::{Distortion, Intrinsics, Pose};
use vizflyt_splat::{
    Atmosphere, Camera, CpuRenderer, DepthKind, Rasterizer, RgbdImage, Splats, render_reference,
};

use crate::compare;

pub(crate) fn splats(count: std::ops::Range<usize>) -> impl Strategy<Value = Splats> {
    let splat = (
        prop::array::uniform3(-4.0..4.0f32),
        // Log scales: 1 mm to 1.6 m.
        prop::array::uniform3(-7.0..0.5f32),
        prop::array::uniform4(-1.0..1.0f32),
        0.0..=1.0f32,
        prop::collection::vec(-0.8..0.8f32, 48),
    );
    (0..=3u8, prop::collection::vec(splat, count)).prop_map(|(sh_degree, rows)| {
        let mut splats = Splats { sh_degree, ..Splats::default() };
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

/// No lens, or one up to where it turns back, wild ones too.
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

/// Clear air, or light and fog from haze to soup.
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
    let expected: Vec<RgbdImage> = cameras
        .iter()
        .map(|camera| render_reference(splats, &[], camera).expect("a valid camera"))
        .collect();
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

/// Two limits: the share of pixels off, which thresholds of f32 flip, and the error of the others.
pub(crate) fn assert_agrees(name: &str, actual: &RgbdImage, expected: &RgbdImage) {
    let pixels = expected.alpha.len();
    // Colours may be large where harmonics add up; they are judged relative to 1 or the colour.
    let off = |i: usize| {
        let near = |a: f32, b: f32, limit: f32| (a - b).abs() <= limit * b.abs().max(1.0);
        let rgb = (0..3).all(|k| near(actual.rgb[i * 3 + k], expected.rgb[i * 3 + k], 4e-3));
        let (a, b) = (actual.depth_expected_m[i], expected.depth_expected_m[i]);
        // Where next to nothing contributes, one splat more or less is the depth.
        let depth = expected.alpha[i] < 0.05 || near(a, b, 1e-2);
        !(rgb && near(actual.alpha[i], expected.alpha[i], 2e-3) && depth)
    };
    let outliers = (0..pixels).filter(|&i| off(i)).count();
    // One pixel of a tiny image may flip.
    assert!(outliers <= 1 + pixels / 200, "{name}: {outliers} of {pixels} pixels are off");
    let median_off =
        compare::depth_off(&actual.depth_median_m, &expected.depth_median_m, &expected.alpha, 1e-3);
    assert!(median_off <= 0.01 + 1.5 / pixels as f64, "{name}: median depth {median_off}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]

    #[test]
    fn fast_equals_reference(
        splats in splats(1..700), cameras in prop::collection::vec(camera(), 1..4),
    ) {
        check(&splats, &cameras);
    }
}

/// A wall of identical small splats and one camera that looks straight at it.
fn wall() -> (Splats, Camera) {
    let mut splats = Splats::default();
    for y in -40..=40 {
        for x in -60..=60 {
            // A slight slope, so that no two depths are equal and the order is no matter of taste.
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
        // The one that looks away sees the background and nothing else.
        assert!(several[0].rgb.iter().chain(&several[0].alpha).all(|&v| v == 0.0));
        // An image that was larger before holds only the new one.
        let mut reused = [first[0].clone()];
        renderer.render(&[], &[small], &mut reused).unwrap();
        assert_eq!(reused[0], several[1], "{}", renderer.name());
    }
}

#[test]
fn a_wall_is_where_it_stands() {
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
