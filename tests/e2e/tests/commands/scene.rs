//! `vizflyt scene` and `vizflyt bench` as used by people and scripts.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::{Value, json};
use vizflyt_e2e::{check_refused, good, root, vizflyt};
use vizflyt_fixtures::WebSocket;

/// A generated scene and a camera in it, in a temporary folder.
struct Rig(tempfile::TempDir);

impl Rig {
    fn new() -> Self {
        let rig = Self(tempfile::tempdir().unwrap());
        good(&["scene", "generate", "race", "-o", &rig.at("race")]);
        // 1.2 m above the world's origin, looking along x.
        let w2c = json!([[0, -1, 0, 0], [0, 0, -1, 1.2], [1, 0, 0, 0], [0, 0, 0, 1]]);
        let camera = json!({"fx": 80, "fy": 80, "cx": 80, "cy": 60, "w": 160, "h": 120,
                            "w2c": w2c, "bg": [0.5, 0, 0]});
        rig.write("cam.json", &camera.to_string());
        rig
    }

    fn at(&self, name: &str) -> String {
        self.0.path().join(name).to_str().unwrap().to_owned()
    }

    fn write(&self, name: &str, text: &str) {
        fs::write(self.at(name), text).unwrap();
    }
}

/// An array of f32 or u16 in numpy's format.
struct Array {
    shape: Vec<usize>,
    values: Vec<f32>,
}

fn array(bytes: &[u8]) -> Option<Array> {
    assert_eq!(&bytes[..8], b"\x93NUMPY\x01\x00");
    let head = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let text = String::from_utf8_lossy(&bytes[10..head]);
    let shape = text.split("'shape': (").nth(1)?.split(')').next()?;
    let shape = shape.split(',').filter_map(|side| side.trim().parse().ok()).collect();
    let body = &bytes[head..];
    let values = if text.contains("'<f4'") {
        body.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
    } else if text.contains("'<u2'") {
        body.chunks_exact(2).map(|b| f32::from(u16::from_le_bytes([b[0], b[1]]))).collect()
    } else {
        return None;
    };
    Some(Array { shape, values })
}

fn saved(folder: &str, name: &str) -> Array {
    array(&fs::read(Path::new(folder).join(name)).unwrap()).expect("f32 or u16")
}

/// Returns width, height, bits per channel and colour type of a PNG (its IHDR).
fn png_head(path: &Path) -> (u32, u32, u8, u8) {
    let bytes = fs::read(path).unwrap();
    assert_eq!(&bytes[..8], b"\x89PNG\r\n\x1a\n");
    let side = |at: usize| u32::from_be_bytes(bytes[at..at + 4].try_into().unwrap());
    (side(16), side(20), bytes[24], bytes[25])
}

#[test]
fn obstacles_are_baked_once_and_cached() {
    let rig = Rig::new();
    let bake = |more: &[&str]| {
        let output = Command::new(vizflyt())
            .args(["scene", "bake", &rig.at("race"), "--json"])
            .args(more)
            .env("XDG_CACHE_HOME", rig.at("cache"))
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice::<Value>(&output.stdout).unwrap()
    };
    let first = bake(&[]);
    assert_eq!(first["kept"], json!(false));
    assert!(first["occupied"].as_u64().unwrap() > 1000, "{first}");
    let file = first["file"].as_str().unwrap();
    assert!(file.starts_with(&rig.at("cache/vizflyt/obstacles")), "{file}");
    assert_eq!(bake(&[])["kept"], json!(true));
    assert_eq!(bake(&["--force"])["kept"], json!(false));
    let coarse = bake(&["--voxel", "0.1"]);
    assert!(coarse["kept"] == json!(false) && coarse["voxel_m"] == json!(0.1), "{coarse}");
    check_refused(&["scene", "bake", &rig.at("race"), "--voxel", "9"], &["occupancy.voxel_m = 9"]);
}

