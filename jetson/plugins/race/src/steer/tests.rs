use super::*;
use crate::color_class::ColorClass;
use crate::planar_obstacle::ObstacleKind;
use crate::test_scene::{Brick, clearance_m, picture, room, window};

fn ahead() -> (Plane, Opening) {
    let plane = Plane { origin_m: DVec3::new(2.0, 0.0, 0.0), yaw_rad: 0.0 };
    (plane, Opening { center_m: DVec3::new(2.0, 0.4, 1.5), radius_m: 0.5 })
}

/// Flies with an ideal lag. Returns the largest offset from the line at the plane, and the final position. [m]
fn fly(from_m: DVec3, held: bool) -> (f64, DVec3) {
    let (plane, opening) = ahead();
    let (mut p_m, mut v_mps) = (from_m, DVec3::ZERO);
    let mut off_m = 0.0_f64;
    for _ in 0..300 {
        let aim = Aim::from(p_m, &plane, &opening);
        if aim.before_m.abs() < 0.15 {
            off_m = off_m.max(aim.off_m.length());
        }
        if aim.before_m < -0.4 {
            break;
        }
        v_mps += (through(&aim, &plane, held) - v_mps) * (0.04 / 0.3);
        p_m += v_mps * 0.04;
    }
    (off_m, p_m)
}

#[test]
fn passes_near_the_middle_from_any_start() {
    for (y, z) in [(0.4, 1.5), (-0.9, 1.0), (1.5, 1.2), (0.2, 0.6)] {
        let (off_m, end_m) = fly(DVec3::new(0.4, y, z), false);
        assert!(end_m.x > 2.3 && off_m < 0.15, "from {y}, {z}: {off_m} m off, ends at {end_m}");
    }
}

#[test]
fn waits_in_front_of_the_plane_while_held() {
    let (_, end_m) = fly(DVec3::new(0.2, -0.3, 1.2), true);
    assert!((end_m - DVec3::new(2.0 - WAIT_M, 0.4, 1.5)).length() < 0.05, "{end_m}");
    let (_, end_m) = fly(DVec3::new(1.6, 0.4, 1.5), true);
    assert!((end_m.x - (2.0 - WAIT_M)).abs() < 0.05, "must back away if too near: {end_m}");
}

#[test]
fn limits_the_speed_towards_a_bar() {
    let mut bricks: Vec<Brick> = room();
    bricks.extend(window(DVec3::new(2.0, 0.0, 1.5), 0.6, [30, 80, 210]));
    let plane = Plane { origin_m: DVec3::new(2.0, 0.0, 0.0), yaw_rad: 0.0 };
    let mut obstacle = PlanarObstacle::new(ObstacleKind::Window(ColorClass::Blue), plane, 1.5, 0.0);
    let camera_m = DVec3::new(0.5, 0.0, 1.5);
    for n in 0..4 {
        obstacle.update(f64::from(n), camera_m, &picture(&bricks, camera_m, 0.0));
    }
    // Straight at the left bar: stops in front of it.
    let mut p_m = DVec3::new(1.0, 0.68, 1.5);
    for _ in 0..100 {
        let v_mps = clear_of(DVec3::X, p_m, std::iter::once(&obstacle));
        p_m += v_mps * 0.04;
    }
    assert!(clearance_m(&bricks, p_m) > 0.13, "{p_m}");
    // Without near surfaces the velocity is unchanged.
    let free_m = DVec3::new(1.0, 0.0, 1.5);
    assert_eq!(clear_of(DVec3::X, free_m, std::iter::once(&obstacle)), DVec3::X);
}
