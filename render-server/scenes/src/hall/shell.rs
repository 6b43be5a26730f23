//! Hall around the net: floor, walls with windows and posters, ceiling with tubes, truss and net; the furniture is in
//! [`super::furniture`]. It is the same for `room` and `race`; colours and posters depend on the seed.

use glam::{DVec2, DVec3};
use vizflyt_protocol::geometry::Volume;

use super::dimensions::{
    HALL_MAX_M, HALL_MIN_M, LAMPS_M, NET_MAX_M, NET_MIN_M, TUBE_HALF_M, WINDOWS,
};
use super::furniture::Furniture;
use super::panel::{Block, Grain, INSET_M, Look, Painter, Panel};
use super::texture;
use crate::canvas::{Patch, paint};
use crate::random::{fractal2, noise2, smoothstep};

/// Hall of a seed.
pub(crate) struct Shell {
    seed: u64,
    furniture: Furniture,
    truss: Vec<Block>,
}

impl Shell {
    /// Plans the hall of a seed.
    pub(crate) fn plan(seed: u64) -> Self {
        Self { seed, furniture: Furniture::place(seed), truss: truss() }
    }

    /// Returns the true solids: floor, walls, ceiling, truss and furniture.
    pub(crate) fn truth(&self) -> Vec<Volume> {
        let (a, b) = (HALL_MIN_M, HALL_MAX_M);
        let thick_m = 0.3;
        let wall = |min: DVec3, max: DVec3| Volume::aabb(min, max);
        let mut volumes = vec![
            Volume::HalfSpace { normal: DVec3::Z, offset_m: 0.0 },
            wall(DVec3::new(a.x - thick_m, a.y, -0.1), DVec3::new(a.x, b.y, b.z)),
            wall(DVec3::new(b.x, a.y, -0.1), DVec3::new(b.x + thick_m, b.y, b.z)),
            wall(DVec3::new(a.x, a.y - thick_m, -0.1), DVec3::new(b.x, a.y, b.z)),
            wall(DVec3::new(a.x, b.y, -0.1), DVec3::new(b.x, b.y + thick_m, b.z)),
            wall(DVec3::new(a.x, a.y, b.z), DVec3::new(b.x, b.y, b.z + thick_m)),
        ];
        volumes.extend(self.truss.iter().map(Block::volume));
        volumes.extend(self.furniture.volumes());
        volumes
    }

    /// Returns the boxes that cast visible shadows.
    pub(crate) fn casters(&self) -> Vec<Volume> {
        self.furniture.casters()
    }

    /// Paints the hall; `mats` colours the floor within the net.
    pub(crate) fn paint(&self, painter: &mut Painter, mats: &dyn Fn(DVec2) -> DVec3) {
        self.paint_floor(painter, mats);
        self.paint_walls(painter);
        paint_ceiling(painter);
        for block in &self.truss {
            let grain = Grain { coarse_m: 0.11, fine_m: 0.11 };
            painter.cuboid(block, grain, &[], &|_, p| {
                let band = noise2(7, DVec2::new(p.y / 0.3, p.x / 0.3));
                Some(Look::matt(paint(0x5b5f66).lerp(paint(0xa9adb2), band)))
            });
        }
        self.furniture.paint(painter);
        paint_net(painter);
    }

    fn paint_floor(&self, painter: &mut Painter, mats: &dyn Fn(DVec2) -> DVec3) {
        let (a, b) = (NET_MIN_M, NET_MAX_M);
        let inside = floor_panel(a.truncate(), b.truncate());
        let grain = Grain { coarse_m: 0.095, fine_m: 0.04 };
        painter.backed_panel(&inside, grain, &|p| Some(Look::matt(mats(p + a.truncate()))));
        // Polished concrete around it, with yellow tape along the net.
        let seed = self.seed;
        let concrete = move |at: DVec2| {
            let stain = fractal2(seed ^ 0x31, at / 1.9, 4);
            let speck = noise2(seed ^ 0x32, at / 0.11);
            let base = paint(0x6f7072).lerp(paint(0xa3a19b), 0.7 * stain + 0.3 * speck);
            let joint = |v: f64| (v / 3.0 - (v / 3.0).round()).abs() * 3.0 < 0.02;
            let out = (a.truncate() - at).max(at - b.truncate()).max_element();
            if (0.28..0.36).contains(&out) {
                paint(0xd8b21c) * (0.7 + 0.4 * speck)
            } else if joint(at.x - 1.0) || joint(at.y - 0.5) {
                base * 0.45
            } else {
                base
            }
        };
        let (low, high) = (HALL_MIN_M.truncate(), HALL_MAX_M.truncate());
        let strips = [
            (low, DVec2::new(high.x, a.y)),
            (DVec2::new(low.x, b.y), high),
            (DVec2::new(low.x, a.y), DVec2::new(a.x, b.y)),
            (DVec2::new(b.x, a.y), DVec2::new(high.x, b.y)),
        ];
        for (min, max) in strips {
            let grain = Grain { coarse_m: 0.19, fine_m: 0.09 };
            painter.backed_panel(&floor_panel(min, max), grain, &|p| {
                Some(Look::matt(concrete(p + min)))
            });
        }
    }

