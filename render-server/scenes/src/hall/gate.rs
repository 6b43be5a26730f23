//! Racing windows: frames on stands, with chequered corners and coloured bars.

use glam::{DQuat, DVec2, DVec3};
use vizflyt_arena::config::StageConfig;

use super::panel::{Block, Grain, Look, Painter};
use crate::canvas::paint;

/// Frame with an opening, on two legs.
#[derive(Clone, Debug)]
pub(crate) struct Gate {
    /// Centre of the opening. [m, world]
    pub(crate) center_m: DVec3,
    /// Direction of passage, counter-clockwise from x. [rad, world]
    pub(crate) yaw_rad: f64,
    /// Width and height of the opening. [m]
    pub(crate) opening_m: DVec2,
    /// Colours of bars and stripes.
    pub(crate) colours: (DVec3, DVec3),
    /// Whether the lower bar has a motor, which turns a hand.
    pub(crate) with_hub: bool,
}

impl Gate {
    /// Returns the gate as a stage of the course.
    pub(crate) fn stage(&self, name: &str) -> StageConfig {
        StageConfig {
            name: name.to_owned(),
            center_m: self.center_m,
            normal: self.rotation() * DVec3::X,
            width_m: self.opening_m.x,
            height_m: self.opening_m.y,
            ..StageConfig::default()
        }
    }

    /// Returns the solids: four bars, two legs, two feet, and the motor if there is one.
    pub(crate) fn blocks(&self) -> Vec<Block> {
        self.bars().into_iter().chain(self.stand()).collect()
    }

    /// Paints the bars.
    pub(crate) fn paint_frame(&self, painter: &mut Painter) {
        let middle_m = self.center_m;
        let back = self.rotation().conjugate();
        let outer_m = self.opening_m / 2.0 + BAR_M;
        for (n, bar) in self.bars().into_iter().enumerate() {
            // The ends of the horizontal bars touch the vertical ones.
            let skip: &[usize] = if n < 2 { &[] } else { &[2, 3] };
            let grain = Grain { coarse_m: 0.04, fine_m: 0.02 };
            let offset = back * (bar.center_m - middle_m);
            painter.cuboid(&bar, grain, skip, &|face, p| {
                let at = offset + bar.local(face, p);
                let (y, z) = (at.y.abs(), at.z.abs());
                let corner = y > outer_m.x - BAR_M && z > outer_m.y - BAR_M;
                let (red, pale) = self.colours;
                let odd = |v: f64, side_m: f64| (v / side_m).floor() as i64;
                Some(Look::matt(if corner {
                    let cells = odd(at.y, BAR_M / 2.0) + odd(at.z, BAR_M / 2.0);
                    if cells.rem_euclid(2) == 0 { paint(0x121214) } else { paint(0xf2f0ea) }
                } else if (outer_m - DVec2::new(y, z)).min_element() < 0.02 {
                    pale
                } else {
                    // Arrowheads that point to the centre of each side.
                    let (along, across) =
                        if y > outer_m.x - BAR_M { (z, y - outer_m.x) } else { (y, z - outer_m.y) };
                    let wedge = along + (across + BAR_M / 2.0).abs();
                    if odd(wedge, 0.11).rem_euclid(3) == 0 { pale } else { red }
                }))
            });
        }
    }

    /// Paints legs, feet, and the motor if there is one.
    pub(crate) fn paint_stand(&self, painter: &mut Painter) {
        for (n, block) in self.stand().into_iter().enumerate() {
            let hub = n == 4;
            let colour = if hub { paint(0x1d1e21) } else { paint(0x8b8e93) };
            let grain = Grain { coarse_m: 0.045, fine_m: 0.025 };
            painter.cuboid(&block, grain, &[], &|face, p| {
                let q = block.local(face, p);
                let axle =
                    hub && q.truncate().x.abs() > 0.0 && DVec2::new(q.y, q.z).length() < 0.03;
                Some(Look::matt(if axle { paint(0xd8b23a) } else { colour }))
            });
        }
    }

    /// Returns the position of a point in the gate's axes (x along the passage, z up, from its centre). [m, world]
    pub(crate) fn at(&self, offset_m: DVec3) -> DVec3 {
        self.center_m + self.rotation() * offset_m
    }

    fn rotation(&self) -> DQuat {
        DQuat::from_rotation_z(self.yaw_rad)
    }

    /// Returns the bars: left, right, top, bottom.
    fn bars(&self) -> [Block; 4] {
        let half = self.opening_m / 2.0;
        let across = half.x + BAR_M / 2.0;
        let up = half.y + BAR_M / 2.0;
        let upright = DVec3::new(THICK_M / 2.0, BAR_M / 2.0, half.y + BAR_M);
        let level = DVec3::new(THICK_M / 2.0, half.x, BAR_M / 2.0);
        [
            self.block(DVec3::new(0.0, across, 0.0), upright),
            self.block(DVec3::new(0.0, -across, 0.0), upright),
            self.block(DVec3::new(0.0, 0.0, up), level),
            self.block(DVec3::new(0.0, 0.0, -up), level),
        ]
    }

    fn stand(&self) -> Vec<Block> {
        let half = self.opening_m / 2.0;
        let across = half.x + BAR_M / 2.0;
        let floor = -self.center_m.z;
        let top = -half.y - BAR_M;
        let mut blocks = Vec::new();
        for y in [-across, across] {
            let leg = DVec3::new(0.025, 0.025, (top - floor) / 2.0);
            blocks.push(self.block(DVec3::new(0.0, y, f64::midpoint(top, floor)), leg));
            let foot = DVec3::new(0.32, 0.04, 0.015);
            blocks.push(self.block(DVec3::new(0.0, y, floor + 0.015), foot));
        }
        if self.with_hub {
            let half_m = DVec3::new(0.07, 0.075, 0.075);
            blocks.push(self.block(DVec3::new(0.0, 0.0, -half.y), half_m));
        }
        blocks
    }

    fn block(&self, offset_m: DVec3, half_m: DVec3) -> Block {
        let rotation = self.rotation();
        Block { center_m: self.center_m + rotation * offset_m, half_m, rotation }
    }
}

/// Width of a bar. [m]
const BAR_M: f64 = 0.16;
/// Thickness of a gate along the passage. [m]
const THICK_M: f64 = 0.09;
