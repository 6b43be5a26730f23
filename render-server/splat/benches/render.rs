//! Benchmark of the CPU renderer: milliseconds per RGB-D image (RGB, alpha, both depths) for each instruction set,
//! compared with the reference; then the time of each pass.
//!
//! ```text
//! cargo bench -p vizflyt-splat --bench render [-- [passes] [SCENE.ply]... [FILTER]]
//! ```
//!
//! `passes` skips criterion's part, FILTER selects cases whose `scene/view` contains it. Scenes are synthetic (100 k
//! and 1 M splats), the captured ones of a neighbouring `../shared`, if present, and any PLY file on the command line
//! (seen from the centre of its splats). Times are for all cores of the machine, so compare only results of the same
//! run. On a shared machine, the minimum of the per-pass table is the most meaningful value.

use std::hint::black_box;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use criterion::Criterion;
use glam::{DMat3, DQuat, DVec3, Quat, Vec3};
use serde::Deserialize;
use vizflyt_protocol::geometry::{Distortion, Intrinsics, Pose};
use vizflyt_splat::{
    Camera, CpuRenderer, PassTimes, Rasterizer, RgbdImage, Splats, ply, render_reference,
};

/// Scene with its cameras.
struct Case {
    name: String,
    splats: Splats,
    cameras: Vec<(String, Camera)>,
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    // `cargo test` also runs benches, but without this flag; then nothing is measured.
    if !arguments.iter().any(|argument| argument == "--bench") {
        return;
    }
    let mut criterion = Criterion::default()
        .sample_size(30)
        .warm_up_time(Duration::from_millis(500))
        .measurement_time(Duration::from_secs(3));
    let mut cases = captured();
    let (mut only_passes, mut filter) = (false, String::new());
    for argument in arguments.into_iter().filter(|argument| !argument.starts_with("--")) {
        if Path::new(&argument).extension().is_some_and(|extension| extension == "ply") {
            cases.push(from_file(Path::new(&argument)));
        } else if argument == "passes" {
            only_passes = true;
        } else {
            filter = argument;
        }
    }
    cases.extend([100_000, 1_000_000].map(synthetic));
    for case in &mut cases {
        case.cameras.retain(|(view, _)| format!("{}/{view}", case.name).contains(&filter));
    }
    cases.retain(|case| !case.cameras.is_empty());

    for case in cases.iter().filter(|_| !only_passes) {
        for (view, camera) in &case.cameras {
            let mut group = criterion.benchmark_group(format!("{}/{view}", case.name));
            for mut renderer in CpuRenderer::every(&case.splats) {
                let mut image = [RgbdImage::default()];
                group.bench_function(renderer.name().into_owned(), |bencher| {
                    bencher.iter(|| renderer.render(&[], &[*camera], &mut image).map(|_| ()));
                });
            }
            group.finish();
        }
    }
    for case in &cases {
        passes(case);
        if case.name == "room" {
            println!("{PEERS}");
        }
    }
}

/// Measured on the same kind of machine, two cores without a GPU; none of these renderers outputs depth.
const PEERS: &str = "peers, room p0 / p1, RGB only, median ms: 320x240: brush 662 / 601, web-splat \
    262 / 205 (a wrong picture), wgpu-3dgs-viewer 547 / 480 (a wrong picture); 640x480: brush 1344 / \
    1021, web-splat 402 / 315, wgpu-3dgs-viewer 830 / 764";

/// Prints the median and minimum time of every pass [ms], the minimum possible time of each on this machine, and the
/// speedup of the whole over the reference.
fn passes(case: &Case) {
    println!("\n{} ({} splats): median (least) ms of 60 images", case.name, case.splats.len());
    println!(
        "{:32} {:>7} {:>7} | {:>13} {:>13} {:>13} {:>13} {:>13} {:>13} | reference / fast",
        "", "visible", "pairs", "cull", "project", "sort", "bin", "blend", "total"
    );
    for (view, camera) in &case.cameras {
        let start = Instant::now();
        black_box(render_reference(&case.splats, &[], camera).expect("a valid camera"));
        let reference_ms = start.elapsed().as_secs_f32() * 1e3;
        for mut renderer in CpuRenderer::every(&case.splats) {
            let mut image = [RgbdImage::default()];
            let times: Vec<PassTimes> = (0..65)
                .map(|_| renderer.render(&[], &[*camera], &mut image).expect("a valid camera"))
                .skip(5)
                .collect();
            let row = |pass: fn(&PassTimes) -> f32| {
                let mut ms: Vec<f32> = times.iter().map(pass).collect();
                ms.sort_by(f32::total_cmp);
                (ms[ms.len() / 2], ms[0])
            };
            let cell = |(median, least): (f32, f32)| format!("{median:.2} ({least:.2})");
            let total = row(|t| t.total_ms);
            let work = renderer.workload();
            println!(
                "{:32} {:7} {:7} | {:>13} {:>13} {:>13} {:>13} {:>13} {:>13} | {:.0}",
                format!("{view} {}", renderer.name()),
                work.visible,
                work.pairs,
                cell(row(|t| t.cull_ms)),
                cell(row(|t| t.project_ms)),
                cell(row(|t| t.sort_ms)),
                cell(row(|t| t.bin_ms)),
                cell(row(|t| t.blend_ms)),
                cell(total),
                reference_ms / total.0,
            );
            let Intrinsics { width_px, height_px, .. } = camera.intrinsics;
            let need = renderer.need([width_px as usize, height_px as usize]);
            let bound = need.bound(&renderer.machine(need.bytes() as usize));
            println!(
                "{:32} {:15} | {:13} {:13.2} {:13.2} {:13.2} {:13.2} {:13.2} | {:.1} times",
                "",
                "at least",
                "",
                bound.project_ms,
                bound.sort_ms,
                bound.bin_ms,
                bound.blend_ms,
                bound.total_ms,
                total.0 / bound.total_ms,
            );
        }
    }
}

