//! `vizflyt scene capture` with given poses: photos of a walk, a COLMAP model of them in an arbitrary frame, tags in
//! the room. The result is a metric twin that can be flown, or advice what to film again. `tests/capture/run` tests
//! structure from motion itself.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::time::SystemTime;

use glam::{DQuat, DVec2, DVec3};
use serde_json::Value;
use vizflyt_arena::ArenaConfig;
use vizflyt_e2e::run_in;
use vizflyt_protocol::geometry::{Cam, Distortion, Intrinsics, Pose, World};

/// Metres per unit of the model.
const SCALE: f64 = 0.37;
const TRANSLATION_M: DVec3 = DVec3::new(0.8, -1.9, 0.6);

fn world_from_scene() -> DQuat {
    DQuat::from_scaled_axis(DVec3::new(1.3, -0.4, 0.9))
}

fn numbers<const N: usize>(value: &Value) -> [f64; N] {
    let numbers: Vec<f64> = value.as_array().unwrap().iter().map(|n| n.as_f64().unwrap()).collect();
    numbers.try_into().unwrap()
}

struct Truth {
    lens: Intrinsics,
    images: Vec<(String, Pose<World, Cam>)>,
}

fn truth(capture: &Path) -> Truth {
    let truth: Value =
        serde_json::from_slice(&fs::read(capture.join("truth.json")).unwrap()).unwrap();
    let camera = &truth["camera"];
    let number = |key: &str| camera[key].as_f64().unwrap();
    let bend = |key: &str| camera["distortion"][key].as_f64().unwrap();
    let lens = Intrinsics {
        width_px: number("width_px") as u32,
        height_px: number("height_px") as u32,
        fx_px: number("fx_px"),
        fy_px: number("fy_px"),
        cx_px: number("cx_px"),
        cy_px: number("cy_px"),
        distortion: Distortion::BrownConrady {
            k1: bend("k1"),
            k2: bend("k2"),
            p1: bend("p1"),
            p2: bend("p2"),
            k3: 0.0,
        },
    };
    let images = truth["images"].as_array().unwrap().iter().map(|image| {
        let pose = &image["world_from_cam"];
        let position_m = DVec3::from_array(numbers(&pose["position_m"]));
        let rotation = DQuat::from_array(numbers(&pose["rotation_xyzw"]));
        (image["file"].as_str().unwrap().to_owned(), Pose::new(position_m, rotation))
    });
    Truth { lens, images: images.collect() }
}

/// Returns a pseudo-random number, -1 to 1.
fn noise(n: usize) -> f64 {
    (((n as f64 * 12.9898).sin() * 43_758.545_3).fract()).clamp(-1.0, 1.0)
}

