//! Wall across the net with an irregular gap, which has one opening at each height.

use glam::{DVec2, DVec3};
use vizflyt_arena::config::StageConfig;

use super::dimensions::{NET_MAX_M, NET_MIN_M};
use super::panel::{Block, Grain, INSET_M, Look, Painter, Panel};
use super::texture;
use crate::canvas::{Patch, paint};
use crate::random::Rng;

/// Brick wall with a gap.
#[derive(Clone, Debug)]
pub(crate) struct GapWall {
    seed: u64,
    x_m: f64,
    /// Centre of the gap: y and z. [m, world]
    middle_m: DVec2,
    half_height_m: f64,
    /// Extent of the gap to the right (-y) and left (+y) of its centre, from its lower to its upper end. [m]
    reach_m: [[f64; KNOTS]; 2],
}

impl GapWall {
    /// Draws a wall at `x_m`.
    pub(crate) fn draw(seed: u64, rng: &mut Rng, x_m: f64, side: f64) -> Self {
        let middle_m = DVec2::new(side * rng.range(0.15, 0.65), rng.range(1.2, 1.75));
        let half_height_m = rng.range(0.56, 0.74);
        let width_m = rng.range(0.56, 0.74);
        let mut reach_m = [[0.0; KNOTS]; 2];
        for side in &mut reach_m {
            for (n, reach) in side.iter_mut().enumerate() {
                let t = 2.0 * n as f64 / (KNOTS - 1) as f64 - 1.0;
                let oval = (1.0 - 0.92 * t * t).sqrt();
                *reach = (width_m * oval * rng.range(0.7, 1.2)).max(0.16);
            }
        }
        let mut wall = Self { seed, x_m, middle_m, half_height_m, reach_m };
        // Widen the gap until the vehicle fits, and keep its irregular shape.
        while wall.clearance_m() < CLEARANCE_M {
            for reach in wall.reach_m.iter_mut().flatten() {
                *reach *= 1.04;
            }
        }
        wall
    }

    /// Returns the gap as a stage of the course: a rectangle around its centre with the height of the gap and twice the
    /// extent of its narrower side.
    pub(crate) fn stage(&self, name: &str) -> StageConfig {
        let [right, left] = self.reach_m.map(|side| side.into_iter().fold(0.0, f64::max));
        StageConfig {
            name: name.to_owned(),
            center_m: DVec3::new(self.x_m, self.middle_m.x, self.middle_m.y),
            normal: DVec3::X,
            width_m: 2.0 * right.min(left),
            height_m: 2.0 * self.half_height_m,
            ..StageConfig::default()
        }
    }

    /// Returns the solids: complete blocks below and above the gap, thin layers next to it.
    pub(crate) fn blocks(&self) -> Vec<Block> {
        let (low, high) = self.gap_z_m();
        let mut blocks = vec![
            self.course(NET_MIN_M.y, NET_MAX_M.y, 0.0, low),
            self.course(NET_MIN_M.y, NET_MAX_M.y, high, TOP_M),
        ];
        let count = ((high - low) / COURSE_M).ceil() as usize;
        let height_m = (high - low) / count as f64;
        for n in 0..count {
            let z = low + height_m * n as f64;
            let (right, left) = self.edges_m(z + height_m / 2.0);
            blocks.push(self.course(NET_MIN_M.y, right, z, z + height_m));
            blocks.push(self.course(left, NET_MAX_M.y, z, z + height_m));
        }
        blocks
    }

    /// Returns a few boxes with approximately the same shadow.
    pub(crate) fn casters(&self) -> Vec<Block> {
        let (low, high) = self.gap_z_m();
        let mean = |side: [f64; KNOTS]| side.iter().sum::<f64>() / KNOTS as f64;
        let [right, left] = self.reach_m.map(mean);
        vec![
            self.course(NET_MIN_M.y, NET_MAX_M.y, 0.0, low),
            self.course(NET_MIN_M.y, NET_MAX_M.y, high, TOP_M),
            self.course(NET_MIN_M.y, self.middle_m.x - right, low, high),
            self.course(self.middle_m.x + left, NET_MAX_M.y, low, high),
        ]
    }

    /// Paints the wall.
    pub(crate) fn paint(&self, painter: &mut Painter) {
        let whole = self.course(NET_MIN_M.y, NET_MAX_M.y, 0.0, TOP_M);
        let grain = Grain { coarse_m: 0.1, fine_m: 0.03 };
        for face in [0, 1] {
            let panel = whole.face(face);
            painter.panel(&panel, grain, &|p| {
                let at = panel.corner_m + panel.right * p.x + panel.up * p.y;
                if self.is_hole(at.y, at.z) {
                    return None;
                }
                let colour = texture::bricks(self.seed ^ face as u64, DVec2::new(at.y, at.z));
                Some(Look::matt(colour))
            });
        }
        let ends = Grain { coarse_m: 0.06, fine_m: 0.06 };
        for face in [2, 3, 5] {
            painter.panel(&whole.face(face), ends, &|_| Some(Look::matt(paint(0x8a4a36))));
        }
        self.paint_rim(painter);
    }

