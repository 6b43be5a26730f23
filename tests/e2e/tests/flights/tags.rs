//! Sets up a lab with AprilTags by its commands, from printing to surveyed cameras, on images with known truth.

use std::path::Path;
use std::process::{Command, Output};

use glam::{DMat3, DQuat, DVec3};
use vizflyt_protocol::geometry::{Cam, Distortion, Intrinsics, Pose, World};
use vizflyt_tags::camera::{Mounting, TagCamera};
use vizflyt_tags::image::Gray;
use vizflyt_tags::layout::TagLayout;
use vizflyt_tags::synth::{Light, Placed, Renderer, SyntheticExposure};

fn tags(folder: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(vizflyt_e2e::vizflyt());
    command.current_dir(folder).arg("tags").args(args).output().expect("vizflyt runs")
}

fn succeeds(folder: &Path, args: &[&str]) -> String {
    let output = tags(folder, args);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{args:?}: {text}{error}");
    text
}

fn refused(folder: &Path, args: &[&str], parts: &[&str]) {
    let output = tags(folder, args);
    let error = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success(), "{args:?} was not refused");
    for part in parts {
        assert!(error.contains(part), "{args:?}: {error:?} lacks {part:?}");
    }
}

fn webcam() -> Intrinsics {
    Intrinsics {
        width_px: 640,
        height_px: 480,
        fx_px: 460.0,
        fy_px: 459.0,
        cx_px: 323.0,
        cy_px: 236.0,
        distortion: Distortion::BrownConrady {
            k1: -0.15,
            k2: 0.05,
            p1: 0.0008,
            p2: -0.001,
            k3: 0.0,
        },
    }
}

/// Returns reproducible numbers from -1 to 1.
fn wobble(i: u32, rate: f64) -> f64 {
    (f64::from(i) * rate).sin()
}

fn shot<'a>(
    placed: &'a [Placed<'a>],
    world_from_cam: Pose<World, Cam>,
    seed: u32,
) -> SyntheticExposure<'a> {
    SyntheticExposure {
        blur_px: 0.6,
        noise: 2.5,
        seed: seed.into(),
        light: Light { vignette: 0.2, ..Light::default() },
        ..SyntheticExposure::still(placed, world_from_cam)
    }
}

fn write_folder(folder: &Path, images: &[Gray]) {
    std::fs::create_dir(folder).unwrap();
    for (i, image) in images.iter().enumerate() {
        let mut bytes = format!("P5 {} {} 255\n", image.width_px(), image.height_px()).into_bytes();
        bytes.extend_from_slice(image.pixels());
        std::fs::write(folder.join(format!("{i}.pgm")), bytes).unwrap();
    }
}

/// Returns images with the board in all parts of the image, tilted in all directions.
fn calibration_images(board: &TagLayout, lens: &Renderer) -> Vec<Gray> {
    (0..40)
        .map(|i| {
            let depth_m = 0.36 + 0.06 * wobble(i, 2.3);
            let place = |n: u32| f64::from(n) - 1.0;
            let side = DVec3::new(place(i % 3) * 0.42, place(i / 3 % 3) * 0.30, 1.0);
            let tilt = DVec3::new(wobble(i, 1.7), wobble(i, 2.9), 0.4 * wobble(i, 0.7)) * 0.6;
            let facing = DQuat::from_rotation_x(std::f64::consts::PI);
            let pose = Pose::new(side * depth_m, DQuat::from_scaled_axis(tilt) * facing);
            lens.render(&shot(&[Placed::anywhere(board, pose)], Pose::IDENTITY, i))
        })
        .collect()
}

fn towards(from_m: DVec3, to_m: DVec3) -> Pose<World, Cam> {
    let z = (to_m - from_m).normalize();
    let x = z.cross(DVec3::new(0.0, 1.0, 0.2)).normalize();
    Pose::new(from_m, DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z)).normalize())
}

