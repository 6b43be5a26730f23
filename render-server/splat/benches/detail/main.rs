//! Benchmark of level of detail: time, similarity to full detail, memory and packing.
//!
//! ```text
//! cargo bench -p vizflyt-splat --bench detail [-- [plot] [SPLATS] [FILTER]]
//! ```
//!
//! Scenes are generated: a quarter of a city at SH degree 0 and 3, and near foliage, where nothing can be merged.
//! FILTER selects scenes whose name contains it. `plot` writes `docs/render-cost.svg` instead. The processor time
//! divided by the number of threads is printed next to the median: it is the median on an otherwise idle machine.

mod plot;
mod scenes;

use std::time::Instant;

use vizflyt_splat::{Camera, CpuRenderer, Detail, Rasterizer, RgbdImage, Splats};

use scenes::city::city;
#[path = "../../tests/lod/likeness.rs"]
mod likeness;

/// Number of images of which the median is taken.
const IMAGES: usize = 15;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    // `cargo test` also runs benches, but without this flag; then nothing is measured.
    if !arguments.iter().any(|argument| argument == "--bench") {
        return;
    }
    let (mut count, mut filter, mut only_plot) = (5_000_000, String::new(), false);
    for argument in arguments.into_iter().filter(|argument| !argument.starts_with("--")) {
        match argument.parse() {
            Ok(splats) => count = splats,
            Err(_) if argument == "plot" => only_plot = true,
            Err(_) => filter = argument,
        }
    }
    if only_plot {
        return plot::draw();
    }
    let street = scenes::views();
    let inside = vec![("all near", scenes::ahead())];
    let compare = |name: &str, splats: &dyn Fn() -> Splats, views: &[(&str, Camera)]| {
        if name.contains(&filter) {
            compare(name, &splats(), views);
        }
    };
    println!(
        "640x480, {} threads: median (least) ms of {IMAGES} images; processor ms / threads",
        threads()
    );
    compare("city SH0", &|| city(count, 8, 0), &street);
    compare("city SH3", &|| city(count, 8, 3), &street);
    compare("thicket SH0", &|| scenes::thicket(count), &inside);
}

/// Prints the results of a scene in full and in adaptive detail.
fn compare(name: &str, splats: &Splats, views: &[(&str, Camera)]) {
    println!("\n{name}, {} splats", splats.len());
    let mut truth: Vec<(RgbdImage, f64)> = Vec::new();
    for detail in [Detail::Full, Detail::ADAPTIVE] {
        let (before_mb, start) = (resident_mb(), Instant::now());
        let mut renderer = CpuRenderer::with_detail(splats, detail);
        println!(
            "  {detail:?}: packed in {:.2} s, {:.0} MB",
            start.elapsed().as_secs_f32(),
            resident_mb() - before_mb
        );
        for (i, (view, camera)) in views.iter().enumerate() {
            let figures = measure(&mut renderer, camera);
            let work = renderer.workload();
            print!(
                "    {view:10} {:6.1} ({:.1}); {:6.1}  {:8} splats",
                figures.median_ms, figures.least_ms, figures.processor_ms, work.visible
            );
            if let Some((image, full_ms)) = truth.get(i) {
                let likeness = likeness::Likeness::of(&figures.image, image);
                println!(", x {:.1}, {likeness}", full_ms / figures.processor_ms);
            } else {
                println!();
                truth.push((figures.image, figures.processor_ms));
            }
        }
    }
}

/// Results of one camera.
struct Figures {
    median_ms: f32,
    least_ms: f32,
    /// Processor time of all threads, divided by their number. [ms]
    processor_ms: f64,
    image: RgbdImage,
}

fn measure(renderer: &mut CpuRenderer, camera: &Camera) -> Figures {
    let mut image = [RgbdImage::default()];
    let mut render_one =
        || renderer.render(&[], &[*camera], &mut image).expect("a valid camera").total_ms;
    render_one();
    render_one();
    let before_ms = processor_ms();
    let mut ms: Vec<f32> = (0..IMAGES).map(|_| render_one()).collect();
    let processor_ms = (processor_ms() - before_ms) / (IMAGES * threads()) as f64;
    ms.sort_by(f32::total_cmp);
    let [image] = image;
    Figures { median_ms: ms[IMAGES / 2], least_ms: ms[0], processor_ms, image }
}

fn threads() -> usize {
    std::thread::available_parallelism().map_or(1, std::num::NonZero::get)
}

/// Returns the total processor time of all threads; 0 if the system does not report it. [ms]
fn processor_ms() -> f64 {
    let tasks = std::fs::read_dir("/proc/self/task").into_iter().flatten();
    let spent_ns = tasks
        .filter_map(|task| std::fs::read_to_string(task.ok()?.path().join("schedstat")).ok())
        .filter_map(|line| line.split(' ').next()?.parse::<f64>().ok());
    spent_ns.sum::<f64>() * 1e-6
}

/// Returns the resident memory; 0 if the system does not report it. [MB]
fn resident_mb() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok());
    kib.unwrap_or(0.0) * 1024.0 * 1e-6
}
