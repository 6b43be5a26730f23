//! Flies generated courses in lock-step, without autopilot and server, with images and attitude only: `cargo run -p
//! vizflyt-race --example rehearse -- p5 0 1 2`. With a single seed it reports every 0.5 s.
//!
//! `-- race 1 twin=FOLDER` flies the race hall of a seed in its twin from a capture. The images are those of the twin
//! (`FOLDER/scene.ply`), the true geometry is that of the hall. The flown path is compared with the obstacles that a
//! referee bakes from the twin and its seen space. `-- race 1` flies the hall itself.

#[path = "../tests/world/mod.rs"]
mod world;

use std::path::Path;
use std::time::Instant;

use vizflyt_arena::seen::ScenePlace;
use vizflyt_arena::{BakeSpec, DistanceField, Ellipsoid, OccupancyGrid, SeenSpace};
use vizflyt_scenes::projects::{CourseProject, Level};
use vizflyt_scenes::{Generated, SceneKind, Variant, generate};
use vizflyt_sdk::glam::DVec3;
use vizflyt_splat::format;

fn main() {
    let mut arguments = std::env::args().skip(1);
    let project = arguments.next().unwrap_or_else(|| "p5".to_owned());
    let (others, seeds): (Vec<String>, Vec<String>) =
        arguments.partition(|text| text.parse::<u64>().is_err());
    let seeds: Vec<u64> = seeds.iter().filter_map(|text| text.parse().ok()).collect();
    let twin = others.iter().find_map(|text| text.strip_prefix("twin=")).map(Path::new);
    let mut good = 0;
    for &seed in &seeds {
        let start = Instant::now();
        let mut told_s = f64::NEG_INFINITY;
        let mut way_m = Vec::new();
        let (generated, field) = place(&project, seed, twin);
        let radius_m = generated.arena.body_radius_m;
        let spawn_m = generated.arena.spawn.position_m;
        let outcome = world::fly_in(generated, seed, 90.0, |now_s, plugin, camera_m, _| {
            way_m.push(camera_m + spawn_m.with_z(0.0));
            if seeds.len() == 1 && now_s > told_s + 0.5 {
                told_s = now_s;
                let target = plugin.target().map_or("nothing", |kind| kind.name());
                println!("{now_s:5.2} s at {camera_m:.2}, own {:.2}, to {target}", plugin.here_m());
                for obstacle in plugin.known().obstacles() {
                    println!("    {:?} {:?} {:?}", obstacle.kind, obstacle.plane, obstacle.opening);
                }
                if let Some(motion) = plugin.hand() {
                    println!("    {motion:.2?}");
                }
            }
        });
        if let Some(field) = field {
            // Exclude the take-off above the pad.
            let flown = way_m.iter().filter(|p_m| p_m.z > 0.5 && p_m.distance(way_m[0]) > 0.5);
            let room_m = |p_m: &DVec3| field.obstacle_distance_m(*p_m) - radius_m;
            let least = flown.min_by(|a, b| room_m(a).total_cmp(&room_m(b)));
            if let Some(p_m) = least {
                let what =
                    if field.is_unseen_nearest(*p_m, 0.3) { "unseen space" } else { "splats" };
                println!(
                    "seed {seed}: {:.2} m left to {what} of the twin at {p_m:.2} m",
                    room_m(p_m)
                );
            }
        }
        good += usize::from(outcome.is_good());
        println!("seed {seed}: {outcome:.2?} in {:.1} s", start.elapsed().as_secs_f64());
    }
    println!("{good} of {} finished", seeds.len());
}

/// Returns the course, and for a twin the referee's distance field.
fn place(project: &str, seed: u64, twin: Option<&Path>) -> (Generated, Option<DistanceField>) {
    let of_course = |name| CourseProject::named(name).expect("a project of the course");
    if project != "race" {
        return (of_course(project).generate(seed, Level::Ug, Variant::DAY), None);
    }
    let mut hall = generate(SceneKind::Race, seed);
    // With the sensors and limits of the course.
    let rules = of_course("p5").generate(seed, Level::Ug, Variant::DAY).arena;
    hall.arena.cameras = rules.cameras;
    hall.arena.limits = rules.limits;
    let field = twin.map(|folder| {
        let scene = folder.join("scene.ply");
        hall.splats = format::read(&scene).expect("a scene").splats;
        let splats = &hall.splats;
        let ellipsoids = (0..splats.len()).map(|k| Ellipsoid {
            center_m: splats.means_m[k],
            scales_m: splats.scales_m[k],
            rotation: splats.rotations[k],
            opacity: splats.opacities[k],
        });
        let seen = std::fs::read(folder.join("scene.ply.seen")).expect("what was seen");
        let seen = SeenSpace::from_bytes(&seen).expect("what was seen");
        let at = seen.at(&ScenePlace::of(&hall.arena.scene));
        let spec = BakeSpec::of(&hall.arena);
        DistanceField::of(OccupancyGrid::bake_with(ellipsoids, &spec, Some(at), &|_| ()))
    });
    (hall, field)
}