#[test]
fn writes_images_as_png_and_as_arrays() {
    let rig = Rig::new();
    let printed = good(&[
        "scene",
        "render",
        &rig.at("race"),
        "--camera",
        &rig.at("cam.json"),
        "--out",
        &rig.at("a"),
    ]);
    assert!(printed.contains("renderer") && printed.contains("160x120 in "), "{printed}");
    let folder = PathBuf::from(rig.at("a"));
    assert_eq!(png_head(&folder.join("rgb.png")), (160, 120, 8, 2));
    assert_eq!(png_head(&folder.join("depth_mm.png")), (160, 120, 16, 0));

    fs::copy(rig.at("cam.json"), rig.at("other.json")).unwrap();
    good(&[
        "scene",
        "render",
        &rig.at("race/arena.toml"),
        "--camera",
        &rig.at("cam.json"),
        "--camera",
        &rig.at("other.json"),
        "--format",
        "npy",
        "--out",
        &rig.at("b"),
        "--renderer",
        "cpu",
    ]);
    let (one, two) = (rig.at("b/cam"), rig.at("b/other"));
    let rgb = saved(&one, "rgb.npy");
    assert_eq!(rgb.shape, [120, 160, 3]);
    assert!(rgb.values == saved(&two, "rgb.npy").values, "the same camera, another picture");
    let [alpha, expected, median] =
        ["alpha.npy", "depth_expected.npy", "depth_median.npy"].map(|name| saved(&one, name));
    let middle = 60 * 160 + 80;
    assert_eq!(alpha.shape, [120, 160]);
    assert!(alpha.values[middle] > 0.9, "something is ahead");
    let (a, b) = (expected.values[middle], median.values[middle]);
    assert!(a > 0.5 && (a / b - 1.0).abs() < 0.2, "expected {a} m, median {b} m");
}

/// A sliding door: its pixels, known by their ids, have moved a second later.
#[test]
fn renders_moving_objects_at_a_time() {
    let rig = Rig::new();
    let (scene, camera) = (rig.at("moving"), rig.at("cam.json"));
    good(&["scene", "generate", "moving", "-o", &scene]);
    let door = |at: &str| {
        let out = rig.at(at);
        let fixed = ["scene", "render", &scene, "--camera", &camera, "--format", "npy"];
        let printed = good(&[&fixed[..], &["--at", at, "--out", &out]].concat());
        assert!(printed.contains("door, pendulum, second drone at"), "{printed}");
        let ids = saved(&out, "ids.npy").values;
        (0..ids.len()).filter(|&k| ids[k] == 1.0).map(|k| k % 160).collect::<Vec<_>>()
    };
    let middle = |columns: &[usize]| columns.iter().sum::<usize>() as f64 / columns.len() as f64;
    let (first, again, later) = (door("0"), door("0"), door("1"));
    assert!(first.len() > 500 && first == again, "{} pixels", first.len());
    assert!((middle(&first) - middle(&later)).abs() > 5.0, "{} {}", middle(&first), middle(&later));
    check_refused(
        &["scene", "render", &scene, "--camera", &camera, "--at", "soon"],
        &["'soon' is no"],
    );
}