    fn paint_walls(&self, painter: &mut Painter) {
        let (a, b) = (HALL_MIN_M, HALL_MAX_M);
        let long = DVec2::new(b.x - a.x, b.z);
        let short = DVec2::new(b.y - a.y, b.z);
        let panel = |corner_m, right, size_m| Panel {
            corner_m,
            right,
            up: DVec3::Z,
            size_m,
            inset_m: INSET_M,
        };
        let north = panel(DVec3::new(a.x, b.y, 0.0), DVec3::X, long);
        let south = panel(DVec3::new(b.x, a.y, 0.0), DVec3::NEG_X, long);
        let east = panel(DVec3::new(b.x, b.y, 0.0), DVec3::NEG_Y, short);
        let west = panel(DVec3::new(a.x, a.y, 0.0), DVec3::Y, short);
        let grain = Grain { coarse_m: 0.36, fine_m: 0.042 };
        let seed = self.seed;
        painter.backed_panel(&north, grain, &|p| {
            if let Some(window) = WINDOWS.iter().find(|window| window.contains(p, 0.09)) {
                return Some(if window.is_pane(p) {
                    Look::lamp(texture::outside(seed, p))
                } else {
                    Look::matt(paint(0xe8e8e4))
                });
            }
            Some(Look::matt(texture::wall(seed, p)))
        });
        painter.backed_panel(&south, grain, &|p| Some(texture::with_pictures(seed, 1, p)));
        painter.backed_panel(&east, grain, &|p| Some(texture::with_pictures(seed, 2, p)));
        painter.backed_panel(&west, grain, &|p| Some(texture::with_pictures(seed, 3, p)));
    }
}

/// Returns the walls without windows: a point at the floor, the inward normal, and the extent to both sides. [m, world]
pub(crate) fn walls() -> [(DVec3, DVec3, f64); 3] {
    let middle = (HALL_MIN_M + HALL_MAX_M) / 2.0;
    let half = (HALL_MAX_M - HALL_MIN_M) / 2.0 - 0.4;
    [
        (DVec3::new(middle.x, HALL_MIN_M.y, 0.0), DVec3::Y, half.x),
        (DVec3::new(HALL_MIN_M.x, middle.y, 0.0), DVec3::X, half.y),
        (DVec3::new(HALL_MAX_M.x, middle.y, 0.0), DVec3::NEG_X, half.y),
    ]
}

/// Returns a horizontal panel that faces up. [m, world]
pub(crate) fn floor_panel(min: DVec2, max: DVec2) -> Panel {
    // At a grazing angle, a pixel has the depth of the nearest patch that covers it. With patches 2 cm below, the
    // rendered floor is at its true height.
    Panel {
        corner_m: min.extend(0.0),
        right: DVec3::X,
        up: DVec3::Y,
        size_m: max - min,
        inset_m: 0.024,
    }
}

