//! Compares images in adaptive detail with images of every splat.

use std::path::Path;

use glam::{DMat3, DQuat, DVec3, Quat, Vec3};
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_splat::{
    Camera, CpuRenderer, Detail, Placement, Rasterizer, RgbdImage, RigidObject, Scene, Splats, ply,
};

use crate::city::city;
use crate::lawn::{SIDE_M, lawn};
use crate::likeness::Likeness;
use crate::twins::oracle_camera;

fn look(from: DVec3, to: DVec3) -> Camera {
    let z = (to - from).normalize();
    let x = z.cross(DVec3::Z).normalize();
    let rotation = DMat3::from_cols(x, z.cross(x), z);
    Camera {
        background: [0.5, 0.6, 0.8],
        ..Camera::new(
            Intrinsics::from_horizontal_fov(320, 240, 90f64.to_radians()),
            Pose::new(from, DQuat::from_mat3(&rotation)),
            0.05,
        )
    }
}

fn render_all(
    renderer: &mut CpuRenderer,
    placements: &[Placement],
    camera: &Camera,
) -> (RgbdImage, usize) {
    let mut image = [RgbdImage::default()];
    renderer.render(placements, &[*camera], &mut image).expect("a valid camera");
    let [image] = image;
    (image, renderer.workload().visible)
}

#[test]
fn distant_city_is_similar_with_fewer_splats() {
    for sh_degree in [0, 1] {
        let splats = city(300_000, 3, sh_degree);
        let mut full = CpuRenderer::new(&splats);
        let mut adaptive = CpuRenderer::with_detail(&splats, Detail::ADAPTIVE);
        let (mut rendered, mut all) = (0, 0);
        for (from, to) in [
            (DVec3::new(-110.0, -90.0, 60.0), DVec3::ZERO),
            (DVec3::new(10.0, -20.0, 130.0), DVec3::new(0.0, 10.0, 0.0)),
            (DVec3::new(-58.0, -19.0, 1.6), DVec3::new(0.0, -18.0, 3.0)),
        ] {
            let camera = look(from, to);
            let (truth, visible) = render_all(&mut full, &[], &camera);
            all += visible;
            let (image, visible) = render_all(&mut adaptive, &[], &camera);
            rendered += visible;
            let likeness = Likeness::of(&image, &truth);
            assert!(likeness.rgb_db > 40.0, "{from}: {likeness}");
            assert!(likeness.alpha_db > 36.0, "{from}: {likeness}");
            assert!(likeness.median_off < 0.01, "{from}: {likeness}");
            assert!(likeness.expected_off < 0.01, "{from}: {likeness}");
            assert!(likeness.holes < 1e-3, "{from}: {likeness}");
        }
        assert!(rendered * 20 < all * 19, "drew {rendered} of {all}");
    }
}

/// Checks the limits of [`Detail::ADAPTIVE`] for a view with `visible` splats.
fn assert_promise(what: &str, image: &RgbdImage, truth: &RgbdImage, visible: usize) {
    let likeness = Likeness::of(image, truth);
    let per_pixel = visible as f64 / truth.alpha.len() as f64;
    println!("{what}, {per_pixel:.1} splats per pixel: {likeness}");
    if per_pixel <= 15.0 {
        assert!(likeness.rgb_db >= 37.0 && likeness.alpha_db >= 37.0, "{what}: {likeness}");
        assert!(likeness.rgb_off <= 0.04 && likeness.median_off <= 0.06, "{what}: {likeness}");
        assert!(likeness.holes <= 0.01, "{what}: {likeness}");
    }
    assert!(likeness.rgb_db >= 30.0 || per_pixel > 100.0, "{what}: {likeness}");
}

/// Returns a camera with the same field of view and fewer pixels: the scene appears smaller, with the same number of
/// splats.
fn shrunk(k: &Intrinsics, share: f64) -> Intrinsics {
    let size = |px: u32| (f64::from(px) * share).round() as u32;
    Intrinsics {
        width_px: size(k.width_px),
        height_px: size(k.height_px),
        fx_px: k.fx_px * share,
        fy_px: k.fy_px * share,
        cx_px: k.cx_px * share,
        cy_px: k.cy_px * share,
        ..*k
    }
}

