//! Scenes at the limits of merging: clean images, similar to those of full detail.

use glam::{DQuat, DVec3, Quat, Vec3};
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_splat::{Camera, CpuRenderer, Detail, Rasterizer, RgbdImage, Splats};

use crate::city::Random;
use crate::likeness::Likeness;

const COUNT: usize = 3000;

/// Returns small splats in a ball of radius 1 around the origin.
fn cloud() -> Splats {
    let random = &mut Random::new(11);
    let mut splats = Splats::default();
    while splats.len() < COUNT {
        let mean_m = Vec3::from_array([(); 3].map(|()| random.range(-1.0, 1.0)));
        if mean_m.length() > 1.0 {
            continue;
        }
        let q = Quat::from_array([(); 4].map(|()| random.range(-1.0, 1.0)));
        splats.means_m.push(mean_m);
        splats.scales_m.push(Vec3::new(0.05, 0.03, 0.01));
        splats.rotations.push(if q.length() > 0.1 { q.normalize() } else { Quat::IDENTITY });
        splats.opacities.push(random.range(0.05, 1.0));
        splats.sh.extend([(); 3].map(|()| random.range(-1.0, 1.0)));
    }
    splats
}

/// Returns near, middle and far cameras: from full detail to the coarsest level.
fn cameras() -> Vec<Camera> {
    [2.0, 30.0, 200.0, 5000.0]
        .map(|distance_m| Camera {
            background: [0.2, 0.4, 0.6],
            ..Camera::new(
                Intrinsics::from_horizontal_fov(64, 48, 1.2),
                Pose::new(DVec3::new(0.0, 0.0, -distance_m), DQuat::IDENTITY),
                0.05,
            )
        })
        .into()
}

fn render_all(splats: &Splats, detail: Detail) -> Vec<RgbdImage> {
    let cameras = cameras();
    let mut images = vec![RgbdImage::default(); cameras.len()];
    let mut renderer = CpuRenderer::with_detail(splats, detail);
    renderer.render(&[], &cameras, &mut images).expect("valid cameras");
    images
}

/// Renders in adaptive detail. Checks that every image is clean and at least `least_db` similar to full detail.
fn check(name: &str, splats: &Splats, least_db: f64) {
    let truth = render_all(splats, Detail::Full);
    for max_error_px in [0.35, 3.0] {
        let images = render_all(splats, Detail::Adaptive { max_error_px });
        for (i, (image, truth)) in images.iter().zip(&truth).enumerate() {
            assert!(image.rgb.iter().all(|v| v.is_finite()), "{name}");
            assert!(image.alpha.iter().all(|v| (0.0..=1.0).contains(v)), "{name}");
            for depth in [&image.depth_expected_m, &image.depth_median_m] {
                assert!(depth.iter().all(|v| v.is_finite() && *v >= 0.0), "{name}");
            }
            let likeness = Likeness::of(image, truth);
            let least_db = if max_error_px < 1.0 { least_db } else { least_db.min(20.0) };
            assert!(likeness.rgb_db > least_db, "{name}, {max_error_px} px, view {i}: {likeness}");
        }
    }
}

#[test]
fn cloud_is_similar_at_every_distance() {
    check("cloud", &cloud(), 38.0);
}

#[test]
fn renders_scenes_with_few_splats() {
    for count in [0, 1, 2, 255, 256, 257, 1024, 1025] {
        let mut splats = cloud();
        splats.means_m.truncate(count);
        splats.scales_m.truncate(count);
        splats.rotations.truncate(count);
        splats.opacities.truncate(count);
        splats.sh.truncate(count * 3);
        check(&format!("{count} splats"), &splats, 38.0);
    }
}

#[test]
fn extreme_scales_stay_clean() {
    for scale_m in [0.0, 1e-38, 1e-30, 1e-4, 1.0, 1e4, 1e30, f32::MAX] {
        for flat in [scale_m, 0.0, 0.01] {
            let mut splats = cloud();
            splats.scales_m.fill(Vec3::new(scale_m, scale_m, flat));
            check(&format!("scales {scale_m} {flat}"), &splats, 30.0);
            // Some among ordinary splats.
            let mut splats = cloud();
            for scale in splats.scales_m.iter_mut().step_by(100) {
                *scale = Vec3::new(scale_m, flat, scale_m);
            }
            check(&format!("some scales {scale_m} {flat}"), &splats, 30.0);
        }
    }
}

#[test]
fn extreme_opacities_stay_clean() {
    for opacity in [0.0, 1e-30, 1.0 / 255.0, 0.0041, 0.5, 1.0] {
        let mut splats = cloud();
        splats.opacities.fill(opacity);
        check(&format!("opacity {opacity}"), &splats, 30.0);
    }
}

#[test]
fn coincident_and_identical_splats_stay_clean() {
    let mut splats = cloud();
    splats.means_m.fill(Vec3::new(0.1, 0.0, 0.0));
    check("one place", &splats, 30.0);
    splats.scales_m.fill(Vec3::splat(0.05));
    splats.rotations.fill(Quat::IDENTITY);
    splats.opacities.fill(0.3);
    splats.sh.fill(0.4);
    check("identical", &splats, 30.0);
    splats.scales_m.fill(Vec3::ZERO);
    check("identical points", &splats, 30.0);
    // Distances within the rounding error.
    for (i, mean_m) in splats.means_m.iter_mut().enumerate() {
        mean_m.x = f32::from_bits(mean_m.x.to_bits() + (i % 3) as u32);
    }
    check("next to each other", &splats, 30.0);
}

#[test]
fn distant_positions_stay_clean() {
    for far_m in [1e6, 1e19, 1e30, f32::MAX] {
        let mut splats = cloud();
        for mean_m in splats.means_m.iter_mut().step_by(50) {
            *mean_m *= far_m;
        }
        check(&format!("some at {far_m} m"), &splats, 30.0);
        for (i, mean_m) in splats.means_m.iter_mut().enumerate() {
            *mean_m = Vec3::splat(if i % 2 == 0 { far_m } else { -far_m });
        }
        check(&format!("all at {far_m} m"), &splats, 30.0);
    }
}

#[test]
fn splats_that_are_not_finite_are_dropped() {
    let mut splats = cloud();
    for (i, bad) in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY].into_iter().enumerate() {
        splats.means_m[i * 10].x = bad;
        splats.opacities[i * 10 + 1] = bad;
        splats.rotations[i * 10 + 2].y = bad;
        splats.sh[(i * 10 + 3) * 3] = bad;
        splats.scales_m[i * 10 + 4].x = bad;
    }
    check("not finite", &splats, 30.0);
}