/// Returns the posts and rails that carry the net, just outside of it.
fn truss() -> Vec<Block> {
    let half_m = 0.055;
    let (a, b) = (NET_MIN_M - 0.14, NET_MAX_M + 0.14);
    let mut blocks = Vec::new();
    for x in [a.x, 5.5, b.x] {
        for y in [a.y, b.y] {
            let low = DVec3::new(x - half_m, y - half_m, 0.0);
            blocks.push(Block::between(low, DVec3::new(x + half_m, y + half_m, b.z)));
        }
        let low = DVec3::new(x - half_m, a.y - half_m, b.z);
        let high = DVec3::new(x + half_m, b.y + half_m, b.z + 2.0 * half_m);
        blocks.push(Block::between(low, high));
    }
    for y in [a.y, b.y] {
        let low = DVec3::new(a.x - half_m, y - half_m, b.z);
        let high = DVec3::new(b.x + half_m, y + half_m, b.z + 2.0 * half_m);
        blocks.push(Block::between(low, high));
    }
    blocks
}

fn paint_ceiling(painter: &mut Painter) {
    let panel = Panel {
        corner_m: DVec3::new(HALL_MAX_M.x, HALL_MIN_M.y, HALL_MAX_M.z),
        right: DVec3::NEG_X,
        up: DVec3::Y,
        size_m: (HALL_MAX_M - HALL_MIN_M).truncate(),
        inset_m: INSET_M,
    };
    let grain = Grain { coarse_m: 0.4, fine_m: 0.1 };
    painter.backed_panel(&panel, grain, &|p| {
        let at = DVec2::new(HALL_MAX_M.x - p.x, HALL_MIN_M.y + p.y);
        let lamp = LAMPS_M
            .iter()
            .any(|lamp| (at.x - lamp.x).abs() < TUBE_HALF_M && (at.y - lamp.y).abs() < 0.14);
        if lamp {
            return Some(Look::lamp(DVec3::new(1.7, 1.68, 1.6)));
        }
        // Trapezoidal sheets between steel beams.
        let beam = (at.x / 2.83 - (at.x / 2.83).round()).abs() * 2.83 < 0.12;
        let rib = smoothstep(0.3, 0.5, (at.y / 0.9 - (at.y / 0.9).round()).abs());
        Some(Look::matt(if beam {
            paint(0x7a7d82)
        } else {
            paint(0xd6d6d2).lerp(paint(0xb4b5b2), rib)
        }))
    });
}

/// Paints the net: thin, translucent strands on all sides of the flight space and above it. They are too faint to count
/// as obstacles, because the fence keeps vehicles away from the net.
fn paint_net(painter: &mut Painter) {
    let (a, b) = (NET_MIN_M - 0.05, NET_MAX_M + 0.05);
    let mut strand = |from_m: DVec3, to_m: DVec3| {
        let axis = to_m - from_m;
        let pieces = (axis.length() / 0.42).ceil();
        for n in 0..pieces as usize {
            painter.canvas.add(Patch {
                center_m: from_m + axis * ((n as f64 + 0.5) / pieces),
                normal: axis.cross(DVec3::new(0.3, 0.5, 0.8)),
                along: axis,
                sigma_m: DVec3::new(axis.length() / pieces * 0.55, 0.0025, 0.0025),
                opacity: 0.17,
                radiance: DVec3::splat(0.04),
            });
        }
    };
    let count = |length_m: f64| (length_m / NET_PITCH_M).round() as usize;
    let steps = |low: f64, high: f64| {
        let n = count(high - low);
        (0..=n).map(move |i| low + (high - low) * i as f64 / n as f64)
    };
    for y in [a.y, b.y] {
        for x in steps(a.x, b.x) {
            strand(DVec3::new(x, y, 0.0), DVec3::new(x, y, b.z));
        }
        for z in steps(0.0, b.z).skip(1) {
            strand(DVec3::new(a.x, y, z), DVec3::new(b.x, y, z));
        }
    }
    for x in [a.x, b.x] {
        for y in steps(a.y, b.y) {
            strand(DVec3::new(x, y, 0.0), DVec3::new(x, y, b.z));
        }
        for z in steps(0.0, b.z).skip(1) {
            strand(DVec3::new(x, a.y, z), DVec3::new(x, b.y, z));
        }
    }
    for x in steps(a.x, b.x) {
        strand(DVec3::new(x, a.y, b.z), DVec3::new(x, b.y, b.z));
    }
    for y in steps(a.y, b.y) {
        strand(DVec3::new(a.x, y, b.z), DVec3::new(b.x, y, b.z));
    }
}

/// Mesh width of the net, wider than in real nets so that it is visible at 320 pixels. [m]
const NET_PITCH_M: f64 = 0.31;
