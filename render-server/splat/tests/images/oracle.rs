//! Comparison with an independent float64 oracle.
//!
//! `tests/data` contains small scenes with the images of the oracle, created by `make_references.py` there. If the
//! repository has a neighbour `../shared/scenes`, its captured scenes are compared too.
//!
//! Limits: 60 dB of RGB and alpha, depths within 1e-3 on 99.5 % of pixels. Single pixels flip at the thresholds of
//! f32 (alpha 1/255, transmittance 1e-4 and 1/2), so maxima are not compared.

use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat, DVec3};
use serde::Deserialize;
use vizflyt_protocol::geometry::{Distortion, Intrinsics, Pose};
use vizflyt_splat::{Atmosphere, Camera, RgbdImage, Scene, Splats, ply, render_reference};

use crate::renderers::{self, Make};
use crate::{compare, npz};

/// Camera in the oracle's format: pixel centres at +0.5, `w2c` is the row-major world-to-camera matrix.
#[derive(Deserialize)]
struct OracleCamera {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    w: u32,
    h: u32,
    bg: [f32; 3],
    w2c: [[f64; 4]; 4],
}

fn camera(path: &Path) -> Camera {
    let text = std::fs::read_to_string(path).expect("a camera file");
    let c: OracleCamera = serde_json::from_str(&text).expect("a camera");
    let row = |i: usize| DVec3::new(c.w2c[i][0], c.w2c[i][1], c.w2c[i][2]);
    let rotation = DMat3::from_cols(row(0), row(1), row(2));
    let translation = DVec3::new(c.w2c[0][3], c.w2c[1][3], c.w2c[2][3]);
    Camera {
        intrinsics: Intrinsics {
            width_px: c.w,
            height_px: c.h,
            fx_px: c.fx,
            fy_px: c.fy,
            cx_px: c.cx,
            cy_px: c.cy,
            distortion: Distortion::None,
        },
        // Rows of world-to-camera are columns of camera-to-world.
        world_from_cam: Pose::new(-(rotation * translation), DQuat::from_mat3(&rotation)),
        near_m: 0.01,
        background: c.bg,
        atmosphere: Atmosphere::CLEAR,
    }
}

fn oracle_image(path: &Path, camera: &Camera) -> RgbdImage {
    let mut arrays = npz::read(path);
    let mut take = |name: &str| arrays.remove(name).expect(name);
    RgbdImage {
        width_px: camera.intrinsics.width_px,
        height_px: camera.intrinsics.height_px,
        rgb: take("rgb"),
        alpha: take("alpha"),
        depth_expected_m: take("depth"),
        depth_median_m: take("depth_median"),
        ids: vec![0; camera.intrinsics.pixels()],
    }
}

fn check(name: &str, renderer: &str, actual: &RgbdImage, expected: &RgbdImage) {
    compare::assert_clean(actual);
    let d = compare::difference(actual, expected);
    println!(
        "{name}, {renderer}: rgb {:.1} dB, alpha {:.1} dB; off by 1e-3: expected depth {:.3} %, \
         median depth {:.3} %",
        d.rgb_db,
        d.alpha_db,
        d.expected_off * 100.0,
        d.median_off * 100.0
    );
    assert!(d.rgb_db >= 60.0 && d.alpha_db >= 60.0, "{name}, {renderer}: {d:?}");
    assert!(d.expected_off <= 0.005 && d.median_off <= 0.005, "{name}, {renderer}: {d:?}");
}

/// Compares renderers with the references `cases`: (camera file, image file).
fn check_scene(make: Make<'_>, splats: &Splats, cases: &[(PathBuf, PathBuf)]) {
    assert!(!cases.is_empty(), "no reference images found");
    let mut renderers = make(Scene::from(splats));
    for (camera_file, image_file) in cases {
        let camera = camera(camera_file);
        let expected = oracle_image(image_file, &camera);
        let name = image_file.file_stem().unwrap_or_default().to_string_lossy();
        for renderer in &mut renderers {
            let mut image = [RgbdImage::default()];
            renderer.render(&[], &[camera], &mut image).expect("a valid camera");
            check(&name, &renderer.name(), &image[0], &expected);
        }
    }
}

