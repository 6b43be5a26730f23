//! Input at and beyond the limits: clean images or precise errors, never NaN, never a panic.

use glam::{DQuat, DVec3, Quat, Vec3};
use proptest::prelude::*;
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_splat::{Camera, CpuRenderer, Rasterizer, InvalidCamera, RenderError, RgbdImage, Splats, render_reference};

use crate::{agreement, compare};

fn one(mean_m: Vec3, scale_m: Vec3, opacity: f32) -> Splats {
    Splats {
        means_m: vec![mean_m],
        scales_m: vec![scale_m],
        rotations: vec![Quat::from_rotation_x(0.3)],
        opacities: vec![opacity],
        sh_degree: 0,
        sh: vec![0.5, -0.5, 1.0],
    }
}

fn looking_ahead(width_px: u32, height_px: u32, fov_deg: f64) -> Camera {
    Camera {
        intrinsics: Intrinsics::from_horizontal_fov(width_px, height_px, fov_deg.to_radians()),
        world_from_cam: Pose::IDENTITY,
        near_m: 0.05,
        background: [0.2, 0.4, 0.6],
    }
}

/// Renders with everything there is; all images are clean.
fn render_all(splats: &Splats, camera: &Camera) -> Vec<RgbdImage> {
    let mut images = vec![render_reference(splats, &[], camera).expect("a valid camera")];
    for mut renderer in CpuRenderer::every(splats) {
        let mut image = [RgbdImage::default()];
        renderer.render(&[], &[*camera], &mut image).expect("a valid camera");
        images.extend(image);
    }
    images.iter().for_each(compare::assert_clean);
    images
}

#[test]
fn extreme_scales_and_opacities_stay_clean_and_agree() {
    for scale in [0.0, 1e-38, 1e-30, 1e-4, 1.0, 1e4, 1e30, f32::MAX] {
        for other in [scale, 0.01] {
            for opacity in [0.0, 1e-30, 1.0 / 255.0, 0.5, 1.0] {
                let splats = one(Vec3::new(0.1, 0.0, 2.0), Vec3::new(scale, other, scale), opacity);
                let camera = looking_ahead(32, 24, 70.0);
                let images = render_all(&splats, &camera);
                for image in &images[1..] {
                    let middle = 12 * 32 + 17;
                    let off = (image.alpha[middle] - images[0].alpha[middle]).abs();
                    assert!(off < 0.02, "scale {scale} {other}, opacity {opacity}: {off}");
                }
            }
        }
    }
}

#[test]
fn what_is_not_finite_is_left_out() {
    let good = one(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.3), 0.8);
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let spoil: [&dyn Fn(&mut Splats); 6] = [
            &|s| s.means_m[0].x = bad,
            &|s| s.means_m[0].z = bad,
            &|s| s.rotations[0] = Quat::from_xyzw(0.0, bad, 0.0, 1.0),
            &|s| s.rotations[0] = Quat::from_xyzw(0.0, 0.0, 0.0, 0.0),
            &|s| s.opacities[0] = bad,
            &|s| s.sh[1] = bad,
        ];
        for spoil in spoil {
            let mut splats = good.clone();
            spoil(&mut splats);
            for mut renderer in CpuRenderer::every(&splats) {
                let mut image = [RgbdImage::default()];
                renderer.render(&[], &[looking_ahead(20, 20, 60.0)], &mut image).unwrap();
                compare::assert_clean(&image[0]);
                assert!(image[0].alpha.iter().all(|&alpha| alpha == 0.0));
                assert_eq!(renderer.workload().splats, 0);
            }
        }
    }
}

