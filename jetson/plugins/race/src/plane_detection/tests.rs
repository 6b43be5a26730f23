use super::*;
use crate::test_scene::{Brick, picture, room, window as frame};

const RED: [u8; 3] = [200, 28, 40];
const MAGENTA: [u8; 3] = [200, 30, 120];

#[test]
fn detects_a_window_at_its_position() {
    let mut bricks = room();
    bricks.extend(frame(DVec3::new(2.2, 0.5, 1.4), 0.6, RED));
    let camera_m = DVec3::new(0.0, 0.0, 1.2);
    let grid = picture(&bricks, camera_m, 0.0);
    let found = window(&grid, camera_m, ColorClass::Red).expect("a red window");
    // The mean of the front and the inner sides of the bars.
    assert!((found.plane.origin_m.x - 2.2).abs() < 0.06, "{found:?}");
    assert!((found.plane.origin_m.y - 0.5).abs() < 0.1 && found.plane.yaw_rad.abs() < 0.05);
    assert_eq!(window(&grid, camera_m, ColorClass::Blue), None);
}

#[test]
fn detects_a_frame_in_front_of_a_wall_of_the_same_colour() {
    let mut bricks = room();
    bricks.extend(frame(DVec3::new(2.0, 0.0, 1.3), 0.6, MAGENTA));
    bricks.push(Brick {
        min_m: DVec3::new(3.6, -2.0, 0.0),
        max_m: DVec3::new(3.7, 2.0, 3.0),
        rgb: MAGENTA,
    });
    let camera_m = DVec3::new(0.0, 0.2, 1.2);
    let found =
        window(&picture(&bricks, camera_m, 0.0), camera_m, ColorClass::Magenta).expect("found");
    assert!((found.plane.origin_m.x - 2.0).abs() < 0.06, "{found:?}");
}

#[test]
fn detects_a_wall_across_the_flight_direction_but_no_side_walls() {
    let camera_m = DVec3::new(0.0, 0.0, 1.3);
    assert_eq!(
        wall(&picture(&room(), camera_m, 0.0), camera_m),
        None,
        "the end wall is too far away"
    );
    let mut bricks = room();
    bricks.push(Brick {
        min_m: DVec3::new(2.5, -2.2, 0.0),
        max_m: DVec3::new(2.6, 2.2, 3.0),
        rgb: [150, 80, 60],
    });
    let found = wall(&picture(&bricks, camera_m, 0.1), camera_m).expect("a wall");
    assert!((found.plane.origin_m.x - 2.5).abs() < 0.02, "{found:?}");
}
