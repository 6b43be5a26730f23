//! Input at and beyond the limits: clean images or precise errors, never NaN, never a panic.
//!
//! Each check takes the renderers as a parameter, so that it can be used for any of them.

use glam::{DQuat, DVec3, Quat, Vec3};
use proptest::prelude::*;
use vizflyt_protocol::geometry::{Distortion, Intrinsics, Pose};
use vizflyt_splat::{Camera, InvalidCamera, RenderError, RgbdImage, Scene, Splats, ply};

use crate::renderers::{self, Make};
use crate::{agreement, compare};

fn one(mean_m: Vec3, scale_m: Vec3, opacity: f32) -> Splats {
    Splats {
        means_m: vec![mean_m],
        scales_m: vec![scale_m],
        rotations: vec![Quat::from_rotation_x(0.3)],
        opacities: vec![opacity],
        sh_degree: 0,
        sh: vec![0.5, -0.5, 1.0],
        antialiased: false,
    }
}

fn looking_ahead(width_px: u32, height_px: u32, fov_deg: f64) -> Camera {
    Camera {
        background: [0.2, 0.4, 0.6],
        ..Camera::new(
            Intrinsics::from_horizontal_fov(width_px, height_px, fov_deg.to_radians()),
            Pose::IDENTITY,
            0.05,
        )
    }
}

/// Returns cameras with the same field of view through a pinhole, a barrel lens and a fisheye.
fn through_lenses(width_px: u32, height_px: u32, fov_deg: f64) -> [Camera; 3] {
    let camera = looking_ahead(width_px, height_px, fov_deg);
    let half_rad = 0.5 * fov_deg.to_radians();
    let barrel = Distortion::BrownConrady { k1: -0.2, k2: 0.05, p1: 1e-3, p2: -1e-3, k3: -0.002 };
    let fisheye = Distortion::KannalaBrandt { k1: 0.01, k2: -0.002, k3: 0.0, k4: 0.0 };
    // Limited to the reach of the barrel lens; for the fisheye, from the angle.
    let within = half_rad.tan().min(0.95 * barrel.reach());
    [(Distortion::None, half_rad.tan()), (barrel, within), (fisheye, half_rad.tan())].map(
        |(distortion, slope)| {
            let radius = distortion.distort(glam::DVec2::new(slope, 0.0)).0.x;
            let f_px = 0.5 * f64::from(width_px) / radius;
            let k = Intrinsics { fx_px: f_px, fy_px: f_px, distortion, ..camera.intrinsics };
            Camera { intrinsics: k, ..camera }
        },
    )
}

/// Renders with all renderers; checks that all images are clean.
fn render_all(make: Make<'_>, splats: &Splats, camera: &Camera) -> Vec<(String, RgbdImage)> {
    let mut images = Vec::new();
    for mut renderer in make(Scene::from(splats)) {
        let mut image = [RgbdImage::default()];
        renderer.render(&[], &[*camera], &mut image).expect("a valid camera");
        let [image] = image;
        assert_eq!((image.width_px, image.height_px), size(camera));
        compare::assert_clean(&image);
        images.push((renderer.name().into_owned(), image));
    }
    images
}

fn size(camera: &Camera) -> (u32, u32) {
    (camera.intrinsics.width_px, camera.intrinsics.height_px)
}

/// Scales from 0 to infinity, opacities from 0 to 1.
pub(crate) fn check_scales_and_opacities(make: Make<'_>) {
    let cameras = through_lenses(32, 24, 70.0);
    for scale in [0.0, 1e-38, 1e-30, 1e-4, 1.0, 1e4, 1e30, f32::MAX, f32::INFINITY] {
        for other in [scale, 0.01] {
            for opacity in [0.0, 1e-30, 1.0 / 255.0, 0.5, 1.0] {
                let scale_m = Vec3::new(scale, other, scale);
                let splats = one(Vec3::new(0.1, 0.0, 2.0), scale_m, opacity);
                let antialiased = Splats { antialiased: true, ..splats.clone() };
                let each = [splats, antialiased];
                for (camera, splats) in
                    cameras.iter().flat_map(|c| each.iter().map(move |s| (c, s)))
                {
                    let expected = render_all(&renderers::reference, splats, camera);
                    for (name, image) in render_all(make, splats, camera) {
                        let middle = 12 * 32 + 17;
                        let off = (image.alpha[middle] - expected[0].1.alpha[middle]).abs();
                        assert!(off < 0.02, "{name}: {scale_m}, opacity {opacity}: {off}");
                    }
                }
            }
        }
    }
}

