//! Pillars of foam blocks between start and goal, as obstacles for path planning.

use glam::{DQuat, DVec2, DVec3};

use super::dimensions::{NET_MAX_M, NET_MIN_M};
use super::panel::{Block, Grain, Look, Painter};
use crate::canvas::paint;
use crate::parts::{PartClass, Parts};
use crate::random::{Rng, noise2};

/// Vertical boxes on the floor.
#[derive(Debug, Default)]
pub(crate) struct Pillars {
    seed: u64,
    pillars: Vec<(Block, DVec3)>,
}

impl Pillars {
    /// Draws the pillars of a seed: two in each row across the net, with free space next to and between them. No
    /// straight line passes all rows.
    pub(crate) fn draw(seed: u64) -> Self {
        let mut rng = Rng::new(seed, 33);
        let mut pillars = Vec::new();
        let colours = [0xc8452e, 0x2f6db3, 0xd9a520, 0x3c8f5a];
        let mut side = if rng.chance(0.5) { 1.0 } else { -1.0 };
        for row in 0..ROWS {
            let x_m = FIRST_M + PITCH_M * f64::from(row);
            // One blocks the straight path, one is near a wall.
            for y_m in [side * rng.range(0.0, 0.25), -side * rng.range(1.35, 1.6)] {
                let half_m = DVec2::new(rng.range(0.14, 0.24), rng.range(0.14, 0.24));
                let top_m = if rng.chance(0.3) { rng.range(1.7, 2.0) } else { 3.2 };
                let middle_m = DVec3::new(x_m + rng.spread(0.15), y_m, top_m / 2.0);
                let block = Block {
                    center_m: middle_m,
                    half_m: half_m.extend(top_m / 2.0),
                    rotation: DQuat::from_rotation_z(rng.spread(0.4)),
                };
                pillars.push((block, paint(colours[rng.below(colours.len())])));
            }
            side = -side;
        }
        debug_assert!(pillars.iter().all(|(block, _)| {
            let reach_m = block.half_m.truncate().length();
            block.center_m.y + reach_m < NET_MAX_M.y && block.center_m.y - reach_m > NET_MIN_M.y
        }));
        Self { seed, pillars }
    }

    /// Returns the solids.
    pub(crate) fn blocks(&self) -> impl Iterator<Item = Block> {
        self.pillars.iter().map(|(block, _)| *block)
    }

    /// Paints the pillars as stacked blocks of foam.
    pub(crate) fn paint(&self, painter: &mut Painter, parts: &mut Parts) {
        for (n, (block, colour)) in self.pillars.iter().enumerate() {
            let seed = self.seed ^ (n as u64 * 131);
            let grain = Grain { coarse_m: 0.11, fine_m: 0.04 };
            painter.cuboid(block, grain, &[4], &|face, p| {
                let at = block.local(face, p);
                let up = (at.z + block.half_m.z) / LAYER_M;
                let seam = (up - up.round()).abs() * LAYER_M < 0.012;
                let tone = 0.8 + 0.3 * noise2(seed, DVec2::new(p.x, p.y) / 0.07);
                Some(Look::matt(*colour * if seam { 0.35 } else { tone }))
            });
            parts.add(&painter.canvas, PartClass::Pillar, &format!("pillar {}", n + 1));
        }
    }
}

const ROWS: u32 = 4;
/// Position of the first row along x, and distance between rows. [m]
const FIRST_M: f64 = 2.8;
const PITCH_M: f64 = 1.9;
/// Height of a block of foam. [m]
const LAYER_M: f64 = 0.4;

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::geometry::Volume;

    #[test]
    fn there_is_a_path_but_no_straight_one() {
        for seed in 0..50 {
            let pillars = Pillars::draw(seed);
            let volumes: Vec<Volume> = pillars.blocks().map(|block| block.volume()).collect();
            let clearance_m = |p_m: DVec3| {
                volumes.iter().map(|v| v.signed_distance_m(p_m)).fold(f64::MAX, f64::min)
            };
            let straight = (0..=200).map(|n| DVec3::new(0.9 + 0.047 * f64::from(n), 0.0, 1.2));
            assert!(straight.map(clearance_m).fold(f64::MAX, f64::min) < 0.12, "seed {seed}");
            // Each row has free space to pass.
            for row in 0..ROWS {
                let x_m = FIRST_M + PITCH_M * f64::from(row);
                let across = (-40..=40).map(|n| DVec3::new(x_m, 0.05 * f64::from(n), 1.2));
                assert!(across.map(clearance_m).fold(f64::MIN, f64::max) > 0.35, "seed {seed}");
            }
        }
    }
}
