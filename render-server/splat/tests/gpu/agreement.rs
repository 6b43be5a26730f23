//! Structured scenes: images agree with those of the CPU renderer to 50 dB, depths to 1 %.

use std::path::Path;

use glam::{DQuat, DVec3, Vec2, Vec3};
use vizflyt_protocol::geometry::{Distortion, Intrinsics, Pose};
use vizflyt_splat::weather::{
    Cloud, LampPlaces, Lamps, Moment, OwnLight, Rain, Snow, Weather, WeatherPass,
};
use vizflyt_splat::{Atmosphere, Camera, RgbdImage, RigidObject, Scene, Splats, ply};

use crate::{both, compare, twins};

/// Checks that images agree to 50 dB, and depths to 1 % except at edges: where one splat more or less moves the point
/// at which half of the light is gone, depth jumps between surfaces. Such pixels are at most 0.5 %, and one pixel in
/// a tiny image.
pub(crate) fn assert_alike(what: &str, actual: &RgbdImage, expected: &RgbdImage) {
    assert_eq!((actual.width_px, actual.height_px), (expected.width_px, expected.height_px));
    let rgb_db = compare::psnr_db(&actual.rgb, &expected.rgb);
    let alpha_db = compare::psnr_db(&actual.alpha, &expected.alpha);
    let off = |a: &[f32], b: &[f32]| compare::depth_off(a, b, &expected.alpha, 1e-2);
    let expected_off = off(&actual.depth_expected_m, &expected.depth_expected_m);
    let median_off = off(&actual.depth_median_m, &expected.depth_median_m);
    let pixels = expected.alpha.len() as f64;
    let ids_off = actual.ids.iter().zip(&expected.ids).filter(|(a, b)| a != b).count() as f64;
    println!(
        "{what}: rgb {rgb_db:.1} dB, alpha {alpha_db:.1} dB; off by 1 %: expected depth {:.3} %, \
         median depth {:.3} %; other id {:.3} %",
        expected_off * 100.0,
        median_off * 100.0,
        ids_off / pixels * 100.0
    );
    assert!(rgb_db >= 50.0 && alpha_db >= 50.0, "{what}: {rgb_db} dB, alpha {alpha_db} dB");
    let outliers = 0.005 + 1.0 / pixels;
    assert!(expected_off <= outliers, "{what}: expected depth {expected_off}");
    assert!(median_off <= outliers, "{what}: median depth {median_off}");
    assert!(ids_off / pixels <= outliers, "{what}: ids {ids_off}");
}

fn check<'a>(
    what: &str,
    scene: impl Into<Scene<'a>>,
    placements: &[vizflyt_splat::Placement],
    cameras: &[Camera],
) {
    let Some((expected, actual)) = both(scene, placements, cameras) else { return };
    for (i, (actual, expected)) in actual.iter().zip(&expected).enumerate() {
        let size = format!("{}x{}", expected.width_px, expected.height_px);
        assert_alike(&format!("{what}, camera {i} {size}"), actual, expected);
    }
}

#[test]
fn generated_twins_of_every_degree_agree() {
    for degree in 0..=3 {
        let splats = twins::cloud(4000, degree, 7 + u64::from(degree));
        let cameras = [twins::camera(97, 61, 70.0), twins::camera(160, 120, 110.0)];
        check(&format!("degree {degree}"), &splats, &[], &cameras);
    }
}

/// Weather is one pass over finished images: renderers that agree without weather also agree with it.
#[test]
fn images_agree_in_weather() {
    let splats = twins::cloud(4000, 0, 7);
    let dim = Atmosphere { light: [0.3; 3], ..Atmosphere::CLEAR };
    let camera = Camera { atmosphere: dim, ..twins::camera(160, 120, 80.0) };
    let Some((mut expected, mut actual)) = both(&splats, &[], &[camera]) else { return };
    let clear = expected[0].rgb.clone();
    let weather = Weather {
        cloud: Some(Cloud {
            per_m: 0.3,
            color: [0.6, 0.6, 0.7],
            patchiness: 1.0,
            patch_m: 0.8,
            drift_mps: Vec3::X,
            layer_m: None,
            ball: None,
        }),
        rain: Some(Rain { rate_mmph: 30.0, wind_mps: Vec2::X, lens_drops: 6 }),
        snow: Some(Snow { rate_mmph: 2.0, wind_mps: Vec2::Y }),
        lamps: Some(Lamps {
            reach_m: 1.0,
            color: [1.0, 0.8, 0.6],
            places: LampPlaces::Grid { height_m: 2.0, spacing_m: 3.0 },
        }),
        own_light: Some(OwnLight { reach_m: 0.8, color: [1.0; 3], cos_cone: 0.85 }),
        ..Weather::CLEAR
    };
    let moment = Moment { at_ns: 1_234_567_890, v_world_mps: DVec3::ZERO, seed: 7 };
    for image in expected.iter_mut().chain(&mut actual) {
        WeatherPass::default().apply(&weather, &camera, &moment, image);
    }
    assert_ne!(expected[0].rgb, clear, "weather has no effect");
    assert_alike("weather", &actual[0], &expected[0]);
}

