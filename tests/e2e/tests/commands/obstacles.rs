//! Distance fields that move with their objects, compared with the true geometry at many times: nothing is missed
//! beyond one voxel, and almost nothing is reported that is free by one and a half voxels.

use std::sync::Arc;

use glam::DVec3;
use vizflyt_arena::grid::Grid;
use vizflyt_arena::objects::MovingObjects;
use vizflyt_arena::{DistanceField, OccupancyGrid};
use vizflyt_protocol::geometry::Volume;
use vizflyt_scenes::{SceneKind, generate};
use vizflyt_server::scene::obstacles;

/// Radius of the body for collisions. [m]
const BODY_M: f64 = 0.12;
/// Voxel size of an object's field. [m]
const VOXEL_M: f64 = 0.02;
/// Maximum distance of a test point from an object's surface. [m]
const NEAR_M: f64 = 0.4;
/// Time after which some of the touched objects have moved on. [ns]
const LATER_NS: i64 = 300_000_000;
const INSTANTS: i64 = 40;
const PLACES: usize = 400;

#[test]
fn detects_collisions_with_moving_objects_at_their_position() {
    for (kind, seed) in [(SceneKind::Race, 7), (SceneKind::Moving, 7), (SceneKind::Moving, 3)] {
        let scene = generate(kind, seed);
        let nothing = Grid::covering(DVec3::ZERO, DVec3::ONE, 0.5);
        let nothing = DistanceField::of(OccupancyGrid::bake_object([], nothing, 0.5));
        let obstacles = obstacles(&scene.arena, &scene.objects, Arc::new(nothing), seed);
        let moving = MovingObjects::new(&scene.arena, seed);
        assert!(!moving.is_empty(), "{kind}");
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let [mut touching, mut missed, mut gone, mut clear, mut alarms] = [0; 5];
        for instant in 0..INSTANTS {
            // Not a divisor of any period.
            let ns = instant * 173_000_011;
            let truth_m = |p_world_m: DVec3| {
                let to = |(index, solids): (usize, &Vec<_>)| {
                    let p_m = moving.placement(index, ns).inverse().transform_point(p_world_m);
                    let to = |solid: &Volume| solid.signed_distance_m(p_m);
                    solids.iter().map(to).fold(f64::INFINITY, f64::min)
                };
                scene.true_objects.iter().enumerate().map(to).fold(f64::INFINITY, f64::min)
            };
            for place in 0..PLACES {
                let index = place % scene.objects.len();
                // A point near a random splat.
                let means_m = &scene.objects[index].splats.means_m;
                let mean_m = means_m[(next() * means_m.len() as f64) as usize].as_dvec3();
                let aside_m = (DVec3::new(next(), next(), next()) * 2.0 - 1.0) * NEAR_M;
                let p_m = moving.placement(index, ns).transform_point(mean_m + aside_m);
                let (truth_m, found_m) = (truth_m(p_m), obstacles.moving_distance_m(ns, p_m));
                let touches = !(found_m > BODY_M);
                if (0.0..BODY_M - VOXEL_M).contains(&truth_m) {
                    touching += 1;
                    missed += usize::from(!touches);
                    gone += usize::from(obstacles.moving_distance_m(ns + LATER_NS, p_m) > BODY_M);
                } else if truth_m > BODY_M + 1.5 * VOXEL_M {
                    clear += 1;
                    alarms += usize::from(touches);
                }
            }
        }
        println!("{kind} {seed}: {missed} of {touching} missed, {alarms} of {clear} false alarms");
        assert!(touching > 1000 && clear > 3000, "{kind} {seed}: {touching} {clear}");
        assert_eq!(missed, 0, "{kind} {seed}");
        assert!(20 * gone > touching, "{kind} {seed}: {gone} of {touching}: does anything move?");
        assert!(alarms * 100 <= clear, "{kind} {seed}: {alarms} of {clear}");
    }
}