#[test]
fn render_errors_name_the_cause() {
    let rig = Rig::new();
    let (scene, camera) = (rig.at("race"), rig.at("cam.json"));
    let out = rig.at("out");
    let render = |scene: &str, camera: &str, texts: &[&str]| {
        check_refused(&["scene", "render", scene, "--camera", camera, "--out", &out], texts);
    };
    render(&rig.at("gone.ply"), &camera, &["there is no", "vizflyt scene generate"]);
    render(&scene, &rig.at("gone.json"), &["cannot read", "gone.json", "as a camera"]);
    rig.write("bad.json", "{\"fx\": 1");
    render(&scene, &rig.at("bad.json"), &["bad.json is not a valid camera", "w2c (4x4", "line 1"]);
    rig.write("notes.txt", "just words, of no format at all");
    render(&rig.at("notes.txt"), &camera, &["supported are", "PLY", "SPZ", ".splat", "SOG"]);
    fs::create_dir(rig.at("empty")).unwrap();
    render(&rig.at("empty"), &camera, &["is a folder without an arena.toml"]);
    check_refused(&["scene", "render", &scene], &["--camera"]);
    check_refused(
        &["scene", "render", &scene, "--camera", &camera, "--renderer", "voodoo"],
        &["voodoo", "auto, cpu, gpu"],
    );
    check_refused(
        &["scene", "render", &scene, "--camera", &camera, "--camera", &camera, "--out", &out],
        &["two cameras would write to"],
    );
    check_refused(
        &["bench", "render", &scene, "--camera", &camera, "--size", "big"],
        &["'big' is not a size in pixels; write it as 640x480"],
    );
    assert!(!Path::new(&out).exists(), "nothing is left behind");
}

#[test]
fn inspects_a_scene() {
    let rig = Rig::new();
    let found: Value =
        serde_json::from_str(&good(&["scene", "inspect", &rig.at("race"), "--json"])).unwrap();
    assert_eq!((&found["format"], &found["dropped"]), (&"PLY".into(), &0.into()), "{found:#}");
    assert!(found["splats"].as_u64().unwrap() > 10_000);
    assert!(found["core_bounds"][1][0].as_f64().unwrap() > 5.0, "{found:#}");
    let text = good(&["scene", "inspect", &rig.at("race/scene.ply")]);
    assert!(text.contains("opacity") && text.contains("harmonics"), "{text}");
}

#[test]
fn benchmark_prints_json_for_scripts() {
    let rig = Rig::new();
    let (scene, camera) = (rig.at("race"), rig.at("cam.json"));
    let args = ["bench", "render", &scene, "--camera", &camera, "--images", "4", "--size", "96x72"];
    let figures: Value = serde_json::from_str(&good(&[&args[..], &["--json"]].concat())).unwrap();
    for key in ["median_ms", "p99_ms"] {
        assert!(figures[key].as_f64().is_some_and(|ms| ms > 0.0), "{key}: {figures:#}");
    }
    assert!(figures["passes"]["blend_ms"].as_f64().is_some_and(|ms| ms > 0.0), "{figures:#}");
    assert_eq!((&figures["width_px"], &figures["images"]), (&96.into(), &4.into()));
    assert!(figures["workload"]["visible"].as_u64().unwrap() > 100);
    assert!(!figures["renderer"].as_str().unwrap().is_empty());
    let table = good(&args);
    assert!(table.contains("median") && table.contains("images/s"), "{table}");
}

#[test]
fn benchmarks_and_draws_named_sensors() {
    let rig = Rig::new();
    let (scene, camera, sheet) = (rig.at("race"), rig.at("cam.json"), rig.at("sensors.png"));
    let args = ["bench", "sensors", &scene, "--camera", &camera, "--count", "2"];
    let figures: Value =
        serde_json::from_str(&good(&[&args[..], &["--json", "--sheet", &sheet]].concat())).unwrap();
    let kinds = figures["kinds"].as_array().unwrap();
    assert_eq!(kinds.len(), 13, "an image, and twelve sensors: {figures:#}");
    assert!(kinds.iter().all(|kind| kind["least_ms"].as_f64().is_some_and(|ms| ms > 0.0)));
    let records = |name: &str| {
        let kind = kinds.iter().find(|kind| kind["name"] == name);
        kind.and_then(|kind| kind["records"].as_u64()).unwrap()
    };
    // A hall has walls and a floor in every direction of a beam.
    assert!(records("vlp-16") > 12_000 && records("os1-64") > 48_000, "{figures:#}");
    assert!(records("iwr6843") > 0, "{figures:#}");
    let picture = image::open(&sheet).unwrap().to_rgb8();
    assert_eq!(picture.dimensions(), (4 * 244, 3 * 244));
    // The first sensor looks all around: points below it are blue, points above it red.
    let reddest = |sign: i32| {
        let pixels = (0..240).flat_map(|y| (0..240).map(move |x| (x, y)));
        let of = |(x, y)| {
            let [r, _, b] = picture.get_pixel(x, y).0.map(i32::from);
            sign * (r - b) > 60
        };
        pixels.filter(|&at| of(at)).count()
    };
    assert!(reddest(1) > 50 && reddest(-1) > 50, "{} {}", reddest(1), reddest(-1));

    let one = good(&[&args[..], &["--sensor", "tfmini"]].concat());
    assert!(one.contains("tfmini") && !one.contains("vlp-16"), "{one}");
    check_refused(&[&args[..], &["--sensor", "vlp"]].concat(), &["vlp-16", "tfmini"]);
}

