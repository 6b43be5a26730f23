//! Closed loop: the plugin flies generated forests through the SDK's own observations, and the
//! true geometry judges. The autopilot and the images are those of `world`.

mod world;

use std::thread;

use world::flight::{self, Conditions, Outcome, TYPICAL};

/// Flies every seed, on all processors.
fn fly_forests(seeds: std::ops::Range<u64>, trunks: usize, conditions: Conditions) -> Vec<Outcome> {
    let workers = thread::available_parallelism().map_or(2, usize::from) as u64;
    let mut outcomes: Vec<(u64, Outcome)> = thread::scope(|scope| {
        let handles: Vec<_> = (0..workers)
            .map(|worker| {
                let seeds = seeds.clone().filter(move |seed| seed % workers == worker);
                scope.spawn(move || {
                    seeds
                        .map(|seed| (seed, fly_forest(seed, trunks, conditions)))
                        .collect::<Vec<_>>()
                })
            })
            .collect();
        handles.into_iter().flat_map(|handle| handle.join().unwrap()).collect()
    });
    outcomes.sort_by_key(|&(seed, _)| seed);
    for (seed, outcome) in &outcomes {
        println!("seed {seed}: {outcome:?}");
    }
    outcomes.into_iter().map(|(_, outcome)| outcome).collect()
}

fn fly_forest(seed: u64, trunks: usize, conditions: Conditions) -> Outcome {
    let volumes = world::forest(seed, trunks);
    flight::fly(&volumes, &flight::arena(), conditions, seed, 60.0, |_, _| ())
}

#[test]
fn at_least_18_of_20_forests_are_crossed_at_2_mps() {
    let outcomes = fly_forests(0..20, 60, TYPICAL);
    let good = outcomes.iter().filter(|o| o.finished && !o.collided && o.mean_speed_mps >= 2.0);
    assert!(good.count() >= 18);
}

/// Prints how many of many seeds finish under several conditions; run it by name after a change:
/// `cargo test --release -p vizflyt-avoid --test forest sweep -- --nocapture`.
#[test]
fn sweep_dev() {
    let n: u64 = std::env::var("N").map_or(0, |n| n.parse().unwrap());
    let dense: usize = std::env::var("T").map_or(60, |n| n.parse().unwrap());
    let slow = Conditions {
        lag_s: 0.4,
        max_acceleration_mps2: 3.5,
        max_yaw_rate_radps: 1.2,
        image_age_s: 0.08,
        state_age_s: 0.04,
        setpoint_delay_s: 0.05,
        image_period_s: 0.04,
        faults: world::camera::Faults {
            noise: 0.02,
            holes: 0.1,
            blurred_edges: true,
            sky_mm: 60000,
        },
    };
    for (name, conditions) in [("typical", TYPICAL), ("slow", slow)] {
        let o = fly_forests(1000..1000 + n, dense, conditions);
        let good = o.iter().filter(|o| o.finished && !o.collided).count();
        let mut speeds: Vec<f64> = o.iter().map(|o| o.mean_speed_mps).collect();
        let mut clear: Vec<f64> = o.iter().map(|o| o.min_clearance_m).collect();
        speeds.sort_by(f64::total_cmp);
        clear.sort_by(f64::total_cmp);
        if n > 0 {
            let l = |v: &[f64]| {
                v.iter().take(8).map(|x| format!("{x:.2}")).collect::<Vec<_>>().join(" ")
            };
            println!(
                "SUM {name} trunks {dense}: good {good}/{n}; speed median {:.2} worst {}; clearance median {:.2} worst {}",
                speeds[n as usize / 2],
                l(&speeds),
                clear[n as usize / 2],
                l(&clear)
            );
        }
    }
}
