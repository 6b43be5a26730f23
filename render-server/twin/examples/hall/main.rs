//! Captures a generated room, rebuilds it from the photos, and prints the errors of the twin.
//!
//! ```text
//! cargo run --release -p vizflyt-twin --example hall
//! cargo run --release -p vizflyt-twin --example hall -- steps=1000 splats=40000 folder=hall sheet=hall.png
//! ```
//! `race=SEED` takes a race hall on a normal walk of `seconds` instead of the room. `save` writes the trained scene;
//! `scene` evaluates and carves a given scene instead of training. `folder` keeps the capture as a COLMAP folder.
//! `sheet` shows held-out photos: truth, twin, and the depths of both. Other keys are those of [`Options`].

mod capture;
mod folder;
mod judge;
mod profile;

use std::error::Error;
use std::path::PathBuf;

use vizflyt_scenes::{SceneKind, film_set, generate};
use vizflyt_splat::{CpuRenderer, Splats};
use vizflyt_twin::carve::{CarveCounts, Seen};
use vizflyt_twin::{Dataset, Options, Trainer};

fn main() -> Result<(), Box<dyn Error>> {
    let mut options = Options::default();
    let (mut kept, mut sheet, mut trained, mut race, mut save) = (None, None, None, None, None);
    let (mut photos, mut seconds) = (80, 50.0);
    for arg in std::env::args().skip(1) {
        let (key, value) = arg.split_once('=').ok_or("options are KEY=VALUE")?;
        let number = || value.parse::<f32>();
        match key {
            "steps" => options.steps = value.parse()?,
            "splats" => options.splats = value.parse()?,
            "degree" => options.degree = value.parse()?,
            "seed" => options.seed = value.parse()?,
            "dssim" => options.weights.dssim = number()?,
            "depth" => options.weights.depth = number()?,
            "spread" => options.weights.spread = number()?,
            "bend" => options.weights.bend = number()?,
            "opacity" => options.tolls.opacity = number()?,
            "scale" => options.tolls.scale = number()?,
            "thickness" => options.tolls.thickness = number()?,
            "needle" => options.tolls.needle = number()?,
            "antialiased" => options.antialiased = number()? > 0.0,
            "scene" => trained = Some(PathBuf::from(value)),
            "save" => save = Some(PathBuf::from(value)),
            "race" => race = Some(value.parse()?),
            "photos" => photos = value.parse()?,
            "seconds" => seconds = value.parse()?,
            "folder" => kept = Some(PathBuf::from(value)),
            "sheet" => sheet = Some(PathBuf::from(value)),
            _ => return Err(format!("unknown option '{key}'").into()),
        }
    }
    let (scene, poses) = match race {
        Some(seed) => {
            let set = film_set(SceneKind::Race, seed, seconds, false)?;
            (set.scene, capture::walked(&set.walk, photos))
        }
        None => (generate(SceneKind::Room, 3), capture::looped(photos)),
    };
    let capture = capture::capture(&scene.splats, &poses, 1);
    let scratch = tempfile::tempdir()?;
    let folder = kept.as_deref().unwrap_or(scratch.path());
    folder::write(&capture, folder)?;
    let dataset = Dataset::read(folder, None)?;
    println!(
        "capture      {} photos of {} splats, {} points",
        dataset.photos.len(),
        scene.splats.len(),
        dataset.points.len()
    );

    let splats = match trained {
        Some(path) => vizflyt_splat::format::read(&path)?.splats,
        None => train(&dataset, options)?,
    };
    if let Some(path) = save {
        vizflyt_splat::format::write(path, &splats)?;
    }
    let only = |i: usize| i.is_multiple_of(options.hold_out);
    let judge = |splats: &Splats, seen: Option<&Seen>| {
        judge::judge(splats, &scene.splats, &scene.arena, &capture, seen, only)
    };
    print(&judge(&splats, None));
    let carved = judge::carve(&dataset, &splats, &scene.arena);
    let CarveCounts { looked_through, on_path, seen, voxels, seconds, .. } = carved.counts;
    println!(
        "carved       {looked_through} splats looked through, {on_path} on the camera's path; {:.0} % of the \
         voxels seen, in {seconds:.1} s",
        100.0 * seen as f64 / voxels as f64
    );
    let splats = carved.splats;
    print(&judge(&splats, Some(&carved.seen)));
    if let Some(path) = sheet {
        draw(&splats, &capture, &path)?;
    }
    Ok(())
}