/// Compares the renderer with an independent one in float64; see `../shared/tools/splat_oracle.py`.
#[test]
fn images_match_the_reference_renderer() {
    let shared = root().join("../shared/scenes");
    if !shared.join("room.ply").exists() {
        println!("skipped: the captured scenes are not next to the repository");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    for (scene, pose) in [("room", "room_p0_320x240"), ("flowers_lod2", "flowers_lod2_p1_320x240")]
    {
        let out = folder.path().join(pose).to_str().unwrap().to_owned();
        let (file, camera) = (format!("{scene}.ply"), format!("ref/{pose}.json"));
        let path = |name: &str| shared.join(name).to_str().unwrap().to_owned();
        good(&[
            "scene",
            "render",
            &path(&file),
            "--camera",
            &path(&camera),
            "--format",
            "npy",
            "--out",
            &out,
        ]);
        let oracle = npz(&shared.join(format!("ref/{pose}.npz")));
        for (ours, theirs) in [("rgb.npy", "rgb.npy"), ("alpha.npy", "alpha.npy")] {
            let db = psnr(&saved(&out, ours).values, &oracle[theirs].values);
            assert!(db >= 60.0, "{pose} {ours}: {db:.1} dB");
        }
        let alpha = &oracle["alpha.npy"].values;
        for (ours, theirs) in
            [("depth_median.npy", "depth_median.npy"), ("depth_expected.npy", "depth.npy")]
        {
            let (found, truth) = (saved(&out, ours).values, &oracle[theirs].values);
            let solid: Vec<_> =
                (0..truth.len()).filter(|&k| alpha[k] > 0.5 && truth[k] > 0.0).collect();
            let near = |&&k: &&usize| (found[k] - truth[k]).abs() <= 1e-3 * truth[k];
            let share = solid.iter().filter(near).count() as f64 / solid.len() as f64;
            assert!(share >= 0.995, "{pose} {ours}: {share:.4} within 0.1 %");
        }
    }
}

fn npz(path: &Path) -> HashMap<String, Array> {
    let mut archive = zip::ZipArchive::new(File::open(path).unwrap()).unwrap();
    (0..archive.len())
        .filter_map(|index| {
            let mut file = archive.by_index(index).unwrap();
            let mut bytes = Vec::new();
            file.read_to_end(&mut bytes).unwrap();
            let name = file.name().unwrap().into_owned();
            Some((name, array(&bytes)?))
        })
        .collect()
}

fn psnr(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let square = |(a, b): (&f32, &f32)| f64::from(a - b).powi(2);
    let mean = a.iter().zip(b).map(square).sum::<f64>() / a.len() as f64;
    -10.0 * mean.log10()
}

/// The page requests an image over its WebSocket and copies the camera; `scene render` renders the same view.
#[test]
fn viewer_serves_a_page_and_renders_its_requests() {
    let rig = Rig::new();
    let mut child = Command::new(vizflyt())
        .args(["scene", "view", &rig.at("race"), "--no-browser"])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let line = lines.by_ref().map(Result::unwrap).find(|line| line.contains("http://"));
    let line = line.expect("the address is printed");
    let address = line.rsplit("http://").next().unwrap().to_owned();

    let get = |path: &str| {
        let mut page = TcpStream::connect(&address).unwrap();
        write!(page, "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n")
            .unwrap();
        let mut text = String::new();
        page.read_to_string(&mut text).unwrap();
        text
    };
    let text = get("/");
    assert!(text.starts_with("HTTP/1.1 200") && text.contains("<canvas"), "{text}");
    // The viewer is read-only.
    for path in ["/api/align", "/api/course", "/api/edit"] {
        assert!(get(path).starts_with("HTTP/1.1 404"), "{path}");
    }

    let origin = format!("Origin: http://{address}\r\n");
    let mut socket = WebSocket::open(address.parse().unwrap(), "/ws", &origin).ok().unwrap();
    let welcome: Value = serde_json::from_slice(&socket.receive().1).unwrap();
    assert!(welcome["renderer"]["reason"].is_string(), "{welcome}");
    socket.send("{\"what\": 1}");
    let error: Value = serde_json::from_slice(&socket.receive().1).unwrap();
    assert!(error["error"].as_str().unwrap().contains("unknown field `what`"), "{error}");
    let ask = json!({"p_m": welcome["start_m"], "yaw_rad": 0.3, "pitch_rad": -0.1, "fov_deg": 80,
                     "width_px": 200, "height_px": 100, "depth": false, "at_s": 2.5});
    socket.send(&ask.to_string());
    let info: Value = serde_json::from_slice(&socket.receive().1).unwrap();
    assert!(info["visible"].as_u64().unwrap() > 100, "{info}");
    assert_eq!(socket.receive().1[..2], [0xff, 0xd8], "a JPEG follows");

    rig.write("copied.json", &info["camera"].to_string());
    let printed = good(&[
        "scene",
        "render",
        &rig.at("race"),
        "--camera",
        &rig.at("copied.json"),
        "--at",
        "2.5",
        "--out",
        &rig.at("copied"),
    ]);
    assert!(printed.contains(&format!("{} splats in sight", info["visible"])), "{printed} {info}");

    kill(Pid::from_raw(child.id() as i32), Signal::SIGTERM).unwrap();
    assert!(child.wait().unwrap().success());
}

/// Returns a room of 10 x 6 x 3 m in units of 0.25 m, y down: floor, ceiling, walls, and shelves along one wall.
fn captured_room() -> Vec<u8> {
    let mut rows: Vec<[f32; 14]> = Vec::new();
    // Normals along z, y or x, by a quarter turn about x or y.
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let turns = [[1.0, 0.0, 0.0, 0.0], [half, half, 0.0, 0.0], [half, 0.0, half, 0.0]];
    let mut face = |turn: usize, corner: [f32; 3], u: [f32; 3], v: [f32; 3]| {
        let length = |w: [f32; 3]| w.iter().map(|x| x * x).sum::<f32>().sqrt();
        let (across, down) = ((length(u) / 0.4) as usize, (length(v) / 0.4) as usize);
        for k in 0..across * down {
            let (a, b) = ((k % across) as f32 / across as f32, (k / across) as f32 / down as f32);
            let p: [f32; 3] = std::array::from_fn(|axis| corner[axis] + u[axis] * a + v[axis] * b);
            let [w, x, y, z] = turns[turn];
            let (wide, thin) = (0.4f32.ln(), 0.04f32.ln());
            rows.push([p[0], p[1], p[2], 0.5, 0.5, 0.5, 3.0, wide, wide, thin, w, x, y, z]);
        }
    };
    let (x, down, z) = ([40.0, 0.0, 0.0], [0.0, 12.0, 0.0], [0.0, 0.0, 24.0]);
    face(1, [0.0, 12.0, 0.0], x, z);
    face(1, [0.0, 0.0, 0.0], x, z);
    face(0, [0.0, 0.0, 0.0], x, down);
    face(0, [0.0, 0.0, 24.0], x, down);
    face(2, [0.0, 0.0, 0.0], z, down);
    face(2, [40.0, 0.0, 0.0], z, down);
    for shelf in 1..=6 {
        let height = 12.0 - 0.8 * shelf as f32;
        face(1, [2.0, height, 18.0], [36.0, 0.0, 0.0], [0.0, 0.0, 4.0]);
    }
    let names =
        "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    let mut bytes =
        format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", rows.len());
    for name in names.split(' ') {
        bytes += "property float ";
        bytes += name;
        bytes.push('\n');
    }
    let mut bytes = (bytes + "end_header\n").into_bytes();
    bytes.extend(rows.iter().flatten().flat_map(|value| value.to_le_bytes()));
    bytes
}

/// From a capture to an arena that is checked, baked and rendered, with rejected inputs.
#[test]
fn creates_an_arena_for_a_captured_room() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    fs::write(at("room.ply"), captured_room()).unwrap();
    let new = |name: &str, more: &[&str]| {
        good(&[&["arena", "new", &at(name), "--scene", &at("room.ply")], more].concat())
    };
    let printed = new("mine", &["--environment", "night"]);
    assert!(printed.contains("-y is up, 0.25 m per unit"), "{printed}");
    let text = fs::read_to_string(at("mine/arena.toml")).unwrap();
    assert!(text.contains("[scene]\nfile = \"../room.ply\"\nup = \"-y\""), "{text}");
    assert!(good(&["arena", "check", &at("mine")]).contains("can be flown"));
    let baked: Value =
        serde_json::from_str(&good(&["scene", "bake", &at("mine"), "--json", "--force"])).unwrap();
    assert!(baked["occupied"].as_u64().unwrap() > 10_000, "{baked}");
    check_refused(&["arena", "new", &at("mine"), "--scene", &at("room.ply")], &["already exists"]);
    check_refused(&["arena", "new", &at("x"), "--scene", &at("mine")], &["is an arena already"]);

    // Cameras of an arena are in the world frame: half a metre under the ceiling, looking down, it is 2.5 m to the
    // floor.
    let w2c = json!([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2.5], [0, 0, 0, 1]]);
    let camera = json!({"fx": 40, "fy": 40, "cx": 8, "cy": 8, "w": 16, "h": 16, "w2c": w2c});
    fs::write(at("down.json"), camera.to_string()).unwrap();
    let out = at("out");
    let render = |scene: &str| {
        let fixed = ["--camera", &at("down.json"), "--format", "npy", "--out", &out];
        good(&[&["scene", "render", scene], &fixed[..]].concat());
        saved(&out, "depth_median.npy").values[8 * 16 + 8]
    };
    let depth_m = render(&at("mine"));
    assert!((depth_m - 2.5).abs() < 0.05, "{depth_m} m to the floor");

    // The same depth with a converted file.
    let converted = at("upright.ply");
    good(&["scene", "convert", &at("room.ply"), &converted, "--up", "-y", "--scale", "0.25"]);
    let origin = text.lines().find(|line| line.starts_with("origin")).unwrap();
    let upright = text.replace("up = \"-y\"\nmetres_per_unit = 0.25\n", "");
    assert!(upright.contains(origin) && !upright.contains("metres_per_unit"));
    fs::create_dir(at("placed")).unwrap();
    fs::write(at("placed/arena.toml"), upright.replace("../room.ply", "../upright.ply")).unwrap();
    assert!((render(&at("placed")) - depth_m).abs() < 1e-3);

    // Upside down, on its side, displaced, far too large, and without alignment.
    let refused = |name: &str, change: &dyn Fn(&str) -> String, expected: &str| {
        fs::create_dir_all(at(name)).unwrap();
        fs::write(at(&format!("{name}/arena.toml")), change(&text)).unwrap();
        let checked = vizflyt_e2e::run(&["arena", "check", &at(name)]);
        let printed = String::from_utf8_lossy(&checked.stdout).into_owned();
        assert!(!checked.status.success() && printed.contains(expected), "{name}: {printed}");
        check_refused(&["scene", "bake", &at(name)], &["does not fit its arena", expected]);
    };
    for (up, expected) in [("y", "upside down"), ("x", "on its side"), ("-x", "on its side")] {
        new(up, &["--up", up]);
        let made = fs::read_to_string(at(&format!("{up}/arena.toml"))).unwrap();
        refused(up, &|_| made.clone(), expected);
    }
    let set = |key: &'static str, value: &'static str| {
        move |text: &str| {
            let old = text.lines().find(|line| line.starts_with(key)).unwrap().to_owned();
            text.replace(&old, &format!("{key} = {value}"))
        }
    };
    refused("elsewhere", &set("origin", "[300, 0, 0]"), "100 % of the scene lies outside");
    refused("no-floor", &set("origin", "[-3, 5, 1.4]"), "has no floor there");
    // The short form requires a scene in the world frame, but this scene lies on its side.
    let file = "[scene]\nfile = \"../room.ply\"\nup = \"-y\"\nmetres_per_unit = 0.25\n";
    let short = |text: &str| {
        let body = text.replace(file, "").replace(origin, "");
        let start = body.lines().find(|line| line.starts_with("position_m")).unwrap();
        let body = body.replacen(start, "position_m = [-1.0, -1.0, 0.0]", 1);
        format!("scene = \"../room.ply\"\n{body}")
    };
    refused("short", &short, "spawn.position_m");

    // Options for scenes without an arena are rejected for an arena.
    for command in [&["scene", "bake"][..], &["scene", "view"]] {
        let mine = at("mine");
        let args = [command, &[mine.as_str(), "--up", "z", "--scale", "2"]].concat();
        check_refused(
            &args,
            &["--up and --scale are for a scene without an arena", "[scene] there"],
        );
    }
    check_refused(&["demo", "--scene", &at("mine"), "--up", "z"], &["--up is for a scene without"]);
    check_refused(
        &["demo", "--scene", &at("mine"), "--environment", "fog"],
        &["set [environment] in"],
    );
    check_refused(&["demo", "--scene", "race", "--scale", "2"], &["'race' is generated upright"]);
    check_refused(
        &["scene", "bake", &at("room.ply"), "--scale", "1000"],
        &["24000 x 40000 x 12000 m", "9.2e13 voxels of 0.5 m", "GB", "give a smaller --scale"],
    );
}

