//! Captures a generated room, rebuilds it from the photos, and says how far the twin is from the truth.

mod capture;
mod judge;

use std::time::Instant;

use vizflyt_scenes::{SceneKind, generate};
use vizflyt_twin::dataset::{Dataset, Photo, Point};
use vizflyt_twin::loss::{SeenPoint, Target};
use vizflyt_twin::{Options, Trainer, View};

fn main() {
    let mut options = Options { degree: 1, ..Options::default() };
    let mut shots = None;
    for arg in std::env::args().skip(1) {
        let (key, value) = arg.split_once('=').expect("key=value");
        let number = || value.parse::<f32>().expect("a number");
        match key {
            "steps" => options.steps = number() as u32,
            "splats" => options.splats = number() as usize,
            "degree" => options.degree = number() as u8,
            "dssim" => options.weights.dssim = number(),
            "depth" => options.weights.depth = number(),
            "spread" => options.weights.spread = number(),
            "opacity" => options.tolls.opacity = number(),
            "scale" => options.tolls.scale = number(),
            "thickness" => options.tolls.thickness = number(),
            "needle" => options.tolls.needle = number(),
            "exposure" => options.exposure = number() > 0.0,
            "shots" => shots = Some(value.to_owned()),
            _ => panic!("unknown {key}"),
        }
    }
    let scene = generate(SceneKind::Room, 3);
    let capture = capture::capture(&scene.splats, 1);
    let observed: usize = capture.points.iter().map(|p| p.seen.len()).sum();
    println!(
        "{} splats, {} points seen {observed} times",
        scene.splats.len(),
        capture.points.len()
    );
    let mut dataset = Dataset::default();
    for (i, photo) in capture.photos.iter().enumerate() {
        let view = View::new(&capture.intrinsics, &photo.world_from_cam, 0.05);
        let mut target = Target {
            width: view.width,
            height: view.height,
            rgb: photo.rgb.clone(),
            ..Target::default()
        };
        for point in &capture.points {
            for &(j, [x, y]) in &point.seen {
                if j == i
                    && let Some((_, z)) = view.project(point.p_world_m)
                {
                    target.points.push(SeenPoint {
                        pixel: (y as usize * view.width + x as usize) as u32,
                        z,
                    });
                }
            }
        }
        dataset.photos.push(Photo { name: i.to_string(), view, target });
    }
    dataset.points =
        capture.points.iter().map(|p| Point { position: p.p_world_m, rgb: p.rgb }).collect();
    let start = Instant::now();
    let cpu = cpu_s();
    let mut trainer = Trainer::new(&dataset, options);
    for i in 1..=options.steps {
        let parts = trainer.step();
        if i % 500 == 0 || i == 100 {
            println!(
                "{i:5} {parts:?} {} gaussians, {:.1} cpu-ms/step, {:.1} s",
                trainer.gaussians().len(),
                (cpu_s() - cpu) * 1e3 / f64::from(i),
                start.elapsed().as_secs_f64()
            );
        }
    }
    println!("{:?}", trainer.judge());
    let splats = trainer.splats();
    println!(
        "held out {:?}",
        judge::judge(&splats, &scene.splats, &scene.arena, &capture, |i| i % 8 == 0)
    );
    println!(
        "all      {:?}",
        judge::judge(&splats, &scene.splats, &scene.arena, &capture, |_| true)
    );
    if let Some(path) = shots {
        vizflyt_splat::ply::write(&path, &splats).unwrap();
        let mut renderer = vizflyt_splat::CpuRenderer::new(&splats);
        let (w, h) = (320u32, 240u32);
        let mut sheet = image::RgbImage::new(4 * w, 4 * h);
        for (row, i) in [0usize, 16, 40, 56].into_iter().enumerate() {
            let photo = &capture.photos[i];
            let image = capture::render(&mut renderer, capture.intrinsics, photo.world_from_cam);
            let mut rgb = Vec::new();
            image.write_rgb8(&mut rgb);
            let depth = capture::depth_m(&image);
            for n in 0..(w * h) as usize {
                let (x, y) = (n as u32 % w, n as u32 / w + row as u32 * h);
                let of = |rgb: &[u8]| image::Rgb([rgb[3 * n], rgb[3 * n + 1], rgb[3 * n + 2]]);
                let grey = |d: f32| image::Rgb([(d * 18.0).min(255.0) as u8; 3]);
                sheet.put_pixel(x, y, of(&photo.rgb));
                sheet.put_pixel(x + w, y, of(&rgb));
                sheet.put_pixel(x + 2 * w, y, grey(photo.true_depth_m[n]));
                sheet.put_pixel(x + 3 * w, y, grey(depth[n]));
            }
        }
        sheet.save(format!("{path}.png")).unwrap();
    }
}

/// Returns the processor time of this process. [s]
fn cpu_s() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(") ").next().unwrap_or("").split(' ').collect();
    let ticks = |i: usize| fields.get(i).and_then(|v| v.parse::<f64>().ok()).unwrap_or(0.0);
    (ticks(11) + ticks(12)) / 100.0
}