/// Writes a COLMAP model: the true poses displaced by `moved`, in an arbitrary frame, and random points in the air that
/// the images see with 0.3 px noise.
fn write_model(
    folder: &Path,
    truth: &Truth,
    moved: impl Fn(usize) -> DVec3,
    keep: impl Fn(usize) -> bool,
) {
    let back = world_from_scene().conjugate();
    let to_scene = |p_m: DVec3| back * (p_m - TRANSLATION_M) / SCALE;
    let k = &truth.lens;
    let Distortion::BrownConrady { k1, k2, p1, p2, .. } = k.distortion else { panic!() };
    let cameras = format!(
        "1 OPENCV {} {} {} {} {} {} {k1} {k2} {p1} {p2}\n",
        k.width_px, k.height_px, k.fx_px, k.fy_px, k.cx_px, k.cy_px
    );
    let points_m: Vec<DVec3> = (0..6000)
        .map(|i| {
            DVec3::new(
                6.0 + 11.0 * noise(3 * i),
                7.0 * noise(3 * i + 1),
                1.5 + 1.5 * noise(3 * i + 2),
            )
        })
        .collect();
    let mut images = String::new();
    let mut tracks = vec![String::new(); points_m.len()];
    for (number, (name, pose)) in truth.images.iter().enumerate().filter(|(n, _)| keep(*n)) {
        let cam_from_scene = Pose::<World, Cam>::new(
            to_scene(pose.translation_m + moved(number)),
            (back * pose.rotation).normalize(),
        )
        .inverse();
        let ([x, y, z, w], t) = (cam_from_scene.rotation.to_array(), cam_from_scene.translation_m);
        writeln!(images, "{} {w} {x} {y} {z} {} {} {} 1 {name}", number + 1, t.x, t.y, t.z)
            .unwrap();
        let mut index = 0;
        for (id, &p_m) in points_m.iter().enumerate() {
            // The room deforms with the poses, as in an erroneous structure from motion.
            let p_cam = pose.inverse().transform_point(p_m);
            let far = !(0.3..7.0).contains(&p_cam.z);
            let Some(pixel) = k.project(p_cam).filter(|_| !far) else { continue };
            let size = DVec2::new(f64::from(k.width_px), f64::from(k.height_px));
            if pixel.cmplt(DVec2::ZERO).any() || pixel.cmpgt(size).any() {
                continue;
            }
            let seed = 2 * (number * points_m.len() + id);
            let pixel = pixel + 0.3 * DVec2::new(noise(seed), noise(seed + 1));
            write!(images, "{} {} {id} ", pixel.x, pixel.y).unwrap();
            write!(tracks[id], " {} {index}", number + 1).unwrap();
            index += 1;
        }
        images.push('\n');
    }
    let mut points = String::new();
    for (id, (&p_m, track)) in points_m.iter().zip(&tracks).enumerate() {
        let p = to_scene(p_m);
        writeln!(points, "{id} {} {} {} 90 90 90 0.3{track}", p.x, p.y, p.z).unwrap();
    }
    let place = folder.join("sparse/0");
    fs::create_dir_all(&place).unwrap();
    for (name, text) in [("cameras", cameras), ("images", images), ("points3D", points)] {
        fs::write(place.join(format!("{name}.txt")), text).unwrap();
    }
}

fn modified(path: &Path) -> SystemTime {
    fs::metadata(path).unwrap().modified().unwrap()
}

/// Runs the program with the words of two texts; returns whether it succeeded, and its output.
fn run_words(home: &Path, words: &str, more: &str) -> (bool, String) {
    run_in(home, &words.split_whitespace().chain(more.split_whitespace()).collect::<Vec<_>>())
}

/// Films the generated hall into `walk`.
fn film(home: &Path, more: &str) {
    let (ok, said) = run_words(home, "scene generate room --seed 3 --capture walk", more);
    assert!(ok, "{said}");
}

