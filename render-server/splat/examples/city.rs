//! City of tens of millions of splats: generates it as a streamed scene, and flies through the packed scene.
//!
//! ```text
//! cargo run --release -p vizflyt-splat --example city -- make FOLDER CHUNKS SPLATS_PER_CHUNK
//! cargo run --release -p vizflyt-splat --example city -- fly PACKED MEMORY_MIB SECONDS
//! ```
//! Chunks are quarters of 3 by 3 blocks of houses and parks, next to each other. The camera flies along a street at
//! 10 m/s in real time, at up to 30 images per second. Then every fifth image is rendered again with all blocks that
//! it needs, if they fit, and compared. `tests/bench/city` runs both and prints the time of each. Linux only: it
//! reads /proc.

use std::error::Error;
use std::path::Path;
use std::time::{Duration, Instant};

use glam::{DMat3, DQuat, DVec3, Vec3};
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_splat::{
    Camera, CpuRenderer, Loading, PackedScene, Rasterizer, RgbdImage, Splats, format,
};

use city::city;
#[path = "../benches/detail/city.rs"]
mod city;

/// Blocks of houses along the side of a chunk.
const BLOCKS: usize = 3;
/// Side of a chunk. [m]
const CHUNK_M: f32 = 40.0 * BLOCKS as f32;
const SPEED_MPS: f64 = 10.0;
const IMAGES_HZ: f64 = 30.0;
/// Interval of compared images.
const COMPARED: usize = 5;
/// Length of the start of the flight, with an empty pool. Results are printed with and without it. [s]
const FIRST_S: f64 = 2.0;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match words[..] {
        ["make", folder, chunks, splats] => {
            make(Path::new(folder), chunks.parse()?, splats.parse()?)
        }
        ["fly", packed, memory_mib, seconds] => {
            fly(Path::new(packed), memory_mib.parse()?, seconds.parse()?)
        }
        _ => Err("see the first lines of this file".into()),
    }
}

/// Writes a streamed scene of chunks in a square.
fn make(folder: &Path, chunks: usize, splats: usize) -> Result<(), Box<dyn Error>> {
    std::fs::create_dir_all(folder)?;
    let quarter = city(splats, BLOCKS, 0);
    let side = chunks.isqrt().max(1);
    let (mut names, mut nodes) = (Vec::new(), Vec::new());
    for chunk in 0..chunks {
        let offset_m = Vec3::new((chunk / side) as f32, (chunk % side) as f32, 0.0) * CHUNK_M;
        let means_m = quarter.means_m.iter().map(|mean_m| mean_m + offset_m).collect();
        let placed = Splats { means_m, ..quarter.clone() };
        let name = format!("{chunk}.sog");
        std::fs::write(folder.join(&name), format::encode(format::Format::Sog, &placed)?)?;
        nodes.push(format!(
            r#"{{"lods": {{"0": {{"file": {chunk}, "offset": 0, "count": {}}}}}}}"#,
            placed.len()
        ));
        names.push(format!("{name:?}"));
    }
    let (names, nodes) = (names.join(", "), nodes.join(", "));
    let tree = format!(
        r#"{{"version": 1, "lodLevels": 1, "filenames": [{names}], "tree": {{"children": [{nodes}]}}}}"#
    );
    std::fs::write(folder.join("lod-meta.json"), tree)?;
    Ok(())
}

/// Returns the camera after some seconds: 8 m up in a street, looking along it and from side to side.
fn camera(seconds: f64) -> Camera {
    let ahead = DQuat::from_mat3(&DMat3::from_cols(-DVec3::Y, -DVec3::Z, DVec3::X));
    let turn = DQuat::from_rotation_z(0.5 * (0.7 * seconds).sin()) * ahead;
    let at_m = DVec3::new(-60.0 + SPEED_MPS * seconds, 380.0, 8.0);
    Camera::new(Intrinsics::from_horizontal_fov(320, 240, 1.2), Pose::new(at_m, turn), 0.05)
}

/// Image of the flight.
struct Flown {
    at_s: f64,
    took_ms: f64,
    stand_ins: usize,
    /// Needed blocks as a share of those that fit.
    needed: f64,
    max_error_px: f32,
    /// Colours, for compared images only.
    rgb: Option<Vec<u8>>,
}

