//! Benchmark of the GPU renderer: images per second and milliseconds per pass, by number of splats and cameras.
//!
//! ```text
//! cargo bench -p vizflyt-splat --bench gpu [-- [--out FOLDER] [--counts 100000,1000000]
//!     [--cameras 1,2,4,8] [--size 640x480] [--seconds 2] [--only NAME]]
//! ```
//!
//! Uses the first adapter; software adapters are last. Scenes are generated halls with harmonics of degree 3, from a
//! million splats on also in adaptive detail, and the captured scenes of a neighbouring `../shared`, if present.
//! `--out` writes the scenes as PLY, the cameras, the first image of each scene and all results: `tests/gpu/table`
//! passes them to gsplat.
//!
//! Passes are timed by the device, the call by the host; the call ends with the images in the caller's memory. The
//! CPU renderer renders the same for comparison. "Pipelined" has two ticks in flight ([`GpuRenderer::begin`]).

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use glam::{DMat3, DQuat, DVec3, Quat, Vec3};
use serde::Deserialize;
use serde_json::{Value, json};
use vizflyt_protocol::geometry::{Cam, Distortion, Intrinsics, Pose, World};
use vizflyt_splat::gpu::{Adapter, Budget, GpuRenderer};
use vizflyt_splat::{Camera, CpuRenderer, Detail, PassTimes, Rasterizer, RgbdImage, Splats, ply};

/// Command-line options.
struct Options {
    out: Option<PathBuf>,
    counts: Vec<usize>,
    cameras: Vec<usize>,
    size: (u32, u32),
    seconds: f32,
    /// Substring of the scene's name.
    only: String,
}

/// Scene with its cameras.
struct Case {
    name: String,
    splats: Splats,
    cameras: Vec<Camera>,
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    // `cargo test` also runs benches, but without this flag; then nothing is measured.
    if !arguments.iter().any(|argument| argument == "--bench") {
        return;
    }
    let options = options(&arguments);
    let adapters = Adapter::all();
    let Some(adapter) = adapters.first() else {
        println!("no graphics adapter: nothing is measured");
        return;
    };
    let kind = if adapter.name().is_software { ", a software adapter" } else { "" };
    println!("{}{kind}\n", adapter.name().name);
    println!(
        "| scene | cameras | visible | pairs | cull | project | sort | bin | blend | unpack | \
         call p50 | call p99 | images/s | pipelined images/s | cpu p50 |"
    );
    println!("|{}", "---|".repeat(15));
    let mut rows = Vec::new();
    let mut measure_all = |case: &Case| {
        measure(case, Detail::Full, adapter, &options, &mut rows);
        let suited = Detail::suited_to(&(&case.splats).into());
        if suited != Detail::Full {
            measure(case, suited, adapter, &options, &mut rows);
        }
    };
    for case in captured().iter().filter(|case| case.name.contains(&options.only)) {
        measure_all(case);
    }
    for &count in &options.counts {
        let case = hall(count, &options);
        if !case.name.contains(&options.only) {
            continue;
        }
        if let Some(out) = &options.out {
            leave(&case, adapter, out);
        }
        measure_all(&case);
    }
    if let Some(out) = &options.out {
        let figures = json!({ "adapter": adapter.name().name, "rows": rows });
        std::fs::write(out.join("ours.json"), figures.to_string()).expect("a folder to write to");
    }
}

fn options(arguments: &[String]) -> Options {
    let value = |name: &str| {
        let at = arguments.iter().position(|argument| argument == name)?;
        Some(arguments.get(at + 1).unwrap_or_else(|| panic!("{name} needs a value")).as_str())
    };
    let list = |name: &str, default: &str| -> Vec<usize> {
        let numbers = value(name).unwrap_or(default).split(',');
        numbers.map(|number| number.parse().expect("a list like 1,2,4")).collect()
    };
    let (width, height) = value("--size").unwrap_or("640x480").split_once('x').expect("WxH");
    Options {
        out: value("--out").map(PathBuf::from),
        counts: list("--counts", "100000,500000,1000000,5000000"),
        cameras: list("--cameras", "1,2,4,8"),
        size: (width.parse().expect("a width"), height.parse().expect("a height")),
        seconds: value("--seconds").unwrap_or("2").parse().expect("a number of seconds"),
        only: value("--only").unwrap_or_default().to_owned(),
    }
}

