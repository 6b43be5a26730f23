//! Closed loop: the plugin flies through generated forests with observations of the SDK, and the true geometry decides
//! about collisions. Autopilot and images come from `world`, without splats.

mod world;

use std::thread;

use vizflyt_scenes::SceneKind;
use vizflyt_sdk::Volume;
use vizflyt_sdk::glam::{DVec2, DVec3};

use world::flight::{self, Conditions, Outcome, SLUGGISH, STARVED, TYPICAL};
use world::{FLOOR, GOAL_M, START_M};

/// Runs one flight per seed, on all processors.
fn on_seeds(count: u64, flight: impl Fn(u64) -> Outcome + Sync) -> Vec<Outcome> {
    let workers = thread::available_parallelism().map_or(2, usize::from) as u64;
    let flight = &flight;
    let mut outcomes: Vec<(u64, Outcome)> = thread::scope(|scope| {
        let handles: Vec<_> = (0..workers)
            .map(|worker| {
                let seeds = (worker..count).step_by(workers as usize);
                scope.spawn(move || seeds.map(|seed| (seed, flight(seed))).collect::<Vec<_>>())
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

/// Flies the test's forest, which is denser than the demo's.
fn fly_forest(seed: u64, trunks: usize, conditions: Conditions) -> Outcome {
    let volumes = world::forest(seed, trunks);
    flight::fly(&volumes, &flight::arena(), START_M, conditions, seed, 60.0)
}

/// Flies the demo's forest, with its true trunks, branches, rocks and logs.
fn fly_generated(seed: u64) -> Outcome {
    let mut generated = vizflyt_scenes::generate(SceneKind::Forest, seed);
    generated.truth.retain(can_be_met);
    let mut arena = generated.arena.info();
    arena.cameras = [flight::small_camera()].into_iter().collect();
    let start_m = generated.arena.spawn.position_m + DVec3::Z * generated.arena.takeoff_height_m;
    flight::fly(&generated.truth, &arena, start_m, TYPICAL, seed, 60.0)
}

/// Excludes crowns above the fence and trees far outside it, for speed.
fn can_be_met(volume: &Volume) -> bool {
    match *volume {
        Volume::Capsule { a_m, b_m, .. } => {
            a_m.z.min(b_m.z) < 4.5 && a_m.y.abs().min(b_m.y.abs()) < 8.0
        }
        _ => true,
    }
}

fn good(outcomes: &[Outcome]) -> usize {
    let good = |o: &&Outcome| o.finished && !o.collided && o.mean_speed_mps >= 2.0;
    outcomes.iter().filter(good).count()
}

/// Requirement of the product.
#[test]
fn crosses_at_least_18_of_20_generated_forests_at_2_mps() {
    let outcomes = on_seeds(20, fly_generated);
    assert!(good(&outcomes) >= 18, "{outcomes:#?}");
    assert!(outcomes.iter().all(|o| o.min_fence_m > 0.0), "{outcomes:#?}");
}

/// Slower than with timely images, but as safe.
#[test]
fn starved_server_reduces_speed_but_not_safety() {
    let outcomes = on_seeds(40, |seed| fly_forest(seed, 90, STARVED));
    let touched = outcomes.iter().filter(|o| o.collided).count();
    println!("{touched} touched");
    assert!(touched <= 1, "{outcomes:#?}");
    assert!(outcomes.iter().filter(|o| o.finished).count() >= 36, "{outcomes:#?}");
    assert!(outcomes.iter().all(|o| o.max_speed_mps < 2.7), "{outcomes:#?}");
}

#[test]
fn crosses_dense_forests() {
    let outcomes = on_seeds(10, |seed| fly_forest(seed, 90, TYPICAL));
    assert!(good(&outcomes) >= 9, "{outcomes:#?}");
}

#[test]
fn sluggish_vehicle_with_a_poor_camera_crosses_forests() {
    let outcomes = on_seeds(10, |seed| fly_forest(seed, 60, SLUGGISH));
    assert!(good(&outcomes) >= 9, "{outcomes:#?}");
}

/// A pocket of trunks, too close to pass between, that opens towards the start. A plain potential field never leaves
/// it.
#[test]
fn leaves_a_dead_end() {
    let mut volumes = vec![FLOOR];
    for n in 0..=12 {
        let along = f64::from(n) * 0.5;
        let (across, deep) = (along - 3.0, along.min(4.5) + 9.0);
        for at in [DVec2::new(14.0, across), DVec2::new(deep, 3.0), DVec2::new(deep, -3.0)] {
            volumes.push(world::trunk(at, DVec2::ZERO, 0.15));
        }
    }
    let outcome = flight::fly(&volumes, &flight::arena(), START_M, TYPICAL, 1, 60.0);
    assert!(outcome.finished && !outcome.collided, "{outcome:?}");
}

#[test]
fn crosses_free_ground_fast_and_straight() {
    let outcome = flight::fly(&[FLOOR], &flight::arena(), START_M, TYPICAL, 1, 60.0);
    assert!(outcome.finished && outcome.mean_speed_mps > 2.5, "{outcome:?}");
    assert!((outcome.end_m - GOAL_M).y.abs() < 0.1, "{outcome:?}");
}