fn fly(packed: &Path, memory_mib: usize, seconds: f64) -> Result<(), Box<dyn Error>> {
    let opened = |loading| -> Result<CpuRenderer, Box<dyn Error>> {
        Ok(CpuRenderer::streamed(PackedScene::open(packed)?, &[], memory_mib << 20, loading)?)
    };
    let start = Instant::now();
    let mut renderer = opened(Loading::Live)?;
    println!(
        "opened: {} splats in {:.0} ms, {}",
        renderer.workload().splats,
        start.elapsed().as_secs_f64() * 1e3,
        renderer.name()
    );
    let flown = flight(&mut renderer, seconds)?;
    println!("peak memory of the flight: {} MB", peak_mb()?);
    tell("all", &flown);
    tell("after 2 s", &flown[flown.partition_point(|image| image.at_s < FIRST_S)..]);
    drop(renderer);
    compare(&mut opened(Loading::Whole)?, &flown);
    Ok(())
}

fn flight(renderer: &mut CpuRenderer, seconds: f64) -> Result<Vec<Flown>, Box<dyn Error>> {
    let (mut flown, mut images) = (Vec::new(), [RgbdImage::default()]);
    let start = Instant::now();
    let mut due_s = 0.0;
    while due_s < seconds {
        let early_s = due_s - start.elapsed().as_secs_f64();
        if early_s > 0.0 {
            std::thread::sleep(Duration::from_secs_f64(early_s));
        }
        let at_s = start.elapsed().as_secs_f64();
        renderer.render(&[], &[camera(at_s)], &mut images)?;
        let took_s = start.elapsed().as_secs_f64() - at_s;
        due_s = (due_s + 1.0 / IMAGES_HZ).max(at_s + took_s);
        let streaming = renderer.streaming().ok_or("a packed scene is streamed")?;
        let rgb = flown.len().is_multiple_of(COMPARED).then(|| rgb8(&images[0]));
        flown.push(Flown {
            at_s,
            took_ms: took_s * 1e3,
            stand_ins: streaming.stand_ins,
            needed: streaming.needed as f64 / streaming.most as f64,
            max_error_px: streaming.max_error_px,
            rgb,
        });
    }
    Ok(flown)
}

fn rgb8(image: &RgbdImage) -> Vec<u8> {
    let mut rgb = Vec::new();
    image.write_rgb8(&mut rgb);
    rgb
}

/// Prints the results of images.
fn tell(which: &str, flown: &[Flown]) {
    let mut took_ms: Vec<f64> = flown.iter().map(|image| image.took_ms).collect();
    took_ms.sort_unstable_by(f64::total_cmp);
    let at = |share: f64| took_ms[(share * (took_ms.len() - 1) as f64).round() as usize];
    let share = |of: &dyn Fn(&&Flown) -> bool| {
        100.0 * flown.iter().filter(of).count() as f64 / flown.len() as f64
    };
    let greatest = |of: fn(&Flown) -> f64| flown.iter().map(of).fold(0.0, f64::max);
    println!(
        "{which}: {} images, p50 {:.1} ms, p99 {:.1} ms, most {:.1} ms; in {:.1} % with stand-ins for missing blocks \
         (at most {:.0} blocks); needed at most {:.0} % of the memory, allowed error at most {:.2} px",
        flown.len(),
        at(0.5),
        at(0.99),
        at(1.0),
        share(&|image| image.stand_ins > 0),
        greatest(|image| image.stand_ins as f64),
        100.0 * greatest(|image| image.needed),
        greatest(|image| f64::from(image.max_error_px)),
    );
}

/// Renders images again with all needed blocks, and prints their similarity to those of the flight.
fn compare(renderer: &mut CpuRenderer, flown: &[Flown]) {
    let (mut like_db, mut same) = (Vec::new(), 0);
    let mut images = [RgbdImage::default()];
    for image in flown {
        let Some(rgb) = &image.rgb else { continue };
        if let Err(why) = renderer.render(&[], &[camera(image.at_s)], &mut images) {
            println!("at {:.1} s cannot compare: {why}", image.at_s);
            continue;
        }
        let whole = rgb8(&images[0]);
        let square = |(a, b): (&u8, &u8)| f64::from(a.abs_diff(*b)).powi(2);
        let mean = rgb.iter().zip(&whole).map(square).sum::<f64>() / whole.len() as f64;
        if mean == 0.0 {
            same += 1;
        } else {
            like_db.push(10.0 * (255.0 * 255.0 / mean).log10());
        }
    }
    like_db.sort_unstable_by(f64::total_cmp);
    println!("compared with complete images: {same} identical, {} differ", like_db.len());
    if let [least_db, ..] = like_db[..] {
        println!(
            "PSNR of the latter: minimum {least_db:.1} dB, median {:.1} dB",
            like_db[like_db.len() / 2]
        );
    }
}

/// Returns the maximum resident size. [MB]
fn peak_mb() -> Result<u64, Box<dyn Error>> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).ok_or("no VmHWM")?;
    Ok(line.trim().trim_end_matches("kB").trim().parse::<u64>()? / 1000)
}
