//! Milliseconds per measurement of each named sensor in the forest and the race, beside an image of the same place.
//!
//! ```text
//! cargo bench -p vizflyt-scenes --bench sensors [-- NAME ...]
//! ```
//!
//! Times are of the whole machine's cores: compare figures of one run with each other. Where others use the machine, the least
//! of the repetitions is the most meaningful; with `RAYON_NUM_THREADS=1` it is close to the processor's time.

use std::time::Instant;

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Intrinsics, Pose, Sensor, World, body_from_forward_cam};
use vizflyt_scenes::{SceneKind, generate};
use vizflyt_splat::sensor::presets::{PRESETS, Preset};
use vizflyt_splat::sensor::{Lidar, Motion, Radar, RangeFinder, SensorScene, Sonar};
use vizflyt_splat::{Camera, CpuRenderer, Rasterizer, RgbdImage, Scene};

const REPETITIONS: u64 = 60;

fn main() {
    // `cargo test` runs benches too, without this flag: nothing to test here.
    if !std::env::args().any(|argument| argument == "--bench") {
        return;
    }
    let asked: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let is_asked = |name: &str| asked.is_empty() || asked.iter().any(|asked| asked == name);
    for (kind, p_m) in [
        (SceneKind::Forest, DVec3::new(7.5, 0.8, 1.3)),
        (SceneKind::Race, DVec3::new(3.2, 0.9, 1.6)),
    ] {
        let scene = generate(kind, 7);
        println!("{kind} 7, {} splats; least and median of {REPETITIONS} [ms]", scene.splats.len());
        let still = Scene::from(&scene.splats);
        let start = Instant::now();
        let packed = SensorScene::new(still);
        println!("  {:<14} {:8.1}", "packed in", start.elapsed().as_secs_f64() * 1e3);

        let level: Pose<World, Body> = Pose::new(p_m, DQuat::IDENTITY);
        let camera = Camera::new(
            Intrinsics::from_horizontal_fov(320, 240, 1.5),
            level * body_from_forward_cam(DVec3::ZERO, 0.0),
            0.05,
        );
        let mut renderer = CpuRenderer::new(still);
        let mut images = [RgbdImage::default()];
        report("image 320x240", &mut |_| {
            renderer.render(&[], std::slice::from_ref(&camera), &mut images).unwrap();
            images[0].alpha.len()
        });

        // At 2 m/s and a quarter of a turn a second, as it flies.
        let begin: Pose<World, Sensor> = Pose::new(p_m, DQuat::IDENTITY);
        let end = Pose::new(p_m + DVec3::X * 0.2, DQuat::from_rotation_z(0.157));
        let motion = Motion { world_from_sensor: [begin, end], objects: &[], duration_s: 0.1 };
        for (name, _, preset) in PRESETS.into_iter().filter(|(name, ..)| is_asked(name)) {
            match preset() {
                Preset::Lidar(model) => {
                    let (lidar, mut points) = (Lidar::new(model).unwrap(), Vec::new());
                    report(name, &mut |seq| {
                        lidar.scan(&packed, &motion, 1, seq, &mut points).unwrap();
                        points.iter().filter(|point| point.range_m > 0.0).count()
                    });
                }
                Preset::Range(model) => {
                    let finder = RangeFinder::new(model).unwrap();
                    let measure = |seq| finder.measure(&packed, &motion, 1, seq).unwrap();
                    report(name, &mut |seq| usize::from(measure(seq).range_m > 0.0));
                }
                Preset::Sonar(model) => {
                    let sonar = Sonar::new(model).unwrap();
                    let measure = |seq| sonar.measure(&packed, &motion, 1, seq).unwrap();
                    report(name, &mut |seq| usize::from(measure(seq).range_m > 0.0));
                }
                Preset::Radar(model) => {
                    let (mut radar, mut found) = (Radar::new(model).unwrap(), Vec::new());
                    report(name, &mut |seq| {
                        radar.measure(&packed, &motion, 1, seq, &mut found).unwrap();
                        found.len()
                    });
                }
            }
        }
    }
}

/// Prints how long a measurement takes, and how many records are no gap.
fn report(name: &str, measure: &mut dyn FnMut(u64) -> usize) {
    let mut found = 0;
    let mut times: Vec<f64> = (0..REPETITIONS)
        .map(|seq| {
            let start = Instant::now();
            found = measure(seq);
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    println!("  {name:<14} {:8.3} {:8.3}   {found} records", times[0], times[times.len() / 2]);
}
