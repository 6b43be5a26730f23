use super::*;
use crate::test_scene::{Brick, picture, room, window};

const BLUE: [u8; 3] = [30, 80, 210];

fn watched(bricks: &[Brick], kind: ObstacleKind, x_m: f64, from_m: DVec3) -> PlanarObstacle {
    let plane = Plane { origin_m: DVec3::new(x_m, from_m.y, 0.0), yaw_rad: 0.0 };
    let mut obstacle = PlanarObstacle::new(kind, plane, 2.0, 0.0);
    for n in 0..5 {
        obstacle.update(f64::from(n), from_m, &picture(bricks, from_m, 0.0));
    }
    obstacle
}

#[test]
fn opening_of_a_window_is_its_middle() {
    let middle_m = DVec3::new(2.0, 0.3, 1.5);
    let mut bricks = room();
    bricks.extend(window(middle_m, 0.55, BLUE));
    let obstacle =
        watched(&bricks, ObstacleKind::Window(ColorClass::Blue), 2.0, DVec3::new(0.2, 0.0, 1.3));
    let opening = obstacle.opening.expect("an opening");
    assert!(opening.center_m.distance(middle_m) < 0.06, "{opening:?}");
    assert!((opening.radius_m - 0.55).abs() < 0.08, "{opening:?}");
}

/// The legs below the lower bar also enclose free space, which is not an opening.
#[test]
fn space_between_the_legs_is_not_an_opening() {
    let mut bricks = room();
    bricks.extend(window(DVec3::new(2.0, 0.0, 2.6), 0.5, BLUE));
    let obstacle =
        watched(&bricks, ObstacleKind::Window(ColorClass::Blue), 2.0, DVec3::new(0.0, 0.0, 0.8));
    assert!(
        obstacle.opening.is_none_or(|opening| opening.center_m.z > 2.0),
        "{:?}",
        obstacle.opening
    );
}

#[test]
fn opening_of_a_gap_is_its_widest_place() {
    let part = |low: DVec2, high: DVec2| Brick {
        min_m: DVec3::new(3.0, low.x, low.y),
        max_m: DVec3::new(3.1, high.x, high.y),
        rgb: [150, 80, 60],
    };
    let mut bricks = room();
    // A hole of 1.4 x 0.5 m with a hole of 0.9 x 0.9 m at its left end.
    bricks.extend([
        part(DVec2::new(-2.2, 0.0), DVec2::new(2.2, 1.0)),
        part(DVec2::new(-2.2, 1.9), DVec2::new(2.2, 3.0)),
        part(DVec2::new(-2.2, 1.0), DVec2::new(-0.7, 1.9)),
        part(DVec2::new(0.7, 1.0), DVec2::new(2.2, 1.9)),
        part(DVec2::new(-0.7, 1.5), DVec2::new(-0.2, 1.9)),
    ]);
    let obstacle = watched(&bricks, ObstacleKind::Wall, 3.0, DVec3::new(1.0, 0.0, 1.2));
    let opening = obstacle.opening.expect("an opening");
    assert!((opening.center_m - DVec3::new(3.0, 0.25, 1.45)).length() < 0.08, "{opening:?}");
}

#[test]
fn wall_without_a_gap_has_no_opening() {
    let mut bricks = room();
    bricks.push(Brick {
        min_m: DVec3::new(2.0, -2.2, 0.0),
        max_m: DVec3::new(2.1, 2.2, 3.0),
        rgb: [150, 80, 60],
    });
    let obstacle = watched(&bricks, ObstacleKind::Wall, 2.0, DVec3::new(0.5, 0.0, 1.2));
    assert_eq!(obstacle.opening, None);
    let near_m = obstacle.nearest_solid_m(DVec3::new(1.6, 0.1, 1.2), 0.6).expect("a wall");
    assert!(near_m.distance(DVec3::new(2.0, 0.1, 1.2)) < CELL_M, "{near_m}");
    assert_eq!(obstacle.nearest_solid_m(DVec3::new(1.2, 0.1, 1.2), 0.6), None);
}
