use vizflyt_sdk::protocol::geometry::body_from_forward_cam;
use vizflyt_sdk::{Body, Intrinsics, Pose, World};

use super::*;

/// Updates with a view from the origin along world x, with a depth of `depth_mm` in all pixels.
fn check(memory: &mut Memory, now_s: f64, depth_mm: u16, points_m: &[DVec3], expected: usize) {
    let k = Intrinsics::from_horizontal_fov(64, 48, 90_f64.to_radians());
    let depth_mm = vec![depth_mm; k.pixels()];
    let world_from_body: Pose<World, Body> = Pose::IDENTITY;
    let view = View {
        depth_mm: &depth_mm,
        intrinsics: k,
        world_from_cam: world_from_body * body_from_forward_cam(DVec3::ZERO, 0.0),
    };
    memory.update(now_s, &view, points_m);
    assert_eq!(memory.points_m().count(), expected);
}

const AHEAD_M: DVec3 = DVec3::new(3.0, 0.0, 0.0);
const ASIDE_M: DVec3 = DVec3::new(0.5, 2.0, 0.0);

#[test]
fn keeps_points_outside_the_image_until_they_are_old() {
    let mut memory = Memory::default();
    check(&mut memory, 1.0, 0, &[ASIDE_M], 1);
    check(&mut memory, 10.0, 9000, &[], 1);
    check(&mut memory, 1.0 + KEEP_S, 9000, &[], 0);
}

#[test]
fn removes_points_that_the_camera_sees_through() {
    let mut memory = Memory::default();
    check(&mut memory, 1.0, 3000, &[AHEAD_M, ASIDE_M], 2);
    check(&mut memory, 1.1, 0, &[], 2);
    check(&mut memory, 1.2, 3100, &[], 2);
    check(&mut memory, 1.3, 5000, &[], 1);
}

#[test]
fn merges_sightings_of_the_same_point() {
    let mut memory = Memory::default();
    check(&mut memory, 0.0, 0, &[AHEAD_M], 1);
    check(&mut memory, 14.0, 0, &[AHEAD_M + DVec3::Y * 0.05], 1);
    check(&mut memory, 20.0, 0, &[], 1);
}

#[test]
fn full_memory_replaces_the_oldest_point() {
    let mut memory = Memory::default();
    let point_m = |n: usize| DVec3::new(0.2 * (n % 40) as f64 - 4.0, 0.2 * (n / 40) as f64, 0.0);
    for n in 0..MAX_POINTS {
        check(&mut memory, n as f64 * 1e-3, 0, &[point_m(n)], n + 1);
    }
    let new_m = DVec3::new(0.0, -3.0, 0.0);
    check(&mut memory, 1.0, 0, &[new_m], MAX_POINTS);
    assert!(memory.points_m().any(|p_m| p_m == new_m));
    assert!(memory.points_m().all(|p_m| p_m != point_m(0)));
}