/// Values that are not finite and invalid rotations are dropped.
pub(crate) fn check_what_is_not_finite(make: Make<'_>) {
    let good = one(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.3), 0.8);
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let spoil: [&dyn Fn(&mut Splats); 7] = [
            &|s| s.means_m[0].x = bad,
            &|s| s.means_m[0].z = bad,
            &|s| s.rotations[0] = Quat::from_xyzw(0.0, bad, 0.0, 1.0),
            &|s| s.rotations[0] = Quat::from_xyzw(0.0, 0.0, 0.0, 0.0),
            &|s| s.opacities[0] = bad,
            &|s| s.sh[1] = bad,
            &|s| s.scales_m[0].y = f32::NAN,
        ];
        for spoil in spoil {
            let mut splats = good.clone();
            spoil(&mut splats);
            for camera in through_lenses(20, 20, 60.0) {
                for (name, image) in render_all(make, &splats, &camera) {
                    assert!(image.alpha.iter().all(|&alpha| alpha == 0.0), "{name}: {splats:?}");
                }
            }
        }
    }
}

/// File contents before activation: infinite logits, logarithms, quaternions of any length.
pub(crate) fn check_files(make: Make<'_>) {
    let splats = one(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.3), 0.8);
    let file = ply::encode(&splats);
    let header = file.windows(11).position(|w| w == b"end_header\n").expect("a header") + 11;
    let text = String::from_utf8_lossy(&file[..header]).into_owned();
    let column = |name: &str| {
        let mut names = text.lines().filter_map(|line| line.strip_prefix("property float "));
        header + 4 * names.position(|n| n == name).expect("a property")
    };
    let with = |changes: &[(&str, f32)]| {
        let mut bytes = file.clone();
        for &(name, value) in changes {
            bytes[column(name)..][..4].copy_from_slice(&value.to_le_bytes());
        }
        match ply::parse(&bytes) {
            Ok(loaded) => loaded.splats,
            // The reader has already dropped it.
            Err(ply::PlyError::Empty { declared: 1, dropped: 1 }) => Splats::default(),
            Err(other) => panic!("{changes:?}: {other}"),
        }
    };
    let rotations = ["rot_0", "rot_1", "rot_2", "rot_3"];
    // Changed values, and whether the splat is visible afterwards.
    let mut cases: Vec<(Vec<(&str, f32)>, bool)> = vec![
        (vec![("opacity", f32::INFINITY)], true),
        (vec![("opacity", f32::NEG_INFINITY)], false),
        (vec![("opacity", f32::NAN)], false),
        (vec![("opacity", f32::MAX)], true),
        (vec![("scale_0", f32::NEG_INFINITY)], true),
        (vec![("scale_0", f32::INFINITY)], false),
        (vec![("scale_0", 88.0)], true),
        (vec![("scale_0", f32::NAN)], false),
        (vec![("x", f32::NAN)], false),
        (vec![("f_dc_0", f32::INFINITY)], false),
    ];
    for (value, there) in [(0.0, false), (f32::NAN, false), (f32::INFINITY, false), (1e-3, true)] {
        cases.push((rotations.map(|name| (name, value)).into(), there));
    }
    for (changes, there) in cases {
        let splats = with(&changes);
        for camera in through_lenses(24, 18, 60.0) {
            for (name, image) in render_all(make, &splats, &camera) {
                let seen = image.alpha[9 * 24 + 12] > 0.3;
                assert_eq!(seen, there, "{name}: {changes:?}");
            }
        }
    }
}

