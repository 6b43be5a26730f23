//! What level of detail saves and costs: time, likeness to full detail, memory, packing.
//!
//! ```text
//! cargo bench -p vizflyt-splat --bench detail [-- [plot FILE.svg] [FILTER]]
//! ```

use std::time::Instant;

use glam::{DMat3, DQuat, DVec3, Vec3};
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_splat::{Camera, CpuRenderer, Detail, Rasterizer, RgbdImage, Splats};

#[path = "scenes/city.rs"]
mod city;
#[path = "../tests/lod/likeness.rs"]
mod likeness;

fn look(from: DVec3, to: DVec3) -> Camera {
    let z = (to - from).normalize();
    let x = z.cross(DVec3::Z).normalize();
    let rotation = DMat3::from_cols(x, z.cross(x), z);
    Camera {
        intrinsics: Intrinsics::from_horizontal_fov(640, 480, 90f64.to_radians()),
        world_from_cam: Pose::new(from, DQuat::from_mat3(&rotation)),
        near_m: 0.05,
        background: [0.5, 0.6, 0.8],
    }
}

fn views() -> Vec<(&'static str, Camera)> {
    vec![
        ("street", look(DVec3::new(-100.0, -20.0, 1.6), DVec3::new(0.0, -18.0, 3.0))),
        ("park", look(DVec3::new(-60.0, -58.0, 6.0), DVec3::new(20.0, 10.0, 4.0))),
        ("roofs", look(DVec3::new(-140.0, -140.0, 60.0), DVec3::new(0.0, 0.0, 10.0))),
        ("from above", look(DVec3::new(-10.0, -150.0, 160.0), DVec3::new(0.0, -10.0, 0.0))),
    ]
}

/// Foliage that fills the view: splats of a pixel or two, many layers deep.
fn thicket(count: usize) -> Splats {
    let random = &mut city::Random::new(3);
    let mut splats = Splats::default();
    for _ in 0..count {
        splats.means_m.push(Vec3::new(
            random.range(3.0, 9.0),
            random.range(-9.0, 9.0),
            random.range(-7.0, 7.0),
        ));
        splats.scales_m.push(Vec3::new(0.02, 0.012, 0.003) * random.range(0.5, 1.5));
        let q = [(); 4].map(|()| random.range(-1.0, 1.0));
        splats.rotations.push(glam::Quat::from_array(q).normalize());
        splats.opacities.push(random.range(0.1, 1.0));
        splats.sh.extend([(); 3].map(|()| random.range(-1.0, 1.0)));
    }
    splats
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if !arguments.iter().any(|argument| argument == "--bench") {
        return;
    }
    let words: Vec<&String> = arguments.iter().filter(|a| !a.starts_with("--")).collect();
    let count: usize = words.first().map_or(5_000_000, |w| w.parse().unwrap());
    let degree: u8 = words.get(1).map_or(0, |w| w.parse().unwrap());
    let errors: Vec<f32> = words.iter().skip(2).map(|w| w.parse().unwrap()).collect();
    let errors = if errors.is_empty() { vec![0.2, 0.35, 0.5, 0.7] } else { errors };
    let ahead = look(DVec3::ZERO, DVec3::X);
    let scenes = [
        ("city", city::city(count, 8, degree), views()),
        ("thicket", thicket(count), vec![("inside", ahead)]),
    ];
    for (name, splats, views) in &scenes {
        println!("{name}: {} splats", splats.len());
        let start = Instant::now();
        let mut full = CpuRenderer::new(splats);
        println!("  packed in {:.2} s", start.elapsed().as_secs_f32());
        let truth: Vec<_> =
            views.iter().map(|(view, camera)| measure(view, &mut full, camera)).collect();
        for &max_error_px in &errors {
            let start = Instant::now();
            let mut renderer = CpuRenderer::with_detail(splats, Detail::Adaptive { max_error_px });
            println!("  {max_error_px} px: packed in {:.2} s", start.elapsed().as_secs_f32());
            for ((view, camera), truth) in views.iter().zip(&truth) {
                let image = measure(view, &mut renderer, camera);
                println!("        {}", likeness::Likeness::of(&image, truth));
            }
        }
    }
}

fn measure(view: &str, renderer: &mut CpuRenderer, camera: &Camera) -> RgbdImage {
    let mut image = [RgbdImage::default()];
    for _ in 0..2 {
        renderer.render(&[], &[*camera], &mut image).expect("a valid camera");
    }
    let before = cpu_ms();
    let mut times: Vec<_> = (0..7)
        .map(|_| renderer.render(&[], &[*camera], &mut image).expect("a valid camera"))
        .collect();
    let spent = cpu_ms() / 14.0 - before / 14.0;
    times.sort_by(|a, b| a.total_ms.total_cmp(&b.total_ms));
    let t = times[times.len() / 2];
    let work = renderer.workload();
    println!(
        "    {view:10} {:6.1} ms, cpu/2 {spent:6.1} (cull {:.2} project {:.1} sort {:.1} bin {:.1} blend {:.1}), {} visible, {} pairs",
        t.total_ms,
        t.cull_ms,
        t.project_ms,
        t.sort_ms,
        t.bin_ms,
        t.blend_ms,
        work.visible,
        work.pairs
    );
    let [image] = image;
    image
}

/// Returns the processor time of all threads so far. [ms]
fn cpu_ms() -> f64 {
    let tasks = std::fs::read_dir("/proc/self/task").expect("Linux");
    tasks
        .filter_map(|task| std::fs::read_to_string(task.ok()?.path().join("schedstat")).ok())
        .filter_map(|line| line.split(' ').next()?.parse::<f64>().ok())
        .sum::<f64>()
        * 1e-6
}
