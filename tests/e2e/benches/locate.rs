//! Accuracy and speed of the localization by tags: the tables of docs/BENCHMARKS.md.
//!
//! `cargo bench -p vizflyt-e2e --bench locate`; a number after `--` is the duration of each flight in seconds, 0 omits
//! flights.

#[path = "../tests/accuracy/flights.rs"]
mod flights;

use flights::{Figures, Path, fly, fly_over_mat, lemniscate, pads, pose_on, spiral, square};
use glam::{DVec2, DVec3};
use nix::time::{ClockId, clock_gettime};
use vizflyt_protocol::time::HostTime;
use vizflyt_tags::camera::TagCamera;
use vizflyt_tags::detect::{Detector, DetectorSettings, Region};
use vizflyt_tags::family::TagFamily;
use vizflyt_tags::locate::{LocateSettings, Locator, StampedImage};
use vizflyt_tags::simulated::{Sensor, SimulatedCamera, Truth, cube, over_mat, webcams};

fn main() {
    // cargo passes `--bench` to the program.
    let seconds = std::env::args().skip(1).find_map(|word| word.parse::<f64>().ok()).unwrap_or(4.0);
    if seconds > 0.0 {
        accuracy(seconds);
    }
    println!("\n| 1280x720, one thread, processor time | p50 [ms] | p99 [ms] |\n|---|---|---|");
    speed();
}

fn accuracy(seconds: f64) {
    let head = |first: &str| {
        println!(
            "\n| {first} | rms [mm] | p99 [mm] | attitude rms [deg] | located [%] | squared error / predicted |"
        );
        println!("|---|---|---|---|---|---|");
    };
    let free = |cameras: Vec<TagCamera>, path: Path, speed_mps: f64| {
        fly(cameras, &[cube()], Sensor::default(), false, seconds, |t_s| {
            pose_on(path, speed_mps, t_s)
        })
    };
    head("two webcams, the cube of 0.25 m: path and speed");
    for (name, path) in [("square", square as Path), ("spiral", spiral), ("lemniscate", lemniscate)]
    {
        for speed_mps in [0.5, 1.0, 2.0, 3.0] {
            row(&format!("{name}, {speed_mps} m/s"), &free(webcams(2), path, speed_mps));
        }
    }
    head("number of webcams, lemniscate at 1 m/s");
    for count in 1..=4 {
        row(&count.to_string(), &free(webcams(count), lemniscate, 1.0));
    }
    let together = fly(webcams(2), &[cube()], Sensor::default(), true, seconds, |t_s| {
        pose_on(lemniscate, 2.0, t_s)
    });
    row("2, exposed together, 2 m/s", &together);
    head("one webcam, distance to the cube, hovering");
    let camera = webcams(1).remove(0);
    let axis = (DVec3::new(5.5, -0.3, 1.0) - DVec3::new(-0.4, 2.0, 3.3)).normalize();
    for distance_m in [1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0] {
        let at = DVec3::new(-0.4, 2.0, 3.3) + axis * distance_m;
        let hover =
            move |s_m: f64| at + 0.1 * DVec3::new(s_m.sin(), (1.3 * s_m).cos(), (0.7 * s_m).sin());
        let figures =
            fly(vec![camera.clone()], &[cube()], Sensor::default(), false, seconds, |t_s| {
                pose_on(hover, 0.5, t_s)
            });
        row(&format!("{distance_m} m"), &figures);
    }
    head("webcam under the vehicle, height over the mat, 1 m/s");
    for height_m in [0.5, 0.7, 1.0, 1.5, 2.0, 2.5] {
        let over =
            move |s_m: f64| lemniscate(s_m) * DVec3::new(1.0, 0.8, 0.0) + DVec3::Z * height_m;
        let figures =
            fly_over_mat(pads(), 7, SimulatedCamera::new, seconds, |t_s| pose_on(over, 1.0, t_s));
        row(&format!("{height_m} m"), &figures);
    }
}

fn row(name: &str, figures: &Figures) {
    println!(
        "| {name} | {:.1} | {:.1} | {:.2} | {:.1} | {:.2} |",
        figures.rms_mm(),
        figures.p99_mm(),
        figures.rms_deg(),
        figures.availability_percent(),
        figures.consistency()
    );
}