/// Behind, at and on the near plane, far away, to the side, and around the camera.
pub(crate) fn check_distances(make: Make<'_>) {
    let next = |v: f32| f32::from_bits(v.to_bits() + 1);
    for camera in through_lenses(40, 30, 80.0) {
        let near = camera.near_m;
        for z in [-1e30, -1.0, -0.0, 0.0, 1e-30, near, next(near), 0.06, 1.0, 1e6, 1e30, f32::MAX] {
            for x in [0.0, 1e-3, 5.0, 1e30] {
                let splats = one(Vec3::new(x, 0.0, z), Vec3::splat(0.2), 0.9);
                for (name, image) in render_all(make, &splats, &camera) {
                    let nothing = image.alpha.iter().all(|&a| a == 0.0);
                    assert!(nothing || z > near, "{name}: z {z}");
                }
            }
        }
        // Inside a splat: the part beyond the near plane is visible.
        let around = one(Vec3::new(0.0, 0.0, 0.06), Vec3::splat(3.0), 0.9);
        for (name, image) in render_all(make, &around, &camera) {
            assert!(image.alpha.iter().all(|&alpha| alpha > 0.85), "{name}");
        }
        // Splats are culled by their centre: at the camera or behind it, they are not rendered.
        for z in [0.0, -0.5] {
            let around = one(Vec3::new(0.0, 0.0, z), Vec3::splat(3.0), 0.9);
            for (name, image) in render_all(make, &around, &camera) {
                assert!(image.alpha.iter().all(|&alpha| alpha == 0.0), "{name}");
            }
        }
    }
}

/// Fields of view from 1 to 170 degrees, through all lenses, in small images of all shapes.
pub(crate) fn check_sizes_and_fields_of_view(make: Make<'_>) {
    let splats = one(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.5), 0.9);
    for fov_deg in [1.0, 10.0, 90.0, 150.0, 170.0] {
        for (width, height) in [(1, 1), (3, 2), (16, 16), (17, 33), (200, 1), (1, 200)] {
            for camera in through_lenses(width, height, fov_deg) {
                for (name, image) in render_all(make, &splats, &camera) {
                    let middle = (height / 2 * width + width / 2) as usize;
                    // In a single column 200 px high, the fisheye of 170 degrees is one splat wide.
                    assert!(image.alpha[middle] > 0.05, "{name}: {camera:?}");
                }
            }
        }
    }
}

/// Maximum size of 3840 x 2160, through all lenses.
pub(crate) fn check_the_largest_size(make: Make<'_>) {
    let splats = one(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.5), 0.9);
    for camera in through_lenses(3840, 2160, 90.0) {
        for (name, image) in render_all(make, &splats, &camera) {
            assert!(image.alpha[1080 * 3840 + 1920] > 0.85, "{name}");
        }
    }
}

/// Empty scenes show the background.
pub(crate) fn check_empty_scenes(make: Make<'_>) {
    let transparent = one(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.5), 0.001);
    for splats in [Splats::default(), transparent] {
        for camera in through_lenses(21, 10, 90.0) {
            for (name, image) in render_all(make, &splats, &camera) {
                assert!(image.rgb.chunks(3).all(|rgb| rgb == [0.2, 0.4, 0.6]), "{name}");
                assert!(image.depth_median_m.iter().all(|&z| z == 0.0), "{name}");
            }
        }
    }
}

