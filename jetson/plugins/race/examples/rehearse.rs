//! Flies generated courses in lock-step, without autopilot and server, with images and attitude alone:
//! `cargo run --release -p vizflyt-race --example rehearse -- p5 0 1 2`. One seed alone is reported
//! every half second.

#[path = "../tests/world/mod.rs"]
mod world;

use std::time::Instant;

fn main() {
    let mut arguments = std::env::args().skip(1);
    let project = arguments.next().unwrap_or_else(|| "p5".to_owned());
    let seeds: Vec<u64> = arguments.filter_map(|text| text.parse().ok()).collect();
    let mut good = 0;
    for &seed in &seeds {
        let start = Instant::now();
        let mut told_s = f64::NEG_INFINITY;
        let outcome = world::fly(&project, seed, 90.0, |now_s, plugin, camera_m, _| {
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
        good += usize::from(outcome.is_good());
        println!("seed {seed}: {outcome:.2?} in {:.1} s", start.elapsed().as_secs_f64());
    }
    println!("{good} of {} finished", seeds.len());
}
