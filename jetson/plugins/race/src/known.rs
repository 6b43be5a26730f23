//! What has been found so far: the screens, which are passed, and which comes next.

use vizflyt_sdk::glam::DVec3;

use crate::eye::Lattice;
use crate::paint::Paint;
use crate::screen::{Kind, Plane, Screen};
use crate::spot;

/// The course as far as it has been seen.
#[derive(Clone, Debug, Default)]
pub struct Known {
    screens: Vec<Screen>,
    passed: Vec<Kind>,
}

impl Known {
    /// Takes an image seen from `camera_m` [m, home] at `now_s`. The plane of `settled` stays as it
    /// is: the vehicle is about to fly through it.
    pub fn update(
        &mut self,
        now_s: f64,
        camera_m: DVec3,
        lattice: &Lattice,
        settled: Option<Kind>,
    ) {
        let windows = Paint::WINDOWS.into_iter().map(Kind::Window);
        for kind in windows.chain([Kind::Wall]) {
            if self.has_passed(kind) || settled == Some(kind) {
                continue;
            }
            let known = self.screens.iter().position(|screen| screen.kind == kind);
            let found = match (kind, known) {
                (Kind::Window(paint), Some(at)) => {
                    spot::again(lattice, camera_m, paint, &self.screens[at].plane)
                }
                (Kind::Window(paint), None) => spot::window(lattice, camera_m, paint),
                (Kind::Wall, _) => spot::wall(lattice, camera_m),
            };
            let Some(found) = found else { continue };
            match known {
                Some(at) => self.screens[at].settle(found.plane, found.range_m),
                // Arrowheads of one window may look like bars of another.
                None if self.is_another(kind, &found.plane) => {}
                None => {
                    self.screens.push(Screen::new(kind, found.plane, found.range_m, now_s));
                }
            }
        }
        for screen in &mut self.screens {
            screen.update(now_s, camera_m, lattice);
        }
        self.forget(now_s, camera_m);
    }

    /// Returns everything found, passed or not.
    pub fn screens(&self) -> &[Screen] {
        &self.screens
    }

    /// Returns the screen of a kind; there is at most one.
    pub fn screen(&self, kind: Kind) -> Option<&Screen> {
        self.screens.iter().find(|screen| screen.kind == kind)
    }

    /// Notes that the vehicle has flown through a screen.
    pub fn pass(&mut self, kind: Kind) {
        self.passed.push(kind);
    }

    /// Whether the vehicle has flown through it.
    pub fn has_passed(&self, kind: Kind) -> bool {
        self.passed.contains(&kind)
    }

    /// Whether the vehicle has flown through anything.
    pub fn has_begun(&self) -> bool {
        !self.passed.is_empty()
    }

    /// Returns the nearest screen before `p_m` [m, home] that is not passed; `after` leaves one out.
    pub fn next(&self, p_m: DVec3, after: Option<Kind>) -> Option<&Screen> {
        let before_m = |screen: &Screen| -screen.plane.behind_m(p_m);
        self.screens
            .iter()
            .filter(|screen| !self.has_passed(screen.kind) && after != Some(screen.kind))
            .filter(|screen| before_m(screen) > -PASSED_M)
            .min_by(|a, b| before_m(a).total_cmp(&before_m(b)))
    }

    /// What was never an opening, and is not seen any more, or turns out to be painted on a wall,
    /// was something else; and so was what lies behind without having been passed.
    fn forget(&mut self, now_s: f64, camera_m: DVec3) {
        let walls: Vec<Plane> = self.walls().collect();
        let passed = &self.passed;
        self.screens.retain(|screen| {
            if screen.plane.behind_m(camera_m) > LEFT_BEHIND_M && !passed.contains(&screen.kind) {
                return false;
            }
            let is_window = screen.kind != Kind::Wall;
            let painted = is_window && walls.iter().any(|wall| lies_on(wall, &screen.plane));
            screen.opening.is_some() || now_s - screen.seen_s < FORGET_S && !painted
        });
    }

    fn walls(&self) -> impl Iterator<Item = Plane> {
        self.screens.iter().filter(|screen| screen.kind == Kind::Wall).map(|screen| screen.plane)
    }

    /// Whether a plane is that of a screen of another kind.
    fn is_another(&self, kind: Kind, plane: &Plane) -> bool {
        self.screens.iter().filter(|screen| screen.kind != kind).any(|screen| {
            let aside_m = screen.plane.within_m(plane.origin_m).x.abs();
            lies_on(&screen.plane, plane)
                && kind != Kind::Wall
                && (screen.kind == Kind::Wall || aside_m < SAME_M)
        })
    }
}

/// Whether a plane is that of a wall, and not of a window before it.
fn lies_on(wall: &Plane, plane: &Plane) -> bool {
    wall.behind_m(plane.origin_m).abs() < 0.2
}

/// A screen is passed when the whole vehicle, and a hand's breadth, is behind it. [m]
pub const PASSED_M: f64 = 0.32;
/// Farther behind than anything that is being flown through. [m]
const LEFT_BEHIND_M: f64 = 0.8;
/// Two windows do not stand beside each other nearer than this. [m]
const SAME_M: f64 = 0.8;
/// Long enough for a look elsewhere. [s]
const FORGET_S: f64 = 2.0;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::booth::{Brick, picture, room, window};

    const RED: [u8; 3] = [200, 28, 40];
    const BLUE: [u8; 3] = [30, 80, 210];

    fn looked(bricks: &[Brick], from_m: DVec3, seconds: u32) -> Known {
        let mut known = Known::default();
        let lattice = picture(bricks, from_m, 0.0);
        for n in 0..10 * seconds {
            known.update(f64::from(n) * 0.1, from_m, &lattice, None);
        }
        known
    }

    #[test]
    fn the_nearest_not_passed_comes_next() {
        let mut bricks = room();
        bricks.extend(window(DVec3::new(1.8, 0.1, 1.3), 0.6, RED));
        bricks.extend(window(DVec3::new(3.4, 0.0, 1.3), 0.6, BLUE));
        let from_m = DVec3::new(0.0, 0.0, 1.3);
        let mut known = looked(&bricks, from_m, 1);
        let red = Kind::Window(Paint::Red);
        assert_eq!(known.next(from_m, None).map(|screen| screen.kind), Some(red));
        let blue = Some(Kind::Window(Paint::Blue));
        assert_eq!(known.next(from_m, Some(red)).map(|screen| screen.kind), blue);
        known.pass(red);
        assert_eq!(known.next(from_m, None).map(|screen| screen.kind), blue);
        assert!(known.has_begun());
        let behind_m = DVec3::new(4.0, 0.0, 1.3);
        assert!(known.next(behind_m, None).is_none());
    }

    #[test]
    fn a_frame_painted_on_a_wall_is_forgotten() {
        let mut bricks = room();
        // 2 cm before the wall, of its thickness: paint.
        bricks.extend(window(DVec3::new(2.5, 0.0, 1.3), 0.6, BLUE));
        bricks.push(Brick {
            min_m: DVec3::new(2.5, -2.2, 0.0),
            max_m: DVec3::new(2.6, 2.2, 3.0),
            rgb: [150, 80, 60],
        });
        let known = looked(&bricks, DVec3::new(0.3, 0.0, 1.3), 1);
        let kinds: Vec<Kind> = known.screens().iter().map(|screen| screen.kind).collect();
        assert_eq!(kinds, [Kind::Wall]);
    }
}