#[test]
fn photos_with_poses_become_a_metric_twin() {
    let folder = tempfile::tempdir().unwrap();
    let home = folder.path();
    film(home, "--tags --frames 60");
    let truth = truth(&home.join("walk"));
    write_model(&home.join("model"), &truth, |_| DVec3::ZERO, |_| true);
    let capture = |more: &str| {
        let words = "scene capture walk -o hall --poses model --tags walk/tags.toml --camera walk/camera.toml --steps 40 \
                     --splats 4000 --width 80";
        run_words(home, words, more)
    };
    // So little training leaves floaters at the start position; this test does not check whether the twin can be flown.
    let (_, said) = capture("");
    println!("{said}");
    let record: Value =
        serde_json::from_slice(&fs::read(home.join("hall/capture.json")).unwrap()).unwrap();
    assert_eq!(record["metric"]["fit_to_fly"], true, "{said}");
    let way = record["metric"]["way"].as_array().unwrap();
    assert_eq!(way.len(), 60);
    let mut squares = 0.0;
    for placed in way {
        let (_, pose) =
            truth.images.iter().find(|(name, _)| placed["name"] == name.as_str()).unwrap();
        let position_m = DVec3::from_array(numbers(&placed["position_m"]));
        squares += position_m.distance_squared(pose.translation_m);
    }
    let off_m = (squares / way.len() as f64).sqrt();
    println!("off by {:.1} mm", off_m * 1e3);
    // Maximum error of a metric twin, in the room's own frame.
    assert!(off_m < 0.02, "{off_m}");
    let arena =
        ArenaConfig::parse(&fs::read_to_string(home.join("hall/arena.toml")).unwrap()).unwrap();
    // The walk must be within the fence, and the start on the walk.
    let fence = &arena.geofence;
    let is_inside = |p: DVec3| p.cmpgt(fence.min_m).all() && p.cmplt(fence.max_m).all();
    assert!(truth.images.iter().all(|(_, pose)| is_inside(pose.translation_m)), "{fence:?}");
    let to_start =
        |pose: &Pose<World, Cam>| (pose.translation_m - arena.spawn.position_m).truncate().length();
    let nearest_m = truth.images.iter().map(|(_, pose)| to_start(pose)).fold(f64::MAX, f64::min);
    assert!(nearest_m < 0.05, "{nearest_m}");
    let page = fs::read_to_string(home.join("hall/report.html")).unwrap();
    assert!(!page.contains("It is refused.") && page.contains("<svg"));
    assert!(page.matches("data:image/jpeg;base64,").count() >= 8);

    // A second run repeats only the requested stages.
    let metric = home.join("hall/stages/metric.json");
    let trained = home.join("hall/stages/train.json");
    let before = (modified(&metric), modified(&trained));
    let (_, said) = capture("");
    assert_eq!(said.matches("(kept)").count(), 6, "{said}");
    assert_eq!((modified(&metric), modified(&trained)), before);
    let (_, said) = capture("--from train");
    assert_eq!(said.matches("(kept)").count(), 4, "{said}");
    assert_eq!(modified(&metric), before.0);
    assert_ne!(modified(&trained), before.1);

    // A model with its second half displaced by 3 m, and some images without poses: rejected, and the arena is removed.
    let half = |n: usize| if n >= 30 { DVec3::new(3.0, 1.0, 0.0) } else { DVec3::ZERO };
    write_model(&home.join("model"), &truth, half, |n| !(10..20).contains(&n));
    let (ok, said) = capture("");
    println!("{said}");
    assert!(!ok && said.contains("REFUSED"), "{said}");
    assert!(!home.join("hall/arena.toml").exists());
    let page = fs::read_to_string(home.join("hall/report.html")).unwrap();
    assert!(page.contains("It is refused."), "{page}");
}

/// Photos without tags, and a motion capture at 15 Hz with a marker next to the lens, on its own clock.
#[test]
fn track_determines_scale_and_position_of_photos() {
    let folder = tempfile::tempdir().unwrap();
    let home = folder.path();
    film(home, "--frames 120 --seconds 8 --size 80x64");
    let truth = truth(&home.join("walk"));
    write_model(&home.join("model"), &truth, |_| DVec3::ZERO, |_| true);
    let beside_m = DVec3::new(0.03, -0.09, -0.02);
    let (mut track, mut times) = (String::new(), String::new());
    for (n, (name, pose)) in truth.images.iter().enumerate() {
        let p = pose.transform_point(beside_m) + 0.001 * DVec3::splat(noise(n));
        writeln!(track, "{:.4} {:.5} {:.5} {:.5} 0 0 0 1", 7.25 + n as f64 / 15.0, p.x, p.y, p.z)
            .unwrap();
        writeln!(times, "{name},{}", n as u64 * 1_000_000_000 / 15).unwrap();
    }
    fs::write(home.join("track.txt"), track).unwrap();
    fs::write(home.join("times.csv"), times).unwrap();
    let capture = |more: &str| {
        let words = "scene capture walk -o hall --poses model --track track.txt --steps 1 --splats 1000 --width 40";
        run_words(home, words, more)
    };
    let (ok, said) = capture("--tracked-at 0.03,-0.09,-0.02");
    assert!(!ok && said.contains("--times"), "{said}");
    let (_, said) = capture("--tracked-at 0.03,-0.09,-0.02 --times times.csv");
    println!("{said}");
    assert!(said.contains("by the motion capture's track"), "{said}");
    let record: Value =
        serde_json::from_slice(&fs::read(home.join("hall/capture.json")).unwrap()).unwrap();
    assert_eq!(record["metric"]["scale_is_guessed"], false);
    for placed in record["metric"]["way"].as_array().unwrap() {
        let (_, pose) =
            truth.images.iter().find(|(name, _)| placed["name"] == name.as_str()).unwrap();
        let off_m = DVec3::from_array(numbers(&placed["position_m"])).distance(pose.translation_m);
        assert!(off_m < 0.03, "{placed} is {off_m} m off");
    }
}

