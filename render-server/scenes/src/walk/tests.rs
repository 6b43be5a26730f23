//! Properties of walks: closed, free of obstacles, at walking speed, with rotations that structure from motion
//! tolerates.

use super::*;
use crate::{SceneKind, film_set};
use vizflyt_protocol::geometry::Volume;

#[test]
fn walks_are_closed_and_free_at_walking_speed() {
    for kind in SceneKind::ALL {
        for (seed, seconds) in [(3, 50.0), (7, 20.0), (1, 90.0)] {
            let set = film_set(kind, seed, seconds, true).unwrap();
            let walk = &set.walk;
            let about = format!("{kind} {seed}: {:.1} m in {seconds} s", walk.length_m());
            let pace_mps = walk.length_m() / seconds;
            assert!((0.25..1.4).contains(&pace_mps), "{about}");
            let bodies: Vec<&Volume> = set
                .scene
                .truth
                .iter()
                .filter(|volume| !matches!(volume, Volume::HalfSpace { .. }))
                .collect();
            let (mut nearest_m, mut fastest_mps, mut fastest_radps) = (f64::MAX, 0f64, 0f64);
            let step_s = 1.0 / 60.0;
            let count = (seconds / step_s) as usize;
            for n in 0..=count {
                let at_s = n as f64 * step_s;
                let [a, b] = [at_s, at_s + step_s].map(|at_s| walk.world_from_cam(at_s));
                let free = bodies.iter().map(|body| body.signed_distance_m(a.translation_m));
                nearest_m = free.fold(nearest_m, f64::min);
                let moved_m = (b.translation_m - a.translation_m).length();
                fastest_mps = fastest_mps.max(moved_m / step_s);
                fastest_radps = fastest_radps.max(a.rotation.angle_between(b.rotation) / step_s);
                assert!((1.1..1.8).contains(&a.translation_m.z), "{about}: {a:?}");
            }
            assert!(nearest_m > 0.22, "{about}: {nearest_m} m from something");
            assert!(fastest_mps < 2.0, "{about}: {fastest_mps} m/s");
            assert!(fastest_radps < 100f64.to_radians(), "{about}: {fastest_radps} rad/s");
            // There is no jump between end and start.
            let [end, begin] = [seconds - 1e-6, seconds + 1e-6].map(|at| walk.world_from_cam(at));
            assert!((end.translation_m - begin.translation_m).length() < 1e-4, "{about}");
            assert!(end.rotation.angle_between(begin.rotation) < 1e-4, "{about}");
        }
    }
}

#[test]
fn the_seed_determines_the_walk() {
    let walk = |seed| film_set(SceneKind::Room, seed, 10.0, true).unwrap().walk;
    assert_eq!(walk(4), walk(4));
    assert_ne!(walk(4), walk(5));
}

#[test]
fn rejects_invalid_durations_and_missing_floor() {
    for seconds in [0.0, 1.9, -3.0, 601.0, f64::NAN, f64::INFINITY] {
        let error = film_set(SceneKind::Room, 3, seconds, false).unwrap_err().to_string();
        assert!(error.contains("2 to 600 s"), "{error}");
    }
    // A block covers the whole floor.
    let solids = crate::solids::Solids::new(vec![Volume::aabb(
        DVec3::new(-5.0, -5.0, 0.0),
        DVec3::new(5.0, 5.0, 3.0),
    )]);
    let within = [DVec2::splat(-4.0), DVec2::splat(4.0)];
    let ground = Ground { solids: &solids, keep_out: &[], floor_m: within, within_m: within };
    assert_eq!(Walk::plan(&ground, 1, 20.0), Err(NoWalk::NoFloor));
}

#[test]
fn plans_a_walk_of_the_minimum_duration() {
    let set = film_set(SceneKind::Room, 3, 2.0, true).unwrap();
    assert!(set.walk.length_m() < 4.0, "{} m", set.walk.length_m());
}