#[test]
fn renders_cameras_of_all_sizes_at_once() {
    let splats = twins::cloud(3000, 1, 3);
    let sizes = [(1, 1), (1, 50), (50, 1), (15, 17), (16, 16), (33, 7), (320, 240), (2, 3)];
    let cameras: Vec<Camera> = (0..)
        .zip(sizes)
        .map(|(i, (width, height))| {
            let camera = twins::camera(width, height, 60.0 + 10.0 * f64::from(i));
            let turn = DQuat::from_rotation_y(0.2 * f64::from(i));
            let at = DVec3::new(0.1 * f64::from(i), 0.0, 0.0);
            Camera { world_from_cam: Pose::new(at, turn), ..camera }
        })
        .collect();
    check("at once", &splats, &[], &cameras);
}

#[test]
fn light_and_fog_agree() {
    let splats = twins::cloud(3000, 2, 19);
    let dim = Atmosphere { light: [0.2, 0.3, 1.4], ..Atmosphere::CLEAR };
    let fog = Atmosphere { fog_per_m: 0.7, fog: [0.7, 0.6, 0.5], ..dim };
    let soup = Atmosphere { fog_per_m: 60.0, ..fog };
    let cameras = [Atmosphere::CLEAR, dim, fog, soup]
        .map(|atmosphere| Camera { atmosphere, ..twins::camera(96, 64, 70.0) });
    check("atmosphere", &splats, &[], &cameras);
}

#[test]
fn antialiased_twins_and_objects_agree() {
    let small = |mut splats: Splats, antialiased: bool| {
        splats.scales_m.iter_mut().for_each(|scale_m| *scale_m *= 0.15);
        Splats { antialiased, ..splats }
    };
    let ball = |antialiased: bool| small(twins::ball(9000, 0.35, 0), antialiased);
    let objects = [(7, false), (8, true)]
        .map(|(id, antialiased)| RigidObject { id, splats: ball(antialiased) });
    let at = |x: f64| Some(Pose::new(DVec3::new(x, 0.0, 1.2), DQuat::IDENTITY));
    let placements = [at(-0.4), at(0.4)];
    let cameras = [twins::camera(97, 61, 70.0), twins::camera(160, 120, 110.0)];
    let render = |antialiased: bool| {
        let splats = small(twins::cloud(4000, 1, 23), antialiased);
        let scene = Scene { splats: &splats, objects: &objects };
        check(&format!("antialiased {antialiased}"), scene, &placements, &cameras);
        both(scene, &placements, &cameras)
    };
    let (Some((_, with)), Some((_, without))) = (render(true), render(false)) else { return };
    assert!(compare::psnr_db(&with[0].rgb, &without[0].rgb) < 45.0);
    // Of two objects with equal splats, the dimmed one hides less.
    let seen = |id: u16| without[0].ids.iter().filter(|&&seen| seen == id).count();
    assert!(seen(8) > 50 && seen(8) < seen(7), "{} and {}", seen(8), seen(7));
}

#[test]
fn both_lens_models_agree() {
    let splats = twins::cloud(4000, 0, 11);
    let lenses = [
        Distortion::BrownConrady { k1: -0.28, k2: 0.07, p1: 1e-3, p2: -2e-3, k3: 0.0 },
        Distortion::BrownConrady { k1: 0.1, k2: 0.01, p1: 0.0, p2: 0.0, k3: 0.002 },
        Distortion::KannalaBrandt { k1: -0.02, k2: 0.004, k3: -0.002, k4: 2e-4 },
    ];
    for lens in lenses {
        let mut camera = twins::camera(150, 110, 80.0);
        camera.intrinsics.distortion = lens;
        let expected = vizflyt_splat::render_reference(&splats, &[], &camera).expect("a camera");
        let Some(mut gpu) = crate::renderer(&splats) else { return };
        let mut image = [RgbdImage::default()];
        vizflyt_splat::Rasterizer::render(&mut gpu, &[], &[camera], &mut image).expect("a camera");
        assert_alike(&format!("{lens:?}"), &image[0], &expected);
    }
    // A fisheye of 150 degrees.
    let mut fisheye = twins::camera(128, 128, 90.0);
    fisheye.intrinsics.fx_px = 128.0 / 150f64.to_radians();
    fisheye.intrinsics.fy_px = fisheye.intrinsics.fx_px;
    fisheye.intrinsics.distortion =
        Distortion::KannalaBrandt { k1: 0.0, k2: 0.0, k3: 0.0, k4: 0.0 };
    let expected = vizflyt_splat::render_reference(&splats, &[], &fisheye).expect("a camera");
    let Some(mut gpu) = crate::renderer(&splats) else { return };
    let mut image = [RgbdImage::default()];
    vizflyt_splat::Rasterizer::render(&mut gpu, &[], &[fisheye], &mut image).expect("a camera");
    assert_alike("fisheye", &image[0], &expected);
}