/// Prints a row per number of cameras.
fn measure(
    case: &Case,
    detail: Detail,
    adapter: &Adapter,
    options: &Options,
    rows: &mut Vec<Value>,
) {
    let name = match detail {
        Detail::Full => case.name.clone(),
        Detail::Adaptive { .. } => format!("{}, adaptive", case.name),
    };
    let mut cpu = CpuRenderer::with_detail(&case.splats, detail);
    let mut gpu = match GpuRenderer::like(&cpu, adapter, Budget::default()) {
        Ok(gpu) => gpu,
        Err(error) => return println!("| {name} | {error} |"),
    };
    let most = Duration::from_secs_f32(options.seconds);
    for &count in options.cameras.iter().filter(|&&count| count <= case.cameras.len()) {
        let cameras = &case.cameras[..count];
        let mut images = vec![RgbdImage::default(); count];
        let mut render_one = |gpu: &mut GpuRenderer| {
            gpu.render(&[], cameras, &mut images).expect("valid cameras and a device")
        };
        // Warm-up: buffers grow and clock rates rise.
        for _ in 0..3 {
            render_one(&mut gpu);
        }
        let mut times: Vec<PassTimes> = Vec::new();
        let start = Instant::now();
        while times.len() < 10 || start.elapsed() < most {
            times.push(render_one(&mut gpu));
        }
        let mut cpu_ms: Vec<f32> = Vec::new();
        while cpu_ms.len() < 10 {
            let rendered = cpu.render(&[], cameras, &mut images).expect("valid cameras");
            cpu_ms.push(rendered.total_ms);
        }
        cpu_ms.sort_by(f32::total_cmp);
        let cpu_ms = cpu_ms[cpu_ms.len() / 2];
        let begin = |gpu: &mut GpuRenderer| gpu.begin(&[], cameras).expect("valid cameras");
        let mut pipelined = 0;
        let start = Instant::now();
        begin(&mut gpu);
        while pipelined < 10 || start.elapsed() < most {
            begin(&mut gpu);
            gpu.finish(&mut images).expect("a device");
            pipelined += 1;
        }
        gpu.finish(&mut images).expect("a device");
        let pipelined = ((pipelined + 1) * count) as f32 / start.elapsed().as_secs_f32();

        let quantile = |share: f32, pass: fn(&PassTimes) -> f32| {
            let mut ms: Vec<f32> = times.iter().map(pass).collect();
            ms.sort_by(f32::total_cmp);
            ms[((ms.len() - 1) as f32 * share).round() as usize]
        };
        let passes = [
            quantile(0.5, |t| t.cull_ms),
            quantile(0.5, |t| t.project_ms),
            quantile(0.5, |t| t.sort_ms),
            quantile(0.5, |t| t.bin_ms),
            quantile(0.5, |t| t.blend_ms),
            quantile(0.5, |t| t.read_ms),
        ];
        let (p50, p99) = (quantile(0.5, |t| t.total_ms), quantile(0.99, |t| t.total_ms));
        let per_second = count as f32 * 1e3 / p50;
        let work = gpu.workload();
        let cells: Vec<String> = passes.iter().map(|ms| format!("{ms:.3}")).collect();
        println!(
            "| {name} | {count} | {} | {} | {} | {p50:.3} | {p99:.3} | {per_second:.0} | \
             {pipelined:.0} | {cpu_ms:.2} |",
            work.visible,
            work.pairs,
            cells.join(" | ")
        );
        // The renderers that are compared with this one render every splat.
        if detail == Detail::Full {
            rows.push(json!({
                "scene": case.name, "splats": case.splats.len(), "cameras": count,
                "call_ms": p50, "cpu_ms": cpu_ms, "images_per_s": per_second, "pipelined_images_per_s": pipelined,
            }));
        }
    }
}

/// Returns a hall of 24 by 24 m with 60 pillars, covered with surfels, and cameras in its middle, each rotated by an
/// eighth of a circle from the last.
fn hall(count: usize, options: &Options) -> Case {
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    let mut random = move |low: f32, high: f32| {
        // Knuth's MMIX generator; uses its upper 24 bits.
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        low + (state >> 40) as f32 / (1u64 << 24) as f32 * (high - low)
    };
    let mut splats = Splats { sh_degree: 3, ..Splats::default() };
    // More splats are smaller, with the same total area.
    let size = 0.06 * (100_000.0 / count as f32).sqrt();
    for i in 0..count {
        let mean = match i % 5 {
            0 => Vec3::new(random(-12.0, 12.0), random(-12.0, 12.0), random(-0.02, 0.02)),
            1 => Vec3::new(random(-12.0, 12.0), random(-12.0, 12.0), 4.0 + random(-0.02, 0.02)),
            2 => {
                // Rough like the rest: on an exactly flat wall, each renderer blends in a different order.
                let rough = random(-0.02, 0.02);
                let (along, side) = (random(-12.0, 12.0), 12.0 * (i % 2 * 2) as f32 - 12.0 + rough);
                let z = random(0.0, 4.0);
                if i % 4 < 2 { Vec3::new(along, side, z) } else { Vec3::new(side, along, z) }
            }
            _ => {
                let pillar = random(0.0, 60.0).floor();
                let turn = random(0.0, std::f32::consts::TAU);
                let x = (pillar * 7.31) % 23.0 - 11.5 + 0.3 * turn.cos();
                Vec3::new(x, (pillar * 3.77) % 23.0 - 11.5 + 0.3 * turn.sin(), random(0.0, 4.0))
            }
        };
        splats.means_m.push(mean);
        let mut side = |low: f32, high: f32| random(low, high) * size;
        splats.scales_m.push(Vec3::new(side(0.4, 1.6), side(0.4, 1.6), side(0.1, 0.4)));
        let q = Quat::from_array([(); 4].map(|()| random(-1.0, 1.0)));
        splats.rotations.push(if q.length() > 0.1 { q.normalize() } else { Quat::IDENTITY });
        splats.opacities.push(random(0.3, 1.0));
        splats.sh.extend((0..48).map(|k| random(-1.0, 1.0) / if k < 3 { 1.0 } else { 8.0 }));
    }
    // Camera axes in the world: right, down, forward.
    let ahead = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
    let (width, height) = options.size;
    let intrinsics = Intrinsics::from_horizontal_fov(width, height, 90f64.to_radians());
    let cameras = (0..options.cameras.iter().copied().max().unwrap_or(1))
        .map(|i| {
            let turn = DQuat::from_rotation_z(i as f64 * std::f64::consts::FRAC_PI_4);
            let pose = Pose::new(DVec3::new(0.4, 0.1, 1.5), turn * DQuat::from_mat3(&ahead));
            camera(intrinsics, pose)
        })
        .collect();
    Case { name: format!("hall_{}k", count / 1000), splats, cameras }
}

