//! Input at and beyond the limits: clean images that agree, never NaN, never a hang.

use glam::{DQuat, DVec3, Quat, Vec3};
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_splat::gpu::GpuRenderer;
use vizflyt_splat::{
    Camera, CpuRenderer, InvalidCamera, Rasterizer, RenderError, RgbdImage, RigidObject, Scene,
    Splats, render_reference,
};

use crate::{compare, renderer, twins};

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

/// Renders several scenes on one device.
struct GpuTest(GpuRenderer);

impl GpuTest {
    fn new() -> Option<Self> {
        renderer(&Splats::default()).map(Self)
    }

    fn render_one(&mut self, splats: &Splats, camera: &Camera) -> RgbdImage {
        self.0.load(&CpuRenderer::new(splats)).expect("room");
        let mut image = [RgbdImage::default()];
        self.0.render(&[], &[*camera], &mut image).expect("a valid camera");
        let [image] = image;
        compare::assert_clean(&image);
        image
    }
}

#[test]
fn extreme_scales_and_opacities_stay_clean_and_agree() {
    let Some(mut renderer) = GpuTest::new() else { return };
    for scale in [0.0, 1e-38, 1e-30, 1e-4, 1.0, 1e4, 1e30, f32::MAX] {
        for other in [scale, 0.01] {
            for opacity in [0.0, 1e-30, 1.0 / 255.0, 0.5, 1.0] {
                let splats = one(Vec3::new(0.1, 0.0, 2.0), Vec3::new(scale, other, scale), opacity);
                let antialiased = Splats { antialiased: true, ..splats.clone() };
                let camera = looking_ahead(32, 24, 70.0);
                for splats in [splats, antialiased] {
                    let image = renderer.render_one(&splats, &camera);
                    let expected = render_reference(&splats, &[], &camera).expect("a valid camera");
                    let middle = 12 * 32 + 17;
                    let off = (image.alpha[middle] - expected.alpha[middle]).abs();
                    assert!(off < 0.02, "scale {scale} {other}, opacity {opacity}: {off}");
                }
            }
        }
    }
}

#[test]
fn images_stay_clean_from_behind_the_camera_to_far_away() {
    let Some(mut renderer) = GpuTest::new() else { return };
    let camera = looking_ahead(40, 30, 80.0);
    let near = camera.near_m;
    let next = |v: f32| f32::from_bits(v.to_bits() + 1);
    for z in [-1e30, -1.0, 0.0, 1e-30, near, next(near), 0.06, 1.0, 1e6, 1e30, f32::MAX] {
        for x in [0.0, 1e-3, 5.0, 1e30] {
            let splats = one(Vec3::new(x, 0.0, z), Vec3::splat(0.2), 0.9);
            let image = renderer.render_one(&splats, &camera);
            if z <= near {
                assert!(image.alpha.iter().all(|&alpha| alpha == 0.0), "z {z}");
            } else if x == 0.0 && z <= 1e6 {
                let expected = render_reference(&splats, &[], &camera).expect("a valid camera");
                let db = compare::psnr_db(&image.alpha, &expected.alpha);
                assert!(db > 50.0, "z {z}: {db} dB");
            }
        }
    }
    // Inside a splat: the part beyond the near plane is visible.
    let inside = one(Vec3::new(0.0, 0.0, 0.06), Vec3::splat(3.0), 0.9);
    assert!(renderer.render_one(&inside, &camera).alpha.iter().all(|&alpha| alpha > 0.85));
}

#[test]
fn renders_every_size_and_field_of_view() {
    let Some(mut renderer) = GpuTest::new() else { return };
    let splats = one(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.5), 0.9);
    for fov_deg in [1.0, 10.0, 90.0, 150.0, 170.0] {
        for (width, height) in [(1, 1), (3, 2), (16, 16), (17, 33), (200, 1), (1, 200)] {
            let camera = looking_ahead(width, height, fov_deg);
            let image = renderer.render_one(&splats, &camera);
            let expected = render_reference(&splats, &[], &camera).expect("a valid camera");
            let db = compare::psnr_db(&image.alpha, &expected.alpha);
            assert!(db > 50.0, "{width}x{height}, {fov_deg} degrees: {db} dB");
        }
    }
    let image = renderer.render_one(&splats, &looking_ahead(3840, 2160, 90.0));
    assert!(image.alpha[1080 * 3840 + 1920] > 0.85);
}

#[test]
fn empty_scene_shows_the_background() {
    let Some(mut renderer) = GpuTest::new() else { return };
    let camera = looking_ahead(21, 10, 90.0);
    for splats in [Splats::default(), one(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.5), 0.001)] {
        let image = renderer.render_one(&splats, &camera);
        // Colours are halves: 0.2 is off by 5e-5.
        let off = |rgb: &[f32]| {
            rgb.iter().zip([0.2, 0.4, 0.6]).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
        };
        assert!(image.rgb.chunks(3).all(|rgb| off(rgb) < 2e-4));
        assert!(image.depth_median_m.iter().all(|&z| z == 0.0));
        assert_eq!(renderer.0.workload().splats, 0);
    }
}

#[test]
fn damaged_scenes_show_their_valid_splats() {
    let Some(mut renderer) = GpuTest::new() else { return };
    let state = &mut 5;
    for round in 0..24 {
        let mut splats = twins::cloud(300, 1, round);
        let numbers = splats.sh_coefficients() * 3;
        for _ in 0..40 {
            // Arbitrary bits, most of them with extreme exponents.
            let v = f32::from_bits((twins::random(state, 0.0, 1.0) * u32::MAX as f32) as u32);
            let i = twins::random(state, 0.0, 299.0) as usize;
            match twins::random(state, 0.0, 7.0) as usize {
                0 => splats.means_m[i].x = v,
                1 => splats.means_m[i].z = v,
                2 => splats.scales_m[i].y = v.abs(),
                3 => splats.opacities[i] = v,
                4 => splats.sh[i * numbers] = v,
                5 => splats.rotations[i].x = v,
                _ => splats.scales_m[i] = Vec3::splat(v.abs()),
            }
        }
        let camera = looking_ahead(48, 36, 80.0);
        renderer.render_one(&splats, &camera);
        let mut cpu = vizflyt_splat::CpuRenderer::new(&splats);
        cpu.render(&[], &[camera], &mut [RgbdImage::default()]).expect("a valid camera");
        assert_eq!(renderer.0.workload().splats, cpu.workload().splats);
    }
}

#[test]
fn rejects_invalid_cameras_and_placements() {
    let splats = one(Vec3::new(0.0, 0.0, 2.0), Vec3::splat(0.5), 0.9);
    let objects = [RigidObject { id: 1, splats: splats.clone() }];
    let Some(mut gpu) = renderer(Scene { splats: &splats, objects: &objects }) else { return };
    let good = looking_ahead(20, 10, 60.0);
    let mut image = [RgbdImage::default()];
    let bad = Camera { near_m: f32::NAN, ..good };
    let refused = gpu.render(&[None], &[bad], &mut image);
    assert!(matches!(refused, Err(RenderError::Camera(InvalidCamera::Near(_)))), "{refused:?}");
    let nowhere = Some(Pose::new(DVec3::splat(f64::NAN), DQuat::IDENTITY));
    let refused = gpu.render(&[nowhere], &[good], &mut image);
    assert!(matches!(refused, Err(RenderError::Placement(0, _))), "{refused:?}");
    assert_eq!(image[0], RgbdImage::default());
    gpu.render(&[None], &[good], &mut image).expect("a valid camera");
}