/// Renders the views of a scene in smaller and smaller images, and checks the limits. Returns the number of rendered
/// splats, and the number in full detail.
fn check_promise(what: &str, splats: &Splats, cameras: &[Camera]) -> (usize, usize) {
    let mut full = CpuRenderer::new(splats);
    let mut adaptive = CpuRenderer::with_detail(splats, Detail::ADAPTIVE);
    let (mut rendered, mut all) = (0, 0);
    for (i, camera) in cameras.iter().enumerate() {
        for share in [1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12] {
            let camera = Camera { intrinsics: shrunk(&camera.intrinsics, share), ..*camera };
            let (truth, visible) = render_all(&mut full, &[], &camera);
            let (image, merged) = render_all(&mut adaptive, &[], &camera);
            (all, rendered) = (all + visible, rendered + merged);
            let what = format!("{what}, view {i} at {share}");
            assert_promise(&what, &image, &truth, visible);
        }
    }
    (rendered, all)
}

#[test]
fn lawn_meets_the_limits_of_adaptive_detail() {
    for antialiased in [false, true] {
        let splats = Splats { antialiased, ..lawn(150_000) };
        let side_m = f64::from(SIDE_M);
        let cameras = [
            look(DVec3::new(-0.9 * side_m, 0.0, 0.5 * side_m), DVec3::ZERO),
            look(DVec3::new(-0.1 * side_m, 0.0, 0.7 * side_m), DVec3::ZERO),
            look(DVec3::new(-0.7 * side_m, 0.2, 1.7), DVec3::ZERO),
        ];
        let what = if antialiased { "antialiased lawn" } else { "lawn" };
        let (rendered, all) = check_promise(what, &splats, &cameras);
        println!("{what}: {rendered} of {all} splats");
        assert!(rendered * 10 < all * 9, "{rendered} of {all}");
    }
}

#[test]
fn captured_scenes_meet_the_limits_of_adaptive_detail() {
    let shared = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/scenes");
    for scene in ["room", "flowers_lod2"] {
        let file = shared.join(scene).with_extension("ply");
        if !file.exists() {
            println!("skipped: {scene} in adaptive detail, for lack of {}", file.display());
            continue;
        }
        let splats = ply::read(&file).expect("a scene").splats;
        let cameras = ["p0", "p1"].map(|pose| Camera {
            background: [0.5, 0.6, 0.8],
            ..oracle_camera(&shared.join(format!("ref/{scene}_{pose}_320x240.json")))
        });
        for antialiased in [false, true] {
            let splats = Splats { antialiased, ..splats.clone() };
            check_promise(&format!("{scene}, antialiased {antialiased}"), &splats, &cameras);
        }
    }
}

#[test]
fn smaller_allowed_error_gives_smaller_error() {
    let splats = city(60_000, 3, 0);
    let camera = look(DVec3::new(-110.0, -90.0, 60.0), DVec3::ZERO);
    let (truth, all) = render_all(&mut CpuRenderer::new(&splats), &[], &camera);
    let mut before = (0.0, 0);
    for max_error_px in [4.0, 2.0, 1.0] {
        let mut renderer = CpuRenderer::with_detail(&splats, Detail::Adaptive { max_error_px });
        let (image, visible) = render_all(&mut renderer, &[], &camera);
        let rgb_db = Likeness::of(&image, &truth).rgb_db;
        assert!(rgb_db > before.0 && visible > before.1, "{max_error_px}: {rgb_db} {visible}");
        before = (rgb_db, visible);
    }
    assert!(before.1 < all);
    // No allowed error: nothing is merged.
    for max_error_px in [0.0, -1.0, f32::NAN] {
        let mut renderer = CpuRenderer::with_detail(&splats, Detail::Adaptive { max_error_px });
        let (image, visible) = render_all(&mut renderer, &[], &camera);
        assert!(image == truth && visible == all, "{max_error_px}");
    }
}