    /// Paints the inner surfaces of the gap.
    fn paint_rim(&self, painter: &mut Painter) {
        let (low, high) = self.gap_z_m();
        let step_m = 0.035;
        let plaster = paint(0xcabfae);
        let count = ((high - low) / step_m) as usize;
        for n in 0..count {
            let z = low + (n as f64 + 0.5) / count as f64 * (high - low);
            let (right, left) = self.edges_m(z);
            let (right_up, left_up) = self.edges_m(z + 0.01);
            for (y, slope, inward) in
                [(right, (right_up - right) / 0.01, 1.0), (left, (left_up - left) / 0.01, -1.0)]
            {
                let normal = (DVec3::new(0.0, 1.0, -slope) * inward).normalize();
                let along = DVec3::new(0.0, slope, 1.0);
                let sigma_m = 0.55 * step_m * along.length();
                for row in 0..3 {
                    let x = self.x_m + (f64::from(row) - 1.0) * THICK_M / 3.0;
                    let p_m = DVec3::new(x, y, z);
                    let light = painter.light.matt(p_m, normal, plaster, &mut painter.rng);
                    painter.canvas.add(Patch {
                        center_m: p_m - normal * 0.003,
                        normal,
                        along,
                        sigma_m: DVec3::new(sigma_m, 0.55 * THICK_M / 3.0, 0.002),
                        opacity: 0.98,
                        radiance: light,
                    });
                }
            }
        }
        for (z, up) in [(low, 1.0), (high, -1.0)] {
            let (right, left) = self.edges_m(z);
            let panel = Panel {
                corner_m: DVec3::new(self.x_m - up * THICK_M / 2.0, right, z),
                right: DVec3::X * up,
                up: DVec3::Y,
                size_m: DVec2::new(THICK_M, left - right),
                inset_m: INSET_M,
            };
            let grain = Grain { coarse_m: 0.04, fine_m: 0.04 };
            painter.panel(&panel, grain, &|_| Some(Look::matt(plaster)));
        }
    }

    fn gap_z_m(&self) -> (f64, f64) {
        (self.middle_m.y - self.half_height_m, self.middle_m.y + self.half_height_m)
    }

    /// Returns the gap's right (-y) and left (+y) edges at a height. [m, world]
    fn edges_m(&self, z_m: f64) -> (f64, f64) {
        let (low, high) = self.gap_z_m();
        let s = ((z_m - low) / (high - low)).clamp(0.0, 1.0) * (KNOTS - 1) as f64;
        let n = (s as usize).min(KNOTS - 2);
        let t = s - n as f64;
        let [right, left] = self.reach_m.map(|side| side[n] + (side[n + 1] - side[n]) * t);
        (self.middle_m.x - right, self.middle_m.x + left)
    }

    fn is_hole(&self, y_m: f64, z_m: f64) -> bool {
        let (low, high) = self.gap_z_m();
        let (right, left) = self.edges_m(z_m);
        (low..high).contains(&z_m) && (right..left).contains(&y_m)
    }

    /// Returns the minimum distance from the gap's centre to its edge. [m]
    fn clearance_m(&self) -> f64 {
        let (low, high) = self.gap_z_m();
        (0..=200).fold(self.half_height_m, |least, n| {
            let z = low + (high - low) * f64::from(n) / 200.0;
            let (right, left) = self.edges_m(z);
            [right, left].into_iter().fold(least, |least, y| {
                least.min(DVec2::new(y - self.middle_m.x, z - self.middle_m.y).length())
            })
        })
    }

    fn course(&self, right_m: f64, left_m: f64, low_m: f64, high_m: f64) -> Block {
        Block::between(
            DVec3::new(self.x_m - THICK_M / 2.0, right_m, low_m),
            DVec3::new(self.x_m + THICK_M / 2.0, left_m, high_m),
        )
    }
}

const KNOTS: usize = 8;
/// Minimum free radius around the gap's centre: 0.8 m of width. [m]
const CLEARANCE_M: f64 = 0.41;
/// Height of a layer of the true wall next to the gap, finer than a voxel. [m]
const COURSE_M: f64 = 0.04;
const THICK_M: f64 = 0.12;
const TOP_M: f64 = 3.1;