/// Returns the files of a folder by name.
fn files_of(folder: &str) -> Vec<(String, Vec<u8>)> {
    let mut files: Vec<(String, Vec<u8>)> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .map(|path| {
            (path.file_name().unwrap().to_str().unwrap().to_owned(), fs::read(path).unwrap())
        })
        .collect();
    files.sort();
    files
}

#[test]
fn capture_has_images_and_truth_and_is_reproducible() {
    let home = tempfile::tempdir().unwrap();
    let at = |name: &str| home.path().join(name).to_str().unwrap().to_owned();
    let film = |kind: &str, name: &str, more: &[&str]| {
        let mut args = vec!["scene", "generate", kind, "--seed", "3", "--tags", "--seconds", "20"];
        let capture = at(name);
        args.extend(["--frames", "4", "--size", "160x120", "--capture", &capture]);
        args.extend(more);
        good(&args)
    };
    let said = film("room", "a", &["-o", &at("room")]);
    assert!(said.contains("boards along it") && said.contains("4 images"), "{said}");
    film("room", "b", &[]);
    let [a, b] = ["a", "b"].map(|name| files_of(&at(name)));
    assert!(a == b, "the same seed gives the same capture");
    let names: Vec<&str> = a.iter().map(|(name, _)| name.as_str()).collect();
    let expected = [
        "00000.jpg",
        "00001.jpg",
        "00002.jpg",
        "00003.jpg",
        "camera.toml",
        "tags.toml",
        "truth.json",
    ];
    assert_eq!(names, expected);
    let truth: Value = serde_json::from_slice(&a[6].1).unwrap();
    assert_eq!(truth["images"].as_array().unwrap().len(), 4);
    assert_eq!(truth["images"][2]["file"], "00002.jpg");
    assert_eq!(truth["camera"]["width_px"], 160);
    // The generated scene has the boards as additional true solids.
    let solids = |folder: &str| -> usize {
        let text = fs::read(Path::new(folder).join("truth.json")).unwrap();
        serde_json::from_slice::<Vec<Value>>(&text).unwrap().len()
    };
    good(&["scene", "generate", "room", "--seed", "3", "-o", &at("plain")]);
    assert!(solids(&at("room")) > solids(&at("plain")) + 5);
    // Objects move only if requested; every kind of scene can be filmed.
    for kind in ["race", "moving", "forest"] {
        film(kind, kind, &["--moving"]);
        let truth = fs::read(Path::new(&at(kind)).join("truth.json")).unwrap();
        assert_eq!(serde_json::from_slice::<Value>(&truth).unwrap()["scene"]["moving"], true);
    }
    // Existing files are not overwritten.
    let a = at("a");
    let args = ["scene", "generate", "room", "--capture", &a];
    check_refused(&args, &["truth.json already exists", "--force"]);
}