/// Returns random surfels on a ground and on many trunks and crowns, with depth layers and sizes like in a forest.
fn synthetic(count: usize) -> Case {
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    let mut random = move |low: f32, high: f32| {
        // Knuth's MMIX generator; uses its upper 24 bits.
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        low + (state >> 40) as f32 / (1u64 << 24) as f32 * (high - low)
    };
    let mut splats = Splats { sh_degree: 0, ..Splats::default() };
    // More splats are smaller, with the same total area.
    let size = (100_000.0 / count as f32).sqrt();
    for i in 0..count {
        let (mean, scale) = if i % 3 == 0 {
            (Vec3::new(random(-2.0, 40.0), random(-8.0, 8.0), random(-0.02, 0.02)), 0.05)
        } else {
            let tree = (random(0.0, 60.0) as u32) as f32;
            let angle = random(0.0, std::f32::consts::TAU);
            let trunk = Vec3::new((tree * 7.31) % 38.0 + 2.0, (tree * 3.77) % 16.0 - 8.0, 0.0);
            let (radius, height) = if i % 3 == 1 {
                (0.2, random(0.0, 3.0))
            } else {
                (random(0.3, 1.2), random(2.2, 4.0))
            };
            let around = Vec3::new(angle.cos() * radius, angle.sin() * radius, height);
            (trunk + around, 0.03)
        };
        let s = scale * size;
        splats.means_m.push(mean);
        splats.scales_m.push(Vec3::new(
            random(0.4, 1.6) * s,
            random(0.4, 1.6) * s,
            random(0.1, 0.4) * s,
        ));
        let q = Quat::from_array([(); 4].map(|()| random(-1.0, 1.0)));
        splats.rotations.push(if q.length() > 0.1 { q.normalize() } else { Quat::IDENTITY });
        splats.opacities.push(random(0.3, 1.0));
        splats.sh.extend([(); 3].map(|()| random(-1.0, 1.0)));
    }
    // 1.2 m above the ground, looking along x.
    let ahead = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
    let pose = Pose::new(DVec3::new(0.0, 0.0, 1.2), DQuat::from_mat3(&ahead));
    let cameras = sizes().map(|(w, h)| {
        let intrinsics = Intrinsics::from_horizontal_fov(w, h, 90f64.to_radians());
        (format!("{w}x{h}"), camera(intrinsics, pose))
    });
    Case { name: format!("synthetic_{}k", count / 1000), splats, cameras: cameras.into() }
}

fn from_file(path: &Path) -> Case {
    let splats = ply::read(path).expect("a splat scene").splats;
    let middle = |axis: usize| {
        let mut values: Vec<f32> = splats.means_m.iter().map(|mean| mean[axis]).collect();
        values.sort_by(f32::total_cmp);
        f64::from(values[values.len() / 2])
    };
    let pose = Pose::new(
        DVec3::new(middle(0), middle(1), middle(2)),
        DQuat::from_mat3(&DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X)),
    );
    let cameras = sizes().map(|(w, h)| {
        let intrinsics = Intrinsics::from_horizontal_fov(w, h, 90f64.to_radians());
        (format!("{w}x{h}"), camera(intrinsics, pose))
    });
    let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    Case { name, splats, cameras: cameras.into() }
}

/// Returns the scenes of `../shared`, at the reference poses and both sizes.
fn captured() -> Vec<Case> {
    #[derive(Deserialize)]
    struct File {
        fx: f64,
        fy: f64,
        cx: f64,
        cy: f64,
        w: u32,
        h: u32,
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
        let mut cameras = Vec::new();
        for pose in ["p0", "p1"] {
            let path = shared.join(format!("ref/{scene}_{pose}_320x240.json"));
            let text = std::fs::read_to_string(path).expect("a reference camera");
            let c: File = serde_json::from_str(&text).expect("a camera");
            let row = |i: usize| DVec3::new(c.w2c[i][0], c.w2c[i][1], c.w2c[i][2]);
            let rotation = DMat3::from_cols(row(0), row(1), row(2));
            let translation = DVec3::new(c.w2c[0][3], c.w2c[1][3], c.w2c[2][3]);
            let world_from_cam = Pose::new(-(rotation * translation), DQuat::from_mat3(&rotation));
            for (w, h) in sizes() {
                let zoom = f64::from(w) / f64::from(c.w);
                assert_eq!(c.h * w, h * c.w, "the same shape");
                let intrinsics = Intrinsics {
                    width_px: w,
                    height_px: h,
                    fx_px: c.fx * zoom,
                    fy_px: c.fy * zoom,
                    cx_px: c.cx * zoom,
                    cy_px: c.cy * zoom,
                    distortion: Distortion::None,
                };
                cameras.push((format!("{pose}_{w}x{h}"), camera(intrinsics, world_from_cam)));
            }
        }
        cases.push(Case { name: scene.to_owned(), splats: loaded.splats, cameras });
    }
    cases
}

fn sizes() -> [(u32, u32); 2] {
    [(320, 240), (640, 480)]
}

fn camera(
    intrinsics: Intrinsics,
    world_from_cam: Pose<vizflyt_protocol::geometry::World, vizflyt_protocol::geometry::Cam>,
) -> Camera {
    Camera::new(intrinsics, world_from_cam, 0.01)
}