fn speed() {
    let time = |name: &str, mut work: Box<dyn FnMut(usize) + '_>| {
        let mut times_ms: Vec<f64> = (0..60)
            .map(|i| {
                let begun = thread_ms();
                work(i);
                thread_ms() - begun
            })
            .collect();
        times_ms.sort_by(f64::total_cmp);
        println!("| {name} | {:.2} | {:.2} |", times_ms[30], times_ms[58]);
    };
    for (name, camera, layout) in [
        ("tracking the cube, detect and solve", webcams(1).remove(0), cube()),
        (
            "tracking a mat, 1 m below",
            over_mat::camera(),
            over_mat::floor(pads()).print().expect("there are tags enough").layout,
        ),
    ] {
        let is_mat = layout.tags.len() > 5;
        let images = images(&camera, &layout, |t_s| {
            let pose = pose_on(lemniscate, 1.0, t_s);
            let z_m = if is_mat { 1.0 } else { pose.translation_m.z };
            vizflyt_protocol::geometry::Pose::new(
                pose.translation_m.truncate().extend(z_m),
                pose.rotation,
            )
        });
        let mut locator = Locator::new(
            vec![camera.clone()],
            std::slice::from_ref(&layout),
            LocateSettings::default(),
        )
        .expect("the lab is sound");
        // The first images are for detection.
        for (stamp, image) in &images[..4] {
            locator.handle_images(&[StampedImage { camera: 0, stamp: *stamp, image }]);
        }
        time(
            name,
            Box::new(|i| {
                let (stamp, image) = &images[4 + i];
                let outcome =
                    locator.handle_images(&[StampedImage { camera: 0, stamp: *stamp, image }]);
                assert!(outcome.looks[0].region.is_some(), "tracked");
            }),
        );
        let mut simulated = SimulatedCamera::new(camera.clone(), Sensor::default());
        let mut truth = Truth::default();
        let still = pose_on(lemniscate, 1.0, 0.0);
        let mut tick = 0;
        time(
            if is_mat { "drawing the mat, for the simulated webcam" } else { "drawing the cube" },
            Box::new(|_| {
                while simulated.expose(&truth, std::slice::from_ref(&layout), true).is_none() {
                    tick += 1;
                    let t_s = f64::from(tick) / 400.0;
                    truth.push(HostTime::from_ns(5_000_000_000).plus_seconds(t_s), still);
                }
            }),
        );
        if is_mat {
            continue;
        }
        let mut detector = Detector::new(&[TagFamily::Tag36h11], DetectorSettings::default());
        for (name, fine) in
            [("searching the whole image, coarse", false), ("searching it, fine", true)]
        {
            time(name, Box::new(|i| drop(detector.search(&images[i].1, &camera.intrinsics, fine))));
        }
        let all = Region {
            least_px: DVec2::ZERO,
            most_px: DVec2::new(1280.0, 720.0),
            tag_edge_px: Some(100.0),
        };
        time(
            "looking at all of it for tags of 100 px",
            Box::new(|i| drop(detector.look(&images[i].1, &all, &camera.intrinsics))),
        );
    }
}

/// Returns the processor time of this thread, which does not include other programs. [ms]
fn thread_ms() -> f64 {
    let time = clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).expect("the clock exists");
    time.tv_sec() as f64 * 1e3 + time.tv_nsec() as f64 * 1e-6
}

fn images(
    camera: &TagCamera,
    layout: &vizflyt_tags::layout::TagLayout,
    pose_at: impl Fn(
        f64,
    ) -> vizflyt_protocol::geometry::Pose<
        vizflyt_protocol::geometry::World,
        vizflyt_protocol::geometry::Body,
    >,
) -> Vec<(HostTime, vizflyt_tags::image::Gray)> {
    let mut simulated = SimulatedCamera::new(camera.clone(), Sensor::default());
    let mut truth = Truth::default();
    let mut images = Vec::new();
    let layouts = std::slice::from_ref(layout);
    for tick in 0.. {
        let t_s = f64::from(tick) / 400.0;
        truth.push(HostTime::from_ns(5_000_000_000).plus_seconds(t_s), pose_at(t_s));
        images.extend(simulated.expose(&truth, layouts, false));
        if images.len() == 70 {
            break;
        }
    }
    images
}