#[test]
fn errors_name_the_remedy() {
    let folder = tempfile::tempdir().unwrap();
    let home = folder.path();
    fs::create_dir(home.join("empty")).unwrap();
    fs::write(home.join("hall.mp4"), "no video").unwrap();
    fs::create_dir(home.join("thesis")).unwrap();
    fs::write(home.join("thesis/thesis.tex"), "x").unwrap();
    film(home, "--frames 3 --size 64x64");
    for (args, says) in [
        (&["nothing.mp4", "-o", "out"][..], "neither a video nor a folder"),
        (&["empty", "-o", "out"], "no photos"),
        (&["hall.mp4", "-o", "out"], "cannot read hall.mp4 as a video"),
        (&["walk", "-o", "thesis", "--poses", "empty"], "another folder"),
        (&["walk", "-o", "out", "--poses", "empty"], "contains no poses"),
        (&["walk", "-o", "out", "--python", "no-python"], "pip install pycolmap"),
        (&["walk", "-o", "out", "--length", "3=2"], "3,8=4.52"),
        (&["walk", "-o", "out", "--tags", "a.toml", "--tag-size", "0.2"], "cannot be used with"),
        (&["walk", "-o", "out", "--tags", "a.toml"], "a.toml"),
        (&["walk", "-o", "out", "--times", "a.csv"], "--track"),
    ] {
        let (ok, said) = run_in(home, &[&["scene", "capture"], args].concat());
        assert!(!ok && said.contains(says), "{args:?}: {said}");
        let report = home.join("out/report.html");
        // Wrong arguments leave no report; a failed stage does.
        if report.exists() {
            let page = fs::read_to_string(&report).unwrap();
            assert!(
                page.contains("It stopped ") && page.contains("What to do"),
                "{args:?}: {page}"
            );
            fs::remove_file(report).unwrap();
        } else {
            assert!(!STOPS.iter().any(|stop| says.contains(stop)), "{args:?} left no report");
        }
    }
}

/// Messages of failed stages or of missing programs.
const STOPS: [&str; 3] = ["as a video", "contains no poses", "pip install"];

/// Failures of installed programs as users have them.
#[test]
fn failed_stage_leaves_a_report() {
    let folder = tempfile::tempdir().unwrap();
    let home = folder.path();
    film(home, "--frames 8 --size 64x64");
    // A Python with a pycolmap that places no image.
    let python = home.join("python");
    fs::write(&python, "#!/bin/sh\ncase \"$*\" in *version*) echo 4.2.1;; esac\n").unwrap();
    fs::set_permissions(&python, std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
    let capture = |more: &[&str]| {
        let start = ["scene", "capture", "walk", "-o", "hall"];
        let (ok, said) = run_in(home, &[&start[..], more].concat());
        assert!(!ok, "{said}");
        let record: Value =
            serde_json::from_slice(&fs::read(home.join("hall/capture.json")).unwrap()).unwrap();
        assert_eq!(record["fit_to_fly"], false);
        (said, record, fs::read_to_string(home.join("hall/report.html")).unwrap())
    };
    let (said, record, page) = capture(&["--python", python.to_str().unwrap()]);
    assert!(said.contains("cannot place any picture"), "{said}");
    assert_eq!(record["failure"]["stage"], "poses");
    assert!(
        record["failure"]["what"].as_str().unwrap().contains("cannot place any picture"),
        "{record}"
    );
    assert_eq!(record["pictures"]["pictures"].as_array().unwrap().len(), 8);
    assert!(
        page.contains("It stopped in its stage poses.") && page.contains("film slowly"),
        "{page}"
    );
    assert!(page.contains("8 of 64 x 64 px"), "what is known is there: {page}");

    // A folder without poses.
    fs::create_dir(home.join("other")).unwrap();
    let (_, record, page) = capture(&["--poses", "other"]);
    assert_eq!(record["failure"]["stage"], "poses");
    assert!(page.contains("contains no poses"), "{page}");
}
