//! Dimensions of the hall, its net, windows and lamps.

use glam::{DVec2, DVec3};

/// Minimum corner of the hall's inside. [m, world]
pub(crate) const HALL_MIN_M: DVec3 = DVec3::new(-3.0, -5.0, 0.0);
/// Maximum corner of the hall's inside. [m, world]
pub(crate) const HALL_MAX_M: DVec3 = DVec3::new(14.0, 5.0, 5.0);
/// Minimum corner of the netted flight space of 11 x 4.5 x 3.65 m. [m, world]
pub(crate) const NET_MIN_M: DVec3 = DVec3::new(0.0, -2.25, 0.0);
/// Maximum corner of the netted flight space. [m, world]
pub(crate) const NET_MAX_M: DVec3 = DVec3::new(11.0, 2.25, 3.65);

/// Window of the north wall, in metres along the wall from its west end and up.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Window {
    pub(super) min_m: DVec2,
    pub(super) max_m: DVec2,
}

/// Windows of the north wall.
pub(crate) const WINDOWS: [Window; 4] =
    [Window::at(1.2), Window::at(5.2), Window::at(9.2), Window::at(13.2)];

impl Window {
    const fn at(left_m: f64) -> Self {
        Self { min_m: DVec2::new(left_m, 1.5), max_m: DVec2::new(left_m + 2.6, 4.1) }
    }

    pub(super) fn contains(&self, p: DVec2, margin_m: f64) -> bool {
        p.cmpge(self.min_m - margin_m).all() && p.cmple(self.max_m + margin_m).all()
    }

    /// Whether light passes at a point of the wall: within the window, but not on its bars.
    pub(crate) fn is_pane(&self, p: DVec2) -> bool {
        let across = (p - self.min_m) / (self.max_m - self.min_m);
        let bar = |t: f64| (t - t.round()).abs() < 0.055;
        self.contains(p, 0.0) && !bar(across.x * 3.0) && !bar(across.y * 2.0)
    }
}

/// Centres of the ceiling tubes. [m, world]
pub(crate) const LAMPS_M: [DVec2; 8] = [
    DVec2::new(-0.5, -1.6),
    DVec2::new(3.5, -1.6),
    DVec2::new(7.5, -1.6),
    DVec2::new(11.5, -1.6),
    DVec2::new(-0.5, 1.6),
    DVec2::new(3.5, 1.6),
    DVec2::new(7.5, 1.6),
    DVec2::new(11.5, 1.6),
];
/// Half the length of a tube. [m]
pub(crate) const TUBE_HALF_M: f64 = 0.75;
