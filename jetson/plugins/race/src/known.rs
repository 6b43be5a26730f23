//! Detected obstacles, passed obstacles, and the next one.

use vizflyt_sdk::glam::DVec3;

use crate::color_class::ColorClass;
use crate::planar_obstacle::{ObstacleKind, PlanarObstacle, Plane};
use crate::plane_detection;
use crate::sampling::PixelGrid;

/// The course as far as it has been detected.
#[derive(Clone, Debug, Default)]
pub struct Known {
    obstacles: Vec<PlanarObstacle>,
    passed: Vec<ObstacleKind>,
}

impl Known {
    /// Processes an image seen from `camera_m` [m, home] at `now_s`. The plane of `settled` is not changed, because the
    /// vehicle is about to fly through it.
    pub fn update(
        &mut self,
        now_s: f64,
        camera_m: DVec3,
        grid: &PixelGrid,
        settled: Option<ObstacleKind>,
    ) {
        let windows = ColorClass::WINDOWS.into_iter().map(ObstacleKind::Window);
        for kind in windows.chain([ObstacleKind::Wall]) {
            if self.has_passed(kind) || settled == Some(kind) {
                continue;
            }
            let known = self.obstacles.iter().position(|obstacle| obstacle.kind == kind);
            let found = match (kind, known) {
                (ObstacleKind::Window(color), Some(at)) => {
                    plane_detection::again(grid, camera_m, color, &self.obstacles[at].plane)
                }
                (ObstacleKind::Window(color), None) => {
                    plane_detection::window(grid, camera_m, color)
                }
                (ObstacleKind::Wall, _) => plane_detection::wall(grid, camera_m),
            };
            let Some(found) = found else { continue };
            match known {
                Some(at) => self.obstacles[at].settle(found.plane, found.range_m),
                // Arrowheads of one window may look like bars of another window.
                None if self.is_another(kind, &found.plane) => {}
                None => {
                    self.obstacles.push(PlanarObstacle::new(
                        kind,
                        found.plane,
                        found.range_m,
                        now_s,
                    ));
                }
            }
        }
        for obstacle in &mut self.obstacles {
            obstacle.update(now_s, camera_m, grid);
        }
        self.forget(now_s, camera_m);
    }

    /// Returns all detected obstacles, passed or not.
    pub fn obstacles(&self) -> &[PlanarObstacle] {
        &self.obstacles
    }

    /// Returns the obstacle of a kind; there is at most one.
    pub fn obstacle(&self, kind: ObstacleKind) -> Option<&PlanarObstacle> {
        self.obstacles.iter().find(|obstacle| obstacle.kind == kind)
    }

    /// Marks an obstacle as passed.
    pub fn pass(&mut self, kind: ObstacleKind) {
        self.passed.push(kind);
    }

    /// Returns whether the vehicle has flown through an obstacle.
    pub fn has_passed(&self, kind: ObstacleKind) -> bool {
        self.passed.contains(&kind)
    }

    /// Returns whether the vehicle has flown through any obstacle.
    pub fn has_begun(&self) -> bool {
        !self.passed.is_empty()
    }

    /// Returns the nearest obstacle ahead of `p_m` [m, home] that is not passed and is not `after`.
    pub fn next(&self, p_m: DVec3, after: Option<ObstacleKind>) -> Option<&PlanarObstacle> {
        let before_m = |obstacle: &PlanarObstacle| -obstacle.plane.behind_m(p_m);
        self.obstacles
            .iter()
            .filter(|obstacle| !self.has_passed(obstacle.kind) && after != Some(obstacle.kind))
            .filter(|obstacle| before_m(obstacle) > -PASSED_M)
            .min_by(|a, b| before_m(a).total_cmp(&before_m(b)))
    }

    /// Removes false detections: obstacles that never had an opening and are no longer visible or lie on a wall, and
    /// obstacles behind the camera that were not passed.
    fn forget(&mut self, now_s: f64, camera_m: DVec3) {
        let walls: Vec<Plane> = self.walls().collect();
        let passed = &self.passed;
        self.obstacles.retain(|obstacle| {
            if obstacle.plane.behind_m(camera_m) > LEFT_BEHIND_M && !passed.contains(&obstacle.kind)
            {
                return false;
            }
            let is_window = obstacle.kind != ObstacleKind::Wall;
            let colored = is_window && walls.iter().any(|wall| lies_on(wall, &obstacle.plane));
            obstacle.opening.is_some() || now_s - obstacle.seen_s < FORGET_S && !colored
        });
    }