#[test]
fn capture_errors_name_the_cause() {
    let home = tempfile::tempdir().unwrap();
    let at = |name: &str| home.path().join(name).to_str().unwrap().to_owned();
    let refused = |more: &[&str], parts: &[&str]| {
        let mut args = vec!["scene", "generate", "room"];
        args.extend(more);
        check_refused(&args, parts);
    };
    let (video, photo, folder) = (at("a.mp4"), at("a.jpg"), at("images"));
    refused(&["--tags", "-o", &folder], &["--capture"]);
    refused(&["--capture", &photo], &[".mp4, .mkv or .mov"]);
    refused(&["--capture", &video, "--size", "161x120"], &["even sides"]);
    refused(&["--capture", &folder, "--seconds", "1"], &["2 to 600 s"]);
    refused(&["--capture", &folder, "--frames", "0"], &["at least 1"]);
    refused(&["--capture", &video, "--seconds", "2", "--frames", "99"], &["60 images"]);
    // Without ffmpeg on the path.
    let output = Command::new(vizflyt())
        .args(["scene", "generate", "room", "--seconds", "2", "--capture", &video])
        .env("PATH", home.path())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && said.contains("apt-get install ffmpeg"), "{said}");
    assert!(!Path::new(&video).exists() && fs::read_dir(home.path()).unwrap().count() == 0);
}

