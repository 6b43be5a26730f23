//! Failsafe tables on a virtual clock: every loss in flight at three speeds, and every plugin fault. The sans-IO cores
//! of the programs fly each flight twice, with bit-identical results. `linkloss` and `misbehave` fly a few of them with
//! real processes.

mod bridge;
mod guardian;
mod loss;
mod misdeed;
mod pause;
mod plugin;
mod rig;
mod runtime;
mod server;
mod table;
mod wire;

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use vizflyt_arena::{ArenaConfig, BakeSpec, DistanceField, OccupancyGrid};
use vizflyt_scenes::{SceneKind, generate};

use rig::Place;

#[test]
fn vehicle_lands_in_time_or_flies_on_after_any_loss() {
    let place = place(|arena| {
        // The goal is never reached.
        arena.goal.as_mut().expect("the room has a goal").radius_m = 0.01;
    });
    let params = vizflyt_e2e::airframe_parameters();
    let rows = twice(&loss::runs(), |run| {
        let row = loss::fly(&place, &params, *run);
        (row.hash, row)
    });
    let complaints: Vec<_> = rows.iter().filter_map(loss::Row::complaint).collect();
    assert!(complaints.is_empty(), "{complaints:#?}");
    table::check(&rows);
}

#[test]
fn vehicle_holds_or_lands_for_any_plugin_fault() {
    let place = place(|arena| {
        // Put the fence near the start.
        arena.geofence.max_m.x = misdeed::FENCE_X_M;
        let goal = arena.goal.as_mut().expect("the room has a goal");
        (goal.position_m.x, goal.radius_m) = (2.3, 0.01);
    });
    let complaints = twice(&misdeed::CASES, |case| misdeed::fly(&place, case));
    let complaints: Vec<_> = complaints.into_iter().flatten().collect();
    assert!(complaints.is_empty(), "{complaints:#?}");
}

#[test]
fn no_pause_of_a_process_lands_the_vehicle_or_makes_it_look_fast() {
    let place = place(|arena| {
        arena.goal.as_mut().expect("the room has a goal").radius_m = 0.01;
    });
    let params = vizflyt_e2e::airframe_parameters();
    let complaints = twice(&pause::runs(), |run| pause::fly(&place, &params, *run));
    let complaints: Vec<_> = complaints.into_iter().flatten().collect();
    assert!(complaints.is_empty(), "{complaints:#?}");
}

/// Returns the generated room without obstacles, modified by `change`.
fn place(change: impl FnOnce(&mut ArenaConfig)) -> Place {
    let mut arena = generate(SceneKind::Room, 0).arena;
    change(&mut arena);
    let empty = OccupancyGrid::bake([], &BakeSpec::of(&arena));
    Place { arena, obstacles: Arc::new(DistanceField::of(empty)) }
}

/// Flies each of `flights` twice; returns the results. Panics if the hashes of the two differ.
fn twice<F: Sync, T: Send>(flights: &[F], fly: impl Fn(&F) -> (u64, T) + Sync) -> Vec<T> {
    let next = AtomicUsize::new(0);
    let work = || {
        let mut done = Vec::new();
        loop {
            let index = next.fetch_add(1, Ordering::Relaxed);
            let Some(flight) = flights.get(index / 2) else { return done };
            done.push((index, fly(flight)));
        }
    };
    let threads = thread::available_parallelism().map_or(1, usize::from);
    let mut done: Vec<_> = thread::scope(|scope| {
        let workers: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        workers.into_iter().flat_map(|worker| worker.join().expect("a worker")).collect()
    });
    done.sort_by_key(|&(index, _)| index);
    let mut results = Vec::new();
    let mut done = done.into_iter();
    while let (Some((index, (first, result))), Some((_, (second, _)))) = (done.next(), done.next())
    {
        assert_eq!(first, second, "flight {} differs the second time", index / 2);
        results.push(result);
    }
    results
}