#[test]
fn objects_agree_in_placement_and_id() {
    let splats = twins::cloud(2500, 2, 5);
    let objects = [
        RigidObject { id: 7, splats: twins::ball(300, 0.35, 0) },
        RigidObject { id: 65_535, splats: twins::ball(900, 0.2, 3) },
        RigidObject { id: 3, splats: twins::ball(100, 0.3, 1) },
    ];
    let scene = Scene { splats: &splats, objects: &objects };
    let at = |x: f64, y: f64, z: f64| {
        Some(Pose::new(DVec3::new(x, y, z), DQuat::from_rotation_x(x + y)))
    };
    let cameras = [twins::camera(120, 90, 80.0), twins::camera(64, 48, 60.0)];
    let placements = [at(-0.3, 0.0, 1.2), at(0.3, 0.1, 1.0), None];
    check("objects", scene, &placements, &cameras);
    let Some((_, actual)) = both(scene, &placements, &cameras) else { return };
    for id in [0, 7, 65_535] {
        assert!(actual[0].ids.iter().filter(|&&seen| seen == id).count() > 50, "id {id}");
    }
    assert!(actual[0].ids.iter().all(|&id| id != 3), "the absent object is visible");
}

#[test]
fn captured_scenes_agree() {
    let shared = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/scenes");
    for scene in ["room", "flowers_lod2"] {
        let file = shared.join(scene).with_extension("ply");
        if !file.exists() {
            println!("skipped: {scene}, for lack of {}", file.display());
            continue;
        }
        let splats = ply::read(&file).expect("a scene").splats;
        let cameras: Vec<Camera> = ["p0", "p1"]
            .map(|pose| {
                twins::oracle_camera(&shared.join(format!("ref/{scene}_{pose}_320x240.json")))
            })
            .into();
        check(scene, &splats, &[], &cameras);
        let antialiased = Splats { antialiased: true, ..splats };
        check(&format!("{scene}, antialiased"), &antialiased, &[], &cameras);
    }
}

#[test]
fn images_do_not_depend_on_earlier_images() {
    let splats = twins::cloud(3000, 0, 9);
    let Some(mut gpu) = crate::renderer(&splats) else { return };
    let camera = twins::camera(100, 80, 70.0);
    let small = Camera {
        intrinsics: Intrinsics::from_horizontal_fov(33, 7, 2.0),
        world_from_cam: Pose::new(DVec3::new(0.3, 0.1, -1.0), DQuat::from_rotation_y(0.4)),
        ..camera
    };
    let away = Camera {
        world_from_cam: Pose::new(
            DVec3::new(0.0, 0.0, -9.0),
            DQuat::from_rotation_y(std::f64::consts::PI),
        ),
        ..camera
    };
    let mut render_all = |cameras: &[Camera]| {
        let mut images = vec![RgbdImage::default(); cameras.len()];
        vizflyt_splat::Rasterizer::render(&mut gpu, &[], cameras, &mut images).expect("cameras");
        images
    };
    let first = render_all(&[camera]);
    let several = render_all(&[away, small, camera, small]);
    // Bit-identical.
    assert!(several[2] == first[0] && several[1] == several[3]);
    assert!(several[0].alpha.iter().all(|&alpha| alpha == 0.0));
    assert!(render_all(&[small])[0] == several[1]);
    assert!(render_all(&[]).is_empty());
}

#[test]
fn two_ticks_in_flight_give_the_same_images() {
    let splats = twins::cloud(3000, 0, 9);
    let Some(mut gpu) = crate::renderer(&splats) else { return };
    let cameras = [40u32, 50, 60, 70].map(|width| twins::camera(width, 45, 70.0));
    let render_one = |gpu: &mut vizflyt_splat::gpu::GpuRenderer, camera: Camera| {
        let mut image = [RgbdImage::default()];
        vizflyt_splat::Rasterizer::render(gpu, &[], &[camera], &mut image).expect("a camera");
        image
    };
    let alone = cameras.map(|camera| render_one(&mut gpu, camera));
    gpu.begin(&[], &cameras[..1]).expect("a camera");
    for i in 0..4 {
        if let Some(next) = cameras.get(i + 1) {
            gpu.begin(&[], &[*next]).expect("a camera");
        }
        let mut image = [RgbdImage::default()];
        gpu.finish(&mut image).expect("the device");
        assert!(image == alone[i], "image {i}");
    }
}
