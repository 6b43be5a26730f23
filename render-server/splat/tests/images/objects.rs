//! Rigid objects: rendered at their placement, hidden by nearer surfaces, and identified by their ids.

use glam::{DQuat, DVec3, Quat, Vec3};
use proptest::prelude::*;
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_splat::{
    Camera, CpuRenderer, Placement, Rasterizer, RenderError, RgbdImage, RigidObject, Scene, Splats,
    render_reference,
};

use crate::agreement::{assert_agrees, camera, cases, splats};
use crate::{compare, cuts};

fn placement() -> impl Strategy<Value = Placement> {
    let pose = (prop::array::uniform3(-3.0..3.0f64), prop::array::uniform4(-1.0..1.0f64));
    prop::option::weighted(
        0.9,
        pose.prop_map(|(position, q)| {
            let q = DQuat::from_array(q);
            let rotation = if q.length() > 1e-2 { q.normalize() } else { DQuat::IDENTITY };
            Pose::new(DVec3::from(position), rotation)
        }),
    )
}

fn objects() -> impl Strategy<Value = Vec<(RigidObject, Placement)>> {
    let object = (1..=u16::MAX, splats(1..120)).prop_map(|(id, splats)| RigidObject { id, splats });
    prop::collection::vec((object, placement()), 1..4)
}

proptest! {
    #![proptest_config(cases(48))]

    #[test]
    fn fast_equals_reference_with_objects(
        still in splats(0..300),
        objects in objects(),
        cameras in prop::collection::vec(camera(), 1..3),
    ) {
        let (objects, placements): (Vec<_>, Vec<_>) = objects.into_iter().unzip();
        let scene = Scene { splats: &still, objects: &objects };
        let expected: Vec<Vec<RgbdImage>> =
            cameras.iter().map(|camera| cuts::references(scene, &placements, camera)).collect();
        for mut renderer in CpuRenderer::every(scene) {
            let mut images = vec![RgbdImage::default(); cameras.len()];
            renderer.render(&placements, &cameras, &mut images).expect("a valid call");
            for (image, expected) in images.iter().zip(&expected) {
                compare::assert_clean(image);
                assert_agrees(&renderer.name(), image, expected);
            }
        }
    }
}

proptest! {
    #![proptest_config(cases(32))]

    /// Depth-only mode: median depths and ids are bit-identical in consecutive images, on every instruction set.
    #[test]
    fn depth_only_mode_gives_the_same_depth(
        still in splats(0..300),
        objects in objects(),
        cameras in prop::collection::vec(camera(), 1..3),
    ) {
        let (objects, placements): (Vec<_>, Vec<_>) = objects.into_iter().unzip();
        for objects in [&objects[..], &[]] {
            let scene = Scene { splats: &still, objects };
            let placements = &placements[..objects.len()];
            let alone = CpuRenderer::every(scene);
            for (mut whole, mut alone) in CpuRenderer::every(scene).into_iter().zip(alone) {
                alone.set_depth_alone(true);
                let mut images = vec![[RgbdImage::default(), RgbdImage::default()]; cameras.len()];
                for (camera, [expected, found]) in cameras.iter().zip(&mut images) {
                    let camera = std::slice::from_ref(camera);
                    whole.render(placements, camera, std::slice::from_mut(expected)).unwrap();
                    alone.render(placements, camera, std::slice::from_mut(found)).unwrap();
                    let bits = |image: &RgbdImage| -> Vec<u32> {
                        image.depth_median_m.iter().map(|m| m.to_bits()).collect()
                    };
                    prop_assert!(bits(expected) == bits(found), "{}", whole.name());
                    prop_assert_eq!(&expected.ids, &found.ids);
                }
            }
        }
    }
}

/// Returns a square wall of opaque splats, perpendicular to the z axis of its frame.
fn wall(z_m: f32, half_m: f32, colour: f32) -> Splats {
    let mut splats = Splats::default();
    for y in -20..=20i16 {
        for x in -20..=20i16 {
            let at = Vec3::new(f32::from(x), f32::from(y), 0.0) / 20.0 * half_m;
            splats.means_m.push(at + Vec3::Z * z_m);
            splats.scales_m.push(Vec3::new(half_m / 25.0, half_m / 25.0, 1e-3));
            splats.rotations.push(Quat::IDENTITY);
            splats.opacities.push(0.95);
            splats.sh.extend([(colour - 0.5) / 0.282_094_8; 3]);
        }
    }
    splats
}

fn ahead() -> Camera {
    Camera::new(Intrinsics::from_horizontal_fov(64, 48, 1.2), Pose::IDENTITY, 0.05)
}

#[test]
fn object_hides_the_wall_behind_it_and_sets_the_id() {
    let still = wall(4.0, 3.0, 0.2);
    let door = [RigidObject { id: 7, splats: wall(0.0, 0.5, 0.9) }];
    let scene = Scene { splats: &still, objects: &door };
    let centre = 24 * 64 + 32;
    for mut renderer in CpuRenderer::every(scene) {
        let mut render_one = |placement: Placement| {
            let mut image = [RgbdImage::default()];
            renderer.render(&[placement], &[ahead()], &mut image).unwrap();
            let [image] = image;
            (image.ids[centre], image.depth_median_m[centre], image.rgb[centre * 3])
        };
        let at = |x_m: f64, z_m: f64| Some(Pose::new(DVec3::new(x_m, 0.0, z_m), DQuat::IDENTITY));
        let (id, depth_m, red) = render_one(at(0.0, 2.0));
        assert!(id == 7 && (depth_m - 2.0).abs() < 0.01 && red > 0.8, "{id} {depth_m} {red}");
        for away in [None, at(3.0, 2.0), at(0.0, 5.0), at(0.0, -2.0)] {
            let (id, depth_m, red) = render_one(away);
            assert!(id == 0 && (depth_m - 4.0).abs() < 0.02 && red < 0.3, "{id} {depth_m} {red}");
        }
    }
}

#[test]
fn rejects_an_invalid_placement() {
    let still = wall(4.0, 3.0, 0.2);
    let door = [RigidObject { id: 7, splats: wall(0.0, 0.5, 0.9) }];
    let scene = Scene { splats: &still, objects: &door };
    for position in [DVec3::NAN, DVec3::INFINITY, DVec3::splat(1e8)] {
        let placement = [Some(Pose::new(position, DQuat::IDENTITY))];
        let mut image = [RgbdImage::default()];
        let error = CpuRenderer::new(scene).render(&placement, &[ahead()], &mut image).unwrap_err();
        assert!(matches!(error, RenderError::Placement(0, _)), "{error}");
        assert_eq!(image[0], RgbdImage::default());
        assert!(render_reference(scene, &placement, &ahead()).is_err());
    }
}