/// Trains, and prints the progress.
fn train(dataset: &Dataset, options: Options) -> Result<Splats, Box<dyn Error>> {
    let start_s = cpu_s();
    let mut trainer = Trainer::new(dataset, options);
    while trainer.steps() < options.steps {
        let parts = trainer.step();
        if trainer.steps().is_multiple_of(500) {
            println!(
                "step {:7} L1 {:.4}, SSIM {:.3}, depth {:.4}, spread {:.4}, {} splats, {:.1} CPU-ms a step",
                trainer.steps(),
                parts.l1,
                parts.ssim,
                parts.depth,
                parts.spread,
                trainer.gaussians().len(),
                (cpu_s() - start_s) * 1e3 / f64::from(trainer.steps())
            );
        }
    }
    let took_s = cpu_s() - start_s;
    let quality = trainer.judge().ok_or("no photo was held out")?;
    let splats = trainer.splats();
    println!("processor    {took_s:.0} s for {} steps, {} splats", options.steps, splats.len());
    println!("held out     PSNR {:.2} dB, SSIM {:.3}", quality.psnr_db, quality.ssim);
    Ok(splats)
}

fn print(verdict: &judge::Verdict) {
    println!(
        "depth        median error {:.2} %, {:.1} % of pixels within 10 %, PSNR {:.2} dB",
        verdict.depth_median * 100.0,
        verdict.within_tenth * 100.0,
        verdict.psnr_db
    );
    println!(
        "obstacles    {:.2} times the true voxels, {:.2} of those next to seen space; within the fence {} where {} are \
         true; {} on the camera's path",
        verdict.occupied,
        verdict.beside_seen,
        verdict.within_fence,
        verdict.truly_within_fence,
        verdict.on_way
    );
    println!("voxels       {}", verdict.profile);
}

/// Writes truth and twin side by side, colour and depth, for some held-out photos.
fn draw(
    splats: &Splats,
    capture: &capture::Capture,
    path: &std::path::Path,
) -> Result<(), Box<dyn Error>> {
    let mut renderer = CpuRenderer::new(splats);
    let (width, height) = (capture.intrinsics.width_px, capture.intrinsics.height_px);
    let shown = [0usize, 16, 40, 56];
    let mut sheet = image::RgbImage::new(4 * width, shown.len() as u32 * height);
    for (row, i) in (0..).zip(shown) {
        let photo = &capture.photos[i];
        let image = capture::render(&mut renderer, capture.intrinsics, photo.world_from_cam);
        let mut rgb = Vec::new();
        image.write_rgb8(&mut rgb);
        let depth_m = capture::depth_m(&image);
        for n in 0..capture.intrinsics.pixels() {
            let (x, y) = (n as u32 % width, n as u32 / width + row * height);
            let colour = |rgb: &[u8]| image::Rgb([rgb[3 * n], rgb[3 * n + 1], rgb[3 * n + 2]]);
            let grey = |depth_m: f32| image::Rgb([(depth_m * 18.0).min(255.0) as u8; 3]);
            sheet.put_pixel(x, y, colour(&photo.rgb));
            sheet.put_pixel(x + width, y, colour(&rgb));
            sheet.put_pixel(x + 2 * width, y, grey(photo.true_depth_m[n]));
            sheet.put_pixel(x + 3 * width, y, grey(depth_m[n]));
        }
    }
    sheet.save(path)?;
    Ok(())
}

/// Returns the processor time of this process; 0 if unavailable. [s]
fn cpu_s() -> f64 {
    /// Linux's `USER_HZ`.
    const TICKS_PER_S: f64 = 100.0;
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // Fields 14 and 15; the name before them may contain spaces.
    let fields: Vec<&str> = stat.rsplit(") ").next().unwrap_or("").split(' ').collect();
    let ticks = |i: usize| fields.get(i).and_then(|v| v.parse::<f64>().ok()).unwrap_or(0.0);
    (ticks(11) + ticks(12)) / TICKS_PER_S
}