/// Checks generated scenes of every degree, rendered as if they had been trained with anti-aliasing.
pub(crate) fn check_antialiased_scenes(make: Make<'_>) {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data");
    for degree in 0..=3 {
        let loaded = ply::read(data.join(format!("sh{degree}.ply"))).expect("a scene");
        let splats = Splats { antialiased: true, ..loaded.splats };
        let view = |end: &str| data.join(format!("sh{degree}_a{end}"));
        check_scene(make, &splats, &[(view(".json"), view("_antialiased.npz"))]);
        // It must differ from the classic image.
        let expected = |end: &str| oracle_image(&view(end), &camera(&view(".json")));
        let d = compare::difference(&expected(".npz"), &expected("_antialiased.npz"));
        assert!(d.rgb_db < 40.0 && d.alpha_db < 40.0, "degree {degree}: {d:?}");
    }
}

/// Checks generated scenes of every degree.
pub(crate) fn check_generated_scenes(make: Make<'_>) {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data");
    for degree in 0..=3u8 {
        let loaded = ply::read(data.join(format!("sh{degree}.ply"))).expect("a scene");
        assert_eq!(loaded.splats.sh_degree, degree);
        let cases = ["a", "b"].map(|camera| {
            let view = data.join(format!("sh{degree}_{camera}"));
            (view.with_extension("json"), view.with_extension("npz"))
        });
        check_scene(make, &loaded.splats, &cases);
    }
}

/// Checks captured scenes, if they are present.
pub(crate) fn check_captured_scenes(make: Make<'_>) {
    let shared = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/scenes");
    for scene in ["room", "flowers_lod2"] {
        let file = shared.join(scene).with_extension("ply");
        if !file.exists() {
            println!("skipped: {scene} against the oracle, for lack of {}", file.display());
            continue;
        }
        let splats = ply::read(&file).expect("a scene").splats;
        let mut cases: Vec<(PathBuf, PathBuf)> = std::fs::read_dir(shared.join("ref"))
            .expect("a folder of references")
            .map(|entry| entry.expect("an entry").path())
            .filter(|path| {
                let name = path.file_name().unwrap_or_default().to_string_lossy();
                name.starts_with(scene) && name.ends_with(".npz")
            })
            .map(|image| (image.with_extension("json"), image))
            .collect();
        cases.sort();
        check_scene(make, &splats, &cases);
    }
}

#[test]
fn generated_scenes_of_every_degree_match_the_oracle() {
    check_generated_scenes(&renderers::every);
}

#[test]
fn antialiased_scenes_match_the_oracle() {
    check_antialiased_scenes(&renderers::every);
}

/// [`check_antialiased_scenes`] compares the reference renderer with the oracle; this test compares all others with
/// it.
#[test]
fn antialiased_captured_scenes_match_the_reference() {
    let shared = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/scenes");
    for scene in ["room", "flowers_lod2"] {
        let file = shared.join(scene).with_extension("ply");
        if !file.exists() {
            println!("skipped: {scene} with anti-aliasing, for lack of {}", file.display());
            continue;
        }
        let splats = Splats { antialiased: true, ..ply::read(&file).expect("a scene").splats };
        let camera = camera(&shared.join(format!("ref/{scene}_p0_320x240.json")));
        let expected = render_reference(&splats, &[], &camera).expect("a valid camera");
        for mut renderer in renderers::cpus(Scene::from(&splats)) {
            let mut image = [RgbdImage::default()];
            renderer.render(&[], &[camera], &mut image).expect("a valid camera");
            check(&format!("{scene}, antialiased"), &renderer.name(), &image[0], &expected);
        }
    }
}

#[test]
fn captured_scenes_match_the_oracle() {
    check_captured_scenes(&renderers::every);
}