/// Returns the scenes of `../shared`, at the reference poses and both sizes: one camera each.
fn captured() -> Vec<Case> {
    #[derive(Deserialize)]
    struct File {
        fx: f64,
        fy: f64,
        cx: f64,
        cy: f64,
        w: u32,
        w2c: [[f64; 4]; 4],
    }
    let shared = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/scenes");
    let mut cases = Vec::new();
    for scene in ["room", "flowers_lod2"] {
        let path: PathBuf = shared.join(scene).with_extension("ply");
        let Ok(loaded) = ply::read(&path) else {
            println!("skipped: {scene}, for lack of {}", path.display());
            continue;
        };
        for (pose, (w, h)) in ["p0", "p1"].into_iter().flat_map(|p| SIZES.map(|size| (p, size))) {
            let path = shared.join(format!("ref/{scene}_{pose}_320x240.json"));
            let text = std::fs::read_to_string(path).expect("a reference camera");
            let c: File = serde_json::from_str(&text).expect("a camera");
            let row = |i: usize| DVec3::new(c.w2c[i][0], c.w2c[i][1], c.w2c[i][2]);
            let rotation = DMat3::from_cols(row(0), row(1), row(2));
            let translation = DVec3::new(c.w2c[0][3], c.w2c[1][3], c.w2c[2][3]);
            let pose_in_world = Pose::new(-(rotation * translation), DQuat::from_mat3(&rotation));
            let zoom = f64::from(w) / f64::from(c.w);
            let intrinsics = Intrinsics {
                width_px: w,
                height_px: h,
                fx_px: c.fx * zoom,
                fy_px: c.fy * zoom,
                cx_px: c.cx * zoom,
                cy_px: c.cy * zoom,
                distortion: Distortion::None,
            };
            cases.push(Case {
                name: format!("{scene} {pose} {w}x{h}"),
                splats: loaded.splats.clone(),
                cameras: vec![camera(intrinsics, pose_in_world)],
            });
        }
    }
    cases
}

const SIZES: [(u32, u32); 2] = [(320, 240), (640, 480)];

fn camera(intrinsics: Intrinsics, world_from_cam: Pose<World, Cam>) -> Camera {
    Camera::new(intrinsics, world_from_cam, 0.01)
}

/// Writes the input for another renderer: the scene, its cameras in the oracle's format, and this renderer's first
/// image as f32.
fn leave(case: &Case, adapter: &Adapter, out: &Path) {
    let file = |extension: &str| out.join(&case.name).with_extension(extension);
    std::fs::create_dir_all(out).expect("a folder to write to");
    ply::write(file("ply"), &case.splats).expect("room for the scene");
    let cameras: Vec<Value> = case
        .cameras
        .iter()
        .map(|camera| {
            let k = &camera.intrinsics;
            let rotation = DMat3::from_quat(camera.world_from_cam.rotation).transpose();
            let shift = -(rotation * camera.world_from_cam.translation_m);
            let row = |i: usize| {
                let r = rotation.row(i);
                [r.x, r.y, r.z, shift[i]]
            };
            json!({
                "fx": k.fx_px, "fy": k.fy_px, "cx": k.cx_px, "cy": k.cy_px,
                "w": k.width_px, "h": k.height_px, "bg": camera.background,
                "w2c": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
            })
        })
        .collect();
    std::fs::write(file("json"), Value::from(cameras).to_string()).expect("room for cameras");
    let mut gpu = GpuRenderer::new(&case.splats, adapter, Budget::default()).expect("a device");
    let mut image = [RgbdImage::default()];
    gpu.render(&[], &case.cameras[..1], &mut image).expect("a camera and a device");
    let bytes: Vec<u8> = image[0].rgb.iter().flat_map(|value| value.to_le_bytes()).collect();
    std::fs::write(file("rgb"), bytes).expect("room for an image");
}