#[test]
fn video_has_the_requested_number_and_size_of_images() {
    let home = tempfile::tempdir().unwrap();
    let video = home.path().join("hall.mp4");
    let capture = video.to_str().unwrap();
    let args = ["--seconds", "2", "--frames", "20", "--size", "320x240", "--capture", capture];
    good(&[&["scene", "generate", "room", "--seed", "3"][..], &args].concat());
    // Decode with ffmpeg to raw grey.
    let raw = Command::new("ffmpeg")
        .args(["-nostdin", "-v", "error", "-i", capture, "-f", "rawvideo", "-pix_fmt", "gray", "-"])
        .output()
        .expect("ffmpeg is installed");
    assert_eq!(raw.stdout.len(), 20 * 320 * 240);
    let mean =
        raw.stdout.iter().map(|&grey| f64::from(grey)).sum::<f64>() / raw.stdout.len() as f64;
    assert!((60.0..190.0).contains(&mean), "mean grey {mean}");
    let truth = fs::read(home.path().join("hall.truth.json")).unwrap();
    let truth: Value = serde_json::from_slice(&truth).unwrap();
    assert_eq!(truth["images"].as_array().unwrap().len(), 20);
    assert_eq!(truth["images"][1]["stamp_ns"], 33_333_333);
    assert!(truth["tags"].as_array().unwrap().is_empty());
}
