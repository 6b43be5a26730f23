//! `vizflyt scene align`: photos of a walk through a lens with a rolling shutter, with poses in an arbitrary frame.
//! Printed tags in the room, or a motion capture that tracked the phone, determine the alignment of the scene.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use glam::{DQuat, DVec3};
use serde_json::{Value, json};
use vizflyt_arena::ArenaConfig;
use vizflyt_e2e::run_in;

/// Metres per unit of the capture.
const SCALE: f64 = 0.37;
const TRANSLATION_M: DVec3 = DVec3::new(0.8, -1.9, 0.6);

fn world_from_scene() -> DQuat {
    DQuat::from_scaled_axis(DVec3::new(1.3, -0.4, 0.9))
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

/// Returns the pose of an image. [m, world]
fn pose(image: &Value) -> (DVec3, DQuat) {
    let pose = &image["world_from_cam"];
    let p_m = DVec3::from_slice(&numbers(&pose["position_m"]));
    (p_m, DQuat::from_slice(&numbers(&pose["rotation_xyzw"])))
}

fn truth(capture: &Path) -> Value {
    serde_json::from_slice(&fs::read(capture.join("truth.json")).unwrap()).unwrap()
}

/// Writes nerfstudio's `transforms.json` next to the photos: the true poses in the capture's frame, for every `step`th
/// image.
fn write_transforms(capture: &Path, shaken_m: f64, step: usize) {
    let truth = truth(capture);
    let camera = &truth["camera"];
    let lens = &camera["distortion"];
    let back = world_from_scene().conjugate();
    let frames: Vec<Value> = truth["images"]
        .as_array()
        .unwrap()
        .iter()
        .step_by(step)
        .enumerate()
        .map(|(index, image)| {
            let (p_m, q) = pose(image);
            // Errors like those of structure from motion, different for each image.
            let phase = index as f64 * 2.4;
            let off_m = DVec3::new(phase.sin(), phase.cos(), (1.7 * phase).sin()) * shaken_m;
            let p = back * (p_m + off_m - TRANSLATION_M) / SCALE;
            // OpenGL's camera: y up, z backwards.
            let rotation = back * q * DQuat::from_rotation_x(std::f64::consts::PI);
            let m = glam::DMat3::from_quat(rotation);
            let row = |k: usize| json!([m.x_axis[k], m.y_axis[k], m.z_axis[k], p[k]]);
            json!({"file_path": image["file"], "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]})
        })
        .collect();
    let transforms = json!({
        "camera_model": "OPENCV",
        "w": camera["width_px"], "h": camera["height_px"],
        "fl_x": camera["fx_px"], "fl_y": camera["fy_px"],
        "cx": camera["cx_px"], "cy": camera["cy_px"],
        "k1": lens["k1"], "k2": lens["k2"], "p1": lens["p1"], "p2": lens["p2"],
        "frames": frames,
    });
    fs::write(capture.join("transforms.json"), transforms.to_string()).unwrap();
}

/// Asserts the accuracy of a metric twin: 0.3 %, 0.2 degrees, 2 cm.
fn check_place(arena: &str) {
    let scene = ArenaConfig::parse(arena).unwrap().scene;
    let scale = scene.metres_per_unit / SCALE - 1.0;
    let turn = scene.rotation() * world_from_scene().conjugate();
    let tilt_deg = (turn * DVec3::Z).angle_between(DVec3::Z).to_degrees();
    println!("scale {:.3} %, tilt {tilt_deg:.3} degrees", scale * 1e2);
    assert!(scale.abs() < 0.003, "{scale}");
    assert!(tilt_deg < 0.2, "{tilt_deg}");
    let p_m = DVec3::new(3.0, 0.0, 1.0);
    let p_scene = world_from_scene().conjugate() * (p_m - TRANSLATION_M) / SCALE;
    let found_m = scene.rotation() * p_scene * scene.metres_per_unit + scene.origin_m;
    println!("{:.1} mm off", found_m.distance(p_m) * 1e3);
    assert!(found_m.distance(p_m) < 0.02, "{found_m}");
}

#[test]
fn aligns_a_capture_by_tags() {
    let folder = tempfile::tempdir().unwrap();
    let home = folder.path();
    let (ok, said) = run_in(
        home,
        &[
            "scene",
            "generate",
            "room",
            "--seed",
            "3",
            "--tags",
            "--capture",
            "walk",
            "--frames",
            "40",
            "-o",
            "hall",
        ],
    );
    assert!(ok, "{said}");
    let capture = home.join("walk");
    write_transforms(&capture, 0.01, 1);
    let arena = home.join("hall/arena.toml");
    let before = fs::read_to_string(&arena).unwrap();
    fs::write(&arena, format!("# Ours.\n{before}")).unwrap();

    let align = ["scene", "align", "hall", "--tags", "walk/tags.toml", "--capture", "walk"];
    let (ok, said) = run_in(home, &align);
    println!("{said}");
    assert!(ok && said.contains("\ngo  "), "{said}");
    let text = fs::read_to_string(&arena).unwrap();
    assert!(text.starts_with("# Ours.\n"), "{text}");
    check_place(&text);

    // Inaccurate poses: the alignment is rejected with a reason, and nothing is written.
    write_transforms(&capture, 0.25, 1);
    let (ok, said) = run_in(home, &align);
    assert!(!ok, "{said}");
    assert!(["NO GO", "contradict", "no tag of"].iter().any(|word| said.contains(word)), "{said}");
    assert_eq!(fs::read_to_string(&arena).unwrap(), text);
}

/// A motion capture at the video's 30 Hz, with millimetres of noise, its own clock, and a marker next to the lens.
#[test]
fn aligns_a_capture_by_a_track_of_the_phone() {
    let folder = tempfile::tempdir().unwrap();
    let home = folder.path();
    let film = "--capture walk --frames 900 --seconds 30 --size 80x64 -o hall";
    let generate = "scene generate room --seed 3";
    let words: Vec<&str> = generate.split(' ').chain(film.split(' ')).collect();
    let (ok, said) = run_in(home, &words);
    assert!(ok, "{said}");
    let capture = home.join("walk");
    write_transforms(&capture, 0.005, 10);
    let truth = truth(&capture);
    let images = truth["images"].as_array().unwrap();
    let beside_m = DVec3::new(0.03, -0.09, -0.02);
    let offset_s = 1.237;
    let (mut track, mut mirrored, mut stamps) = (String::new(), String::new(), String::new());
    for (k, image) in images.iter().enumerate() {
        let (p_m, q) = pose(image);
        let noise = |axis: f64| (((k as f64 + axis) * 12.9898).sin() * 43758.547).fract() * 0.002;
        let p = p_m + q * beside_m + DVec3::new(noise(0.1), noise(0.4), noise(0.7));
        let stamp_ns = image["stamp_ns"].as_u64().unwrap();
        let at_s = stamp_ns as f64 * 1e-9 + offset_s;
        // TUM's columns.
        writeln!(track, "{at_s:.6} {:.5} {:.5} {:.5} 0 0 0 1", p.x, p.y, p.z).unwrap();
        writeln!(mirrored, "{at_s:.6} {:.5} {:.5} {:.5} 0 0 0 1", -p.x, p.y, p.z).unwrap();
        writeln!(stamps, "{},{stamp_ns}", image["file"].as_str().unwrap()).unwrap();
    }
    fs::write(home.join("track.txt"), track).unwrap();
    fs::write(home.join("mirrored.txt"), mirrored).unwrap();
    fs::write(home.join("times.csv"), stamps).unwrap();
    let arena = home.join("hall/arena.toml");
    let before = fs::read_to_string(&arena).unwrap();
    let beside = ["--tracked-at", "0.03,-0.092,-0.02"];
    let align = |track: &str, more: &[&str]| {
        let align = ["scene", "align", "hall", "--capture", "walk", "--track", track];
        run_in(home, &[&align[..], more].concat())
    };
    // The phone is carried level, so the height of the marker above the lens must be given (here with an error of 2
    // mm).
    let (ok, said) = align("track.txt", &["--times", "times.csv"]);
    assert!(!ok && said.contains("--tracked-at"), "{said}");
    let align = |track: &str, times: &[&str]| align(track, &[&beside[..], times].concat());
    // The times of the images are missing.
    let (ok, said) = align("track.txt", &[]);
    assert!(!ok && said.contains("--times"), "{said}");
    // The track of another walk.
    let (ok, said) = align("mirrored.txt", &["--times", "times.csv"]);
    assert!(!ok && (said.contains("is not the track") || said.contains("NO GO")), "{said}");
    // The right track, but a wrong frame rate of the images.
    let (ok, said) = align("track.txt", &["--rate", "60"]);
    assert!(!ok, "{said}");
    assert_eq!(fs::read_to_string(&arena).unwrap(), before);
    let (ok, said) = align("track.txt", &["--times", "times.csv"]);
    println!("{said}");
    assert!(ok && said.contains("\ngo  ") && said.contains("clocks      +1.2"), "{said}");
    check_place(&fs::read_to_string(&arena).unwrap());
}

#[test]
fn errors_name_the_remedy() {
    let folder = tempfile::tempdir().unwrap();
    let home = folder.path();
    fs::write(home.join("room.ply"), "ply\n").unwrap();
    let floor =
        ["--floor", "0,0,0", "--floor", "4,0,0", "--above", "0,0,1", "--length", "0,0,0:0,0,1=1"];
    let align =
        |arena: &str, more: &[&str]| run_in(home, &[&["scene", "align", arena], more].concat());
    for (arena, more, word) in [
        ("room.ply", &floor[..], "create one for the scene"),
        ("nowhere", &floor[..], "not an arena"),
        ("nowhere", &[][..], "not an arena"),
        ("nowhere", &["--track", "t.csv"][..], "--capture"),
        ("nowhere", &["--tags", "t.toml"][..], "--capture"),
        ("nowhere", &["--floor", "0,0"][..], "not a point"),
    ] {
        let (ok, said) = align(arena, more);
        assert!(!ok && said.contains(word), "{arena} {more:?}: {said}");
    }
}