#[test]
fn near_splats_are_rendered_in_full_detail() {
    let splats = city(60_000, 3, 1);
    // End of a street: nothing in view is small.
    let camera = look(DVec3::new(-22.0, -20.0, 1.6), DVec3::new(-20.0, -15.0, 1.2));
    let near = Camera { intrinsics: Intrinsics::from_horizontal_fov(320, 240, 0.4), ..camera };
    let (truth, _) = render_all(&mut CpuRenderer::new(&splats), &[], &near);
    let (image, _) =
        render_all(&mut CpuRenderer::with_detail(&splats, Detail::ADAPTIVE), &[], &near);
    let likeness = Likeness::of(&image, &truth);
    assert!(likeness.rgb_db > 60.0, "{likeness}");
}

#[test]
fn packing_and_rendering_again_give_the_same_bytes() {
    let splats = city(40_000, 3, 1);
    let camera = look(DVec3::new(-110.0, -90.0, 60.0), DVec3::ZERO);
    let mut renderer = CpuRenderer::with_detail(&splats, Detail::ADAPTIVE);
    let first = render_all(&mut renderer, &[], &camera);
    assert_eq!(render_all(&mut renderer, &[], &camera), first);
    for _ in 0..2 {
        let mut again = CpuRenderer::with_detail(&splats, Detail::ADAPTIVE);
        assert_eq!(render_all(&mut again, &[], &camera), first);
    }
}

/// Returns a ball of small splats: an object that is one pixel wide, or fills the view.
fn ball(count: usize) -> Splats {
    let random = &mut crate::city::Random::new(5);
    let mut splats = Splats::default();
    for _ in 0..count {
        let q = [(); 4].map(|()| random.range(-1.0, 1.0));
        let turn = Quat::from_array(q).normalize();
        splats.means_m.push(turn * Vec3::Z * 0.5);
        splats.scales_m.push(Vec3::new(0.02, 0.02, 0.002));
        splats.rotations.push(turn);
        splats.opacities.push(0.9);
        splats.sh.extend([1.0, 0.2, -0.7]);
    }
    splats
}

#[test]
fn objects_have_separate_levels() {
    let still = city(20_000, 2, 0);
    let objects = [
        RigidObject { id: 3, splats: ball(20_000) },
        RigidObject { id: 4, splats: ball(20_000) },
        RigidObject { id: 5, splats: Splats::default() },
    ];
    let scene = Scene { splats: &still, objects: &objects };
    let camera = look(DVec3::new(-30.0, 0.0, 3.0), DVec3::new(0.0, 0.0, 3.0));
    let at = |x_m: f64, y_m: f64| {
        Some(Pose::new(DVec3::new(x_m, y_m, 3.0), DQuat::from_rotation_z(x_m)))
    };
    // One object close to the camera, one far away.
    let placements = [at(-28.0, 0.6), at(-5.0, -2.0), at(-27.0, 0.0)];
    let (truth, all) = render_all(&mut CpuRenderer::new(scene), &placements, &camera);
    let mut renderer = CpuRenderer::with_detail(scene, Detail::ADAPTIVE);
    let (image, rendered) = render_all(&mut renderer, &placements, &camera);
    let likeness = Likeness::of(&image, &truth);
    assert!(likeness.rgb_db > 38.0 && likeness.median_off < 0.01, "{likeness}");
    assert!(rendered + 10_000 < all, "{rendered} of {all}");
    let count = |image: &RgbdImage, id: u16| image.ids.iter().filter(|&&v| v == id).count();
    for id in [3, 4] {
        let (a, b) = (count(&image, id), count(&truth, id));
        assert!(b > 0 && a.abs_diff(b) <= 1 + b / 50, "object {id}: {a} and {b} pixels");
    }
    // The objects are absent again.
    let (image, _) = render_all(&mut renderer, &[None, None, None], &camera);
    assert!(image.ids.iter().all(|&id| id == 0));
}