    fn walls(&self) -> impl Iterator<Item = Plane> {
        self.obstacles
            .iter()
            .filter(|obstacle| obstacle.kind == ObstacleKind::Wall)
            .map(|obstacle| obstacle.plane)
    }

    /// Returns whether a plane belongs to an obstacle of another kind.
    fn is_another(&self, kind: ObstacleKind, plane: &Plane) -> bool {
        self.obstacles.iter().filter(|obstacle| obstacle.kind != kind).any(|obstacle| {
            let aside_m = obstacle.plane.within_m(plane.origin_m).x.abs();
            lies_on(&obstacle.plane, plane)
                && kind != ObstacleKind::Wall
                && (obstacle.kind == ObstacleKind::Wall || aside_m < SAME_M)
        })
    }
}

/// Returns whether a plane lies on a wall, so that it is not a window in front of the wall.
fn lies_on(wall: &Plane, plane: &Plane) -> bool {
    wall.behind_m(plane.origin_m).abs() < 0.2
}

/// An obstacle is passed when the complete vehicle and a margin are behind it. [m]
pub const PASSED_M: f64 = 0.32;
/// Further behind than any obstacle during its passage. [m]
const LEFT_BEHIND_M: f64 = 0.8;
/// Minimum distance between two windows side by side. [m]
const SAME_M: f64 = 0.8;
/// Long enough to look elsewhere. [s]
const FORGET_S: f64 = 2.0;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_scene::{Brick, picture, room, window};

    const RED: [u8; 3] = [200, 28, 40];
    const BLUE: [u8; 3] = [30, 80, 210];

    fn looked(bricks: &[Brick], from_m: DVec3, seconds: u32) -> Known {
        let mut known = Known::default();
        let grid = picture(bricks, from_m, 0.0);
        for n in 0..10 * seconds {
            known.update(f64::from(n) * 0.1, from_m, &grid, None);
        }
        known
    }

    #[test]
    fn nearest_obstacle_not_passed_is_next() {
        let mut bricks = room();
        bricks.extend(window(DVec3::new(1.8, 0.1, 1.3), 0.6, RED));
        bricks.extend(window(DVec3::new(3.4, 0.0, 1.3), 0.6, BLUE));
        let from_m = DVec3::new(0.0, 0.0, 1.3);
        let mut known = looked(&bricks, from_m, 1);
        let red = ObstacleKind::Window(ColorClass::Red);
        assert_eq!(known.next(from_m, None).map(|obstacle| obstacle.kind), Some(red));
        let blue = Some(ObstacleKind::Window(ColorClass::Blue));
        assert_eq!(known.next(from_m, Some(red)).map(|obstacle| obstacle.kind), blue);
        known.pass(red);
        assert_eq!(known.next(from_m, None).map(|obstacle| obstacle.kind), blue);
        assert!(known.has_begun());
        let behind_m = DVec3::new(4.0, 0.0, 1.3);
        assert!(known.next(behind_m, None).is_none());
    }

    #[test]
    fn removes_a_frame_painted_on_a_wall() {
        let mut bricks = room();
        // 2 cm in front of the wall, within its thickness: paint.
        bricks.extend(window(DVec3::new(2.5, 0.0, 1.3), 0.6, BLUE));
        bricks.push(Brick {
            min_m: DVec3::new(2.5, -2.2, 0.0),
            max_m: DVec3::new(2.6, 2.2, 3.0),
            rgb: [150, 80, 60],
        });
        let known = looked(&bricks, DVec3::new(0.3, 0.0, 1.3), 1);
        let kinds: Vec<ObstacleKind> =
            known.obstacles().iter().map(|obstacle| obstacle.kind).collect();
        assert_eq!(kinds, [ObstacleKind::Wall]);
    }
}