#[test]
fn sets_up_a_lab_from_printing_to_surveyed_cameras() {
    let home = tempfile::tempdir().unwrap();
    let home = home.path();
    let lens = Renderer::new(webcam());

    // Print.
    succeeds(home, &["print", "board", "-o", "board.pdf"]);
    let printed =
        succeeds(home, &["print", "mat", "-o", "mat.pdf", "--columns", "3", "--rows", "3"]);
    assert!(printed.contains("mat.pdf: 4 sheets of A4, 9 tags"), "{printed}");
    succeeds(home, &["print", "cube", "-o", "cube.pdf", "--paper", "letter"]);
    for name in ["board", "mat", "cube"] {
        let pdf = std::fs::read(home.join(format!("{name}.pdf"))).unwrap();
        assert!(pdf.starts_with(b"%PDF-"), "{name}");
    }

    // Calibrate.
    let board = TagLayout::read(&home.join("board.toml")).unwrap();
    let images = calibration_images(&board, &lens);
    write_folder(&home.join("few"), &images[..6]);
    let few = ["calibrate", "few", "--board", "board.toml", "-o", "left.toml"];
    refused(home, &few, &["no camera file was written", "more views"]);
    assert!(!home.join("left.toml").exists());
    write_folder(&home.join("images"), &images);
    let all = ["calibrate", "images", "--board", "board.toml", "-o", "left.toml"];
    let printed = succeeds(home, &all);
    assert!(printed.contains("held back"), "{printed}");
    let left = TagCamera::read(&home.join("left.toml")).unwrap();
    assert!((left.intrinsics.fx_px / webcam().fx_px - 1.0).abs() < 3e-3, "{left:?}");
    assert!(left.calibration.unwrap().held_out_rms_px < 0.3, "{left:?}");
    assert_eq!(left.name, "left");

    // Survey the mat, glued slightly inaccurately, from a stream of images.
    let mut glued = TagLayout::read(&home.join("mat.toml")).unwrap();
    for (i, tag) in (0..).zip(&mut glued.tags).skip(1) {
        tag.position_m += DVec3::new(wobble(i, 3.1), wobble(i, 5.3), 0.0) * 0.004;
        tag.rotation_xyzw = DQuat::from_rotation_z(0.02 * wobble(i, 1.9)) * tag.rotation_xyzw;
    }
    let placed = [Placed::fixed(&glued)];
    let mut stream = b"YUV4MPEG2 W640 H480 F10:1 Cmono\n".to_vec();
    for i in 0..16 {
        let over = DVec3::new(0.12 * wobble(i, 1.3), 0.12 * wobble(i, 2.1), 0.36);
        let camera = towards(over, DVec3::new(0.08 * wobble(i, 0.7), 0.08 * wobble(i, 3.7), 0.0));
        stream.extend_from_slice(
            format!("FRAME XSTAMP_NS={}\n", u64::from(i) * 100_000_000).as_bytes(),
        );
        stream.extend_from_slice(lens.render(&shot(&placed, camera, i)).pixels());
    }
    std::fs::write(home.join("walk.y4m"), stream).unwrap();
    let survey =
        ["survey", "mat", "| cat walk.y4m", "--camera", "left.toml", "--layout", "mat.toml"];
    let printed = succeeds(home, &[&survey[..], &["-o", "room.toml", "--anchor", "100"]].concat());
    assert!(printed.contains("9 tags from 16 images"), "{printed}");
    let room = TagLayout::read(&home.join("room.toml")).unwrap();
    for tag in &room.tags {
        let off_m = tag.position_m.distance(glued.find(tag.family, tag.id).unwrap().position_m);
        assert!(off_m < 0.002, "tag {} is {:.1} mm off: {printed}", tag.id, 1e3 * off_m);
    }

    // Survey two fixed cameras with that mat.
    let right = TagCamera { name: "right".into(), ..left };
    right.write(&home.join("right.toml")).unwrap();
    let truth = [DVec3::new(-0.5, -0.3, 0.6), DVec3::new(0.45, 0.35, 0.7)]
        .map(|from| towards(from, DVec3::ZERO));
    for (name, camera) in ["left", "right"].into_iter().zip(truth) {
        let images: Vec<Gray> =
            (0..3).map(|i| lens.render(&shot(&placed, camera, 100 + i))).collect();
        write_folder(&home.join(name), &images);
    }
    let no_source = ["survey", "cameras", "left.toml", "--mat", "room.toml"];
    refused(home, &no_source, &["left.toml", "no source in the file"]);
    let files = ["left.toml=left", "right.toml=right"];
    let printed = succeeds(home, &["survey", "cameras", files[0], files[1], "--mat", "room.toml"]);
    for (name, truth) in ["left", "right"].into_iter().zip(truth) {
        let camera = TagCamera::read(&home.join(format!("{name}.toml"))).unwrap();
        let Mounting::World(found) = camera.mounting else { panic!("{name} was not placed") };
        let off_m = found.translation_m.distance(truth.translation_m);
        let off_rad = found.rotation.angle_between(truth.rotation);
        assert!(off_m < 0.01 && off_rad < 0.01, "{name}: {off_m} m, {off_rad} rad: {printed}");
    }
    // A cube's layout is not a mat.
    let wrong = ["survey", "cameras", files[0], "--mat", "cube.toml"];
    refused(home, &wrong, &["cube.toml", "on the vehicle", "print mat"]);
}