#[test]
fn distances_from_behind_to_far_stay_clean() {
    let camera = looking_ahead(40, 30, 80.0);
    let near = camera.near_m;
    let next = |v: f32| f32::from_bits(v.to_bits() + 1);
    for z in [-1e30, -1.0, 0.0, 1e-30, near, next(near), 0.06, 1.0, 1e6, 1e30, f32::MAX] {
        for x in [0.0, 1e-3, 5.0, 1e30] {
            let images = render_all(&one(Vec3::new(x, 0.0, z), Vec3::splat(0.2), 0.9), &camera);
            if z <= near {
                assert!(images.iter().all(|image| image.alpha.iter().all(|&a| a == 0.0)), "z {z}");
            }
        }
    }
    // Inside a splat: the camera sees what of it lies beyond the near plane.
    let inside = render_all(&one(Vec3::new(0.0, 0.0, 0.06), Vec3::splat(3.0), 0.9), &camera);
    assert!(inside.iter().all(|image| image.alpha.iter().all(|&alpha| alpha > 0.85)));
}

#[test]
fn every_size_and_field_of_view_is_drawn() {
    let splats = one(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.5), 0.9);
    for fov_deg in [1.0, 10.0, 90.0, 150.0, 170.0] {
        for (width, height) in [(1, 1), (3, 2), (16, 16), (17, 33), (200, 1), (1, 200)] {
            let images = render_all(&splats, &looking_ahead(width, height, fov_deg));
            assert!(images.iter().all(|image| image.rgb.len() == (width * height * 3) as usize));
        }
    }
    let camera = looking_ahead(3840, 2160, 90.0);
    let mut image = [RgbdImage::default()];
    CpuRenderer::new(&splats).render(&[], &[camera], &mut image).unwrap();
    compare::assert_clean(&image[0]);
    assert!(image[0].alpha[1080 * 3840 + 1920] > 0.85);
}

#[test]
fn a_scene_without_splats_is_the_background() {
    let camera = looking_ahead(21, 10, 90.0);
    let transparent = one(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.5), 0.001);
    for splats in [Splats::default(), transparent] {
        for image in render_all(&splats, &camera) {
            assert!(image.rgb.chunks(3).all(|rgb| rgb == [0.2, 0.4, 0.6]));
            assert!(image.depth_median_m.iter().all(|&z| z == 0.0));
        }
    }
}

#[test]
fn cameras_that_are_none_are_refused() {
    let good = looking_ahead(20, 10, 60.0);
    let splats = one(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.5), 0.9);
    let check = |camera: Camera, part: &str| {
        let mut untouched = [RgbdImage::default()];
        let refused = CpuRenderer::new(&splats).render(&[], &[camera], &mut untouched);
        let message = refused.expect_err("an invalid camera").to_string();
        assert!(message.contains(part), "{message:?} lacks {part:?}");
        assert_eq!(untouched[0], RgbdImage::default());
        assert!(render_reference(&splats, &[], &camera).is_err());
    };
    let mut camera = good;
    camera.intrinsics.width_px = 0;
    check(camera, "image size 0x10");
    camera = good;
    camera.intrinsics.fx_px = f64::NAN;
    check(camera, "focal length");
    for position in [DVec3::splat(f64::NAN), DVec3::new(1e9, 0.0, 0.0)] {
        check(
            Camera { world_from_cam: Pose::new(position, DQuat::IDENTITY), ..good },
            "camera pose",
        );
    }
    let zero = DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0);
    check(Camera { world_from_cam: Pose::new(DVec3::ZERO, zero), ..good }, "camera pose");
    for near_m in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        check(Camera { near_m, ..good }, "near plane");
    }
    check(Camera { background: [0.0, f32::NAN, 0.0], ..good }, "background");
    assert!(matches!(
        render_reference(&splats, &[], &Camera { near_m: 0.0, ..good }),
        Err(RenderError::Camera(InvalidCamera::Near(_)))
    ));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Any bits at all in a scene, any camera: clean images.
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
        for mut renderer in CpuRenderer::every(&splats) {
            let mut image = [RgbdImage::default()];
            renderer.render(&[], &[camera], &mut image).unwrap();
            compare::assert_clean(&image[0]);
        }
    }
}
