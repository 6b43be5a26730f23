use vizflyt_sdk::glam::DVec2;

use super::*;
use crate::test_scene::{Brick, picture, room, window};

fn furnished() -> Vec<Brick> {
    let mut bricks = room();
    bricks.extend(window(DVec3::new(2.5, 0.4, 1.3), 0.6, [216, 31, 42]));
    bricks
}

/// Flies along a path and returns the estimated and the true position at the end.
fn fly(seconds: f64, way: impl Fn(f64) -> (DVec3, f64)) -> (DVec3, DVec3) {
    let bricks = furnished();
    let mut odometry = Odometry::default();
    let steps = (seconds * 25.0) as u32;
    let start_m = way(0.0).0;
    let mut at_m = start_m;
    for step in 0..=steps {
        let at_s = f64::from(step) * 0.04;
        let (p_m, yaw_rad) = way(at_s);
        odometry.update(at_s, &mut picture(&bricks, p_m, yaw_rad));
        at_m = p_m;
    }
    (odometry.p_m, at_m - start_m.with_z(0.0))
}

#[test]
fn floor_gives_the_height_in_the_first_image() {
    for height_m in [0.15, 0.9, 1.6] {
        let mut odometry = Odometry::default();
        odometry.update(0.0, &mut picture(&furnished(), DVec3::new(0.3, 0.2, height_m), 0.0));
        assert!((odometry.p_m - DVec3::Z * height_m).length() < 0.01, "{}", odometry.p_m);
    }
}

#[test]
fn odometry_follows_a_flight_through_a_window_within_three_centimetres() {
    let (own_m, true_m) = fly(4.0, |at_s| {
        let aside_m = 0.4 * (at_s * 1.2).sin();
        (DVec3::new(1.0 * at_s, aside_m, 1.3 + 0.2 * at_s.sin()), 0.4 * at_s.sin())
    });
    assert!(own_m.distance(true_m) < 0.03, "{own_m} instead of {true_m}");
}

#[test]
fn continues_with_constant_velocity_without_depth() {
    let bricks = furnished();
    let mut odometry = Odometry::default();
    for step in 0..20 {
        let at_s = f64::from(step) * 0.04;
        odometry.update(at_s, &mut picture(&bricks, DVec3::new(at_s, 0.0, 1.2), 0.0));
    }
    let seen_m = odometry.p_m;
    for step in 20..25 {
        odometry.update(f64::from(step) * 0.04, &mut picture(&[], DVec3::ZERO, 0.0));
    }
    let gone_m = (odometry.p_m - seen_m).truncate();
    assert!(gone_m.distance(DVec2::new(0.2, 0.0)) < 0.03, "{gone_m}");
}

#[test]
fn waits_while_the_first_images_are_empty() {
    let mut odometry = Odometry::default();
    odometry.update(0.0, &mut picture(&[], DVec3::ZERO, 0.0));
    assert_eq!(odometry.p_m, DVec3::ZERO);
    odometry.update(0.04, &mut picture(&furnished(), DVec3::Z, 0.0));
    assert!((odometry.p_m.z - 1.0).abs() < 0.01);
}