/// Invalid cameras are rejected with a specific error, and no image is changed.
pub(crate) fn check_cameras_that_are_none(make: Make<'_>) {
    let good = looking_ahead(20, 10, 60.0);
    let splats = one(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.5), 0.9);
    let check = |camera: Camera, part: &str| {
        for mut renderer in make(Scene::from(&splats)) {
            let mut untouched = [RgbdImage::default()];
            let refused = renderer.render(&[], &[camera], &mut untouched);
            let message = refused.expect_err("an invalid camera").to_string();
            assert!(message.contains(part), "{}: {message:?} lacks {part:?}", renderer.name());
            assert_eq!(untouched[0], RgbdImage::default());
            // The next valid call is rendered.
            renderer.render(&[], &[good], &mut untouched).expect("a valid camera");
        }
    };
    let with = |k: Intrinsics| Camera { intrinsics: k, ..good };
    let k = good.intrinsics;
    check(with(Intrinsics { width_px: 0, ..k }), "image size 0x10");
    check(with(Intrinsics { height_px: 8193, ..k }), "image size 20x8193");
    for bad in [f64::NAN, f64::INFINITY, 0.0, -1.0] {
        check(with(Intrinsics { fx_px: bad, ..k }), "focal length");
    }
    check(with(Intrinsics { cy_px: f64::NAN, ..k }), "principal point");
    let bent = Distortion::KannalaBrandt { k1: f64::NAN, k2: 0.0, k3: 0.0, k4: 0.0 };
    check(with(Intrinsics { distortion: bent, ..k }), "distortion coefficient");
    let zero = DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0);
    for pose in [
        Pose::new(DVec3::splat(f64::NAN), DQuat::IDENTITY),
        Pose::new(DVec3::new(1e9, 0.0, 0.0), DQuat::IDENTITY),
        Pose::new(DVec3::ZERO, zero),
    ] {
        check(Camera { world_from_cam: pose, ..good }, "camera pose");
    }
    for near_m in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        check(Camera { near_m, ..good }, "near plane");
    }
    check(Camera { background: [0.0, f32::NAN, 0.0], ..good }, "background");
    for mut renderer in make(Scene::from(&splats)) {
        let refused =
            renderer.render(&[], &[Camera { near_m: 0.0, ..good }], &mut [RgbdImage::default()]);
        assert!(matches!(refused, Err(RenderError::Camera(InvalidCamera::Near(_)))));
    }
}

#[test]
fn extreme_scales_and_opacities_stay_clean_and_agree() {
    check_scales_and_opacities(&renderers::cpus);
}

#[test]
fn splats_that_are_not_finite_are_dropped() {
    // Without the reference, which does not filter its input.
    check_what_is_not_finite(&renderers::cpus);
}

#[test]
fn extreme_values_in_files_leave_images_finite() {
    check_files(&renderers::cpus);
}

#[test]
fn images_stay_clean_from_behind_the_camera_to_far_away() {
    check_distances(&renderers::every);
}

#[test]
fn renders_every_size_and_field_of_view() {
    check_sizes_and_fields_of_view(&renderers::every);
    check_the_largest_size(&renderers::cpus);
}

#[test]
fn scene_without_splats_shows_the_background() {
    check_empty_scenes(&renderers::every);
}

#[test]
fn rejects_invalid_cameras() {
    check_cameras_that_are_none(&renderers::every);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Arbitrary bits in a scene, and any camera: clean images.
    #[test]
    fn any_bits_give_clean_images(
        mut splats in agreement::splats(1..80),
        camera in agreement::camera(),
        damage in prop::collection::vec((any::<prop::sample::Index>(), 0..11usize, any::<u32>()), 0..40),
    ) {
        for (splat, field, bits) in damage {
            let (i, v) = (splat.index(splats.len()), f32::from_bits(bits));
            let numbers = splats.sh_coefficients() * 3;
            match field {
                0..3 => splats.means_m[i][field] = v,
                3..6 => splats.scales_m[i][field - 3] = v.abs(),
                6 => splats.opacities[i] = v,
                7 => splats.sh[i * numbers] = v,
                8 => splats.rotations[i].x = v,
                9 => splats.rotations[i] = Quat::from_xyzw(v, v, v, v),
                _ => splats.scales_m[i] = Vec3::splat(v.abs()),
            }
        }
        render_all(&renderers::cpus, &splats, &camera);
    }
}
