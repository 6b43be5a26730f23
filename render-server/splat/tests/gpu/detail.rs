//! Adaptive detail: the GPU renderer selects the same blocks as the CPU renderer, although its walk of the tree
//! differs.

use glam::{DMat3, DQuat, DVec3};
use vizflyt_protocol::geometry::{Distortion, Intrinsics, Pose};
use vizflyt_splat::gpu::{Budget, GpuRenderer};
use vizflyt_splat::{
    Camera, CpuRenderer, Detail, Placement, Rasterizer, RgbdImage, RigidObject, Scene, Splats,
};

use crate::agreement::assert_alike;
use crate::city::city;
use crate::{adapter, twins};

fn look(from: DVec3, to: DVec3, k: Intrinsics) -> Camera {
    let z = (to - from).normalize();
    let x = z.cross(DVec3::Z).normalize();
    let rotation = DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z));
    Camera { background: [0.5, 0.6, 0.8], ..Camera::new(k, Pose::new(from, rotation), 0.05) }
}

/// Returns cameras far away, above and in a street, and one through a lens.
fn cameras() -> Vec<Camera> {
    let k = Intrinsics::from_horizontal_fov(160, 120, 90f64.to_radians());
    let bent = Distortion::BrownConrady { k1: -0.2, k2: 0.05, p1: 1e-3, p2: -1e-3, k3: 0.0 };
    vec![
        look(DVec3::new(-110.0, -90.0, 60.0), DVec3::ZERO, k),
        look(DVec3::new(10.0, -20.0, 130.0), DVec3::new(0.0, 10.0, 0.0), k),
        look(DVec3::new(-58.0, -19.0, 1.6), DVec3::new(0.0, -18.0, 3.0), k),
        look(DVec3::new(-70.0, 40.0, 30.0), DVec3::ZERO, Intrinsics { distortion: bent, ..k }),
    ]
}

fn rendered(
    renderer: &mut dyn Rasterizer,
    placements: &[Placement],
    cameras: &[Camera],
) -> (Vec<RgbdImage>, usize) {
    let mut images = vec![RgbdImage::default(); cameras.len()];
    renderer.render(placements, cameras, &mut images).expect("valid cameras");
    (images, renderer.workload().visible)
}

#[test]
fn renders_the_same_blocks_as_the_cpu() {
    let Some(adapter) = adapter() else { return };
    // A ball of a hundred metres, seen from near and far, rotated differently from the city.
    let ball = twins::ball(30_000, 50.0, 1);
    let objects = [RigidObject { id: 9, splats: ball }];
    let turned = DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.7, 1.1);
    let placements = [Some(Pose::new(DVec3::new(40.0, 60.0, 20.0), turned))];
    for antialiased in [false, true] {
        let splats = Splats { antialiased, ..city(120_000, 3, 1) };
        let scene = Scene { splats: &splats, objects: &objects };
        let mut cpu = CpuRenderer::with_detail(scene, Detail::ADAPTIVE);
        let mut gpu = GpuRenderer::like(&cpu, adapter, Budget::default()).expect("a device");
        let mut every = GpuRenderer::new(scene, adapter, Budget::default()).expect("a device");
        assert!(gpu.name().ends_with(", adaptive detail") && !every.name().contains("detail"));
        let (mut merged, mut all) = (0, 0);
        for (i, camera) in cameras().into_iter().enumerate() {
            let what = format!("antialiased {antialiased}, camera {i}");
            let (expected, by_cpu) = rendered(&mut cpu, &placements, &[camera]);
            let (actual, by_gpu) = rendered(&mut gpu, &placements, &[camera]);
            let (_, whole) = rendered(&mut every, &placements, &[camera]);
            assert_alike(&what, &actual[0], &expected[0]);
            // If the error of a block equals the allowed error within the rounding of f32, either level may be
            // selected.
            assert!(by_gpu.abs_diff(by_cpu) * 100 <= by_cpu, "{what}: {by_gpu} and {by_cpu}");
            (merged, all) = (merged + by_gpu, all + whole);
        }
        assert!(merged * 10 < all * 9, "rendered {merged} of {all}");
        // All cameras at once give the same images as one by one.
        let (together, _) = rendered(&mut gpu, &placements, &cameras());
        for (camera, image) in cameras().into_iter().zip(&together) {
            assert_eq!(&rendered(&mut gpu, &placements, &[camera]).0[0], image);
        }
    }
}
