//! Painting of flat faces with one Gaussian per cell of a quadtree, which is coarse where the texture is uniform and
//! fine along its edges.

use glam::{DQuat, DVec2, DVec3};

use super::light::HallLight;
use crate::canvas::{Canvas, Patch};
use crate::random::Rng;

/// Appearance of a texture at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Look {
    /// Share of reflected light, linear.
    pub(crate) albedo: DVec3,
    /// Emitted light, linear.
    pub(crate) glow: DVec3,
}

impl Look {
    /// Returns a matt colour.
    pub(crate) fn matt(albedo: DVec3) -> Self {
        Self { albedo, glow: DVec3::ZERO }
    }

    /// Returns a lamp or a bright window.
    pub(crate) fn lamp(glow: DVec3) -> Self {
        Self { albedo: DVec3::splat(0.2), glow }
    }
}

/// Rectangle with the normal `right x up`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Panel {
    /// Lower left corner. [m, world]
    pub(crate) corner_m: DVec3,
    /// Unit direction of the width. [world]
    pub(crate) right: DVec3,
    /// Unit direction of the height. [world]
    pub(crate) up: DVec3,
    /// Width and height. [m]
    pub(crate) size_m: DVec2,
    /// Depth of patches below the surface. [m]
    pub(crate) inset_m: f64,
}

/// Maximum and minimum side of a cell. [m]
#[derive(Clone, Copy, Debug)]
pub(crate) struct Grain {
    pub(crate) coarse_m: f64,
    pub(crate) fine_m: f64,
}

/// Canvas and light of a hall.
pub(crate) struct Painter<'a> {
    pub(crate) canvas: Canvas,
    pub(crate) rng: Rng,
    pub(crate) light: HallLight<'a>,
}

impl Painter<'_> {
    /// Covers a panel with a texture, in metres right and up from its corner; `None` is a hole.
    pub(crate) fn panel(
        &mut self,
        panel: &Panel,
        grain: Grain,
        texture: &dyn Fn(DVec2) -> Option<Look>,
    ) {
        let columns = (panel.size_m.x / grain.coarse_m).ceil().max(1.0);
        let rows = (panel.size_m.y / grain.coarse_m).ceil().max(1.0);
        let cell_m = panel.size_m / DVec2::new(columns, rows);
        for row in 0..rows as usize {
            for column in 0..columns as usize {
                let at = DVec2::new(column as f64, row as f64) * cell_m;
                self.cell(panel, at, cell_m, grain.fine_m, texture);
            }
        }
    }

    /// Same as [`Self::panel`], with large patches behind it that close the seams between cells. They are so deep that
    /// they are behind the surface on any line of sight, and never blur it.
    pub(crate) fn backed_panel(
        &mut self,
        panel: &Panel,
        grain: Grain,
        texture: &dyn Fn(DVec2) -> Option<Look>,
    ) {
        self.panel(panel, grain, texture);
        let normal = panel.right.cross(panel.up);
        let counts = (panel.size_m / BED_M).ceil();
        let cell_m = panel.size_m / counts;
        for row in 0..counts.y as usize {
            for column in 0..counts.x as usize {
                let middle_m = (DVec2::new(column as f64, row as f64) + 0.5) * cell_m;
                let mut mean = Look::matt(DVec3::ZERO);
                for n in 0..9 {
                    let offset = DVec2::new(f64::from(n % 3), f64::from(n / 3)) / 3.0 - 1.0 / 3.0;
                    let look = texture(middle_m + offset * cell_m).unwrap_or(mean);
                    mean.albedo += look.albedo / 9.0;
                    mean.glow += look.glow / 9.0;
                }
                let p_m = panel.corner_m + panel.right * middle_m.x + panel.up * middle_m.y;
                let light = self.light.matt(p_m, normal, mean.albedo, &mut self.rng);
                self.canvas.add(Patch {
                    center_m: p_m - normal * BED_DEPTH_M,
                    normal,
                    along: panel.right,
                    sigma_m: (cell_m * 0.58).extend(0.002),
                    opacity: 0.99,
                    radiance: light + mean.glow,
                });
            }
        }
    }

    fn cell(
        &mut self,
        panel: &Panel,
        at_m: DVec2,
        size_m: DVec2,
        fine_m: f64,
        texture: &dyn Fn(DVec2) -> Option<Look>,
    ) {
        let middle_m = at_m + size_m / 2.0;
        if size_m.max_element() > fine_m * 1.5 && is_varied(panel, middle_m, size_m, texture) {
            // Halve only the long side of a slim cell, and both sides of a square cell.
            let split = DVec2::new(
                if size_m.x * 1.5 > size_m.y { 2.0 } else { 1.0 },
                if size_m.y * 1.5 > size_m.x { 2.0 } else { 1.0 },
            );
            let half_m = size_m / split;
            for row in 0..split.y as usize {
                for column in 0..split.x as usize {
                    let corner = at_m + half_m * DVec2::new(column as f64, row as f64);
                    self.cell(panel, corner, half_m, fine_m, texture);
                }
            }
            return;
        }
        let Some(look) = texture(middle_m) else { return };
        let normal = panel.right.cross(panel.up);
        let p_m = panel.corner_m + panel.right * middle_m.x + panel.up * middle_m.y;
        let shade = 1.0 + 0.035 * self.rng.normal().clamp(-2.0, 2.0);
        let radiance = self.light.matt(p_m, normal, look.albedo, &mut self.rng) * shade + look.glow;
        self.canvas.add(Patch {
            center_m: p_m - normal * panel.inset_m,
            normal,
            along: panel.right,
            sigma_m: (size_m * SIGMA_PER_SIDE).extend(0.002),
            opacity: 0.985,
            radiance,
        });
    }

    /// Covers the faces of a box with `texture(face, point)`. Faces are -x, +x, -y, +y, -z, +z in the box's axes. Faces
    /// in `skip` are omitted.
    pub(crate) fn cuboid(
        &mut self,
        block: &Block,
        grain: Grain,
        skip: &[usize],
        texture: &dyn Fn(usize, DVec2) -> Option<Look>,
    ) {
        for face in (0..6).filter(|face| !skip.contains(face)) {
            self.panel(&block.face(face), grain, &|p| texture(face, p));
        }
    }
}

/// Box of any orientation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Block {
    /// Centre. [m, world]
    pub(crate) center_m: DVec3,
    /// Half of each side. [m]
    pub(crate) half_m: DVec3,
    /// Rotation from the box's axes to the world's.
    pub(crate) rotation: DQuat,
}

impl Block {
    /// Returns an upright box from two corners. [m, world]
    pub(crate) fn between(min_m: DVec3, max_m: DVec3) -> Self {
        Self {
            center_m: (min_m + max_m) / 2.0,
            half_m: (max_m - min_m) / 2.0,
            rotation: DQuat::IDENTITY,
        }
    }

    /// Returns the solid.
    pub(crate) fn volume(&self) -> vizflyt_protocol::geometry::Volume {
        vizflyt_protocol::geometry::Volume::Cuboid {
            center_m: self.center_m,
            half_m: self.half_m,
            rotation: self.rotation,
        }
    }

    /// Returns a point of a face in the box's axes, from its centre. [m]
    pub(crate) fn local(&self, face: usize, p: DVec2) -> DVec3 {
        let panel = self.face(face);
        let at = panel.corner_m + panel.right * p.x + panel.up * p.y;
        self.rotation.conjugate() * (at - self.center_m)
    }

    /// Returns a face as seen from outside: -x, +x, -y, +y, -z, +z.
    pub(crate) fn face(&self, face: usize) -> Panel {
        // (Outward, right, up) in the box's axes, with right x up = outward.
        let (out, right, up) = match face {
            0 => (DVec3::NEG_X, DVec3::NEG_Y, DVec3::Z),
            1 => (DVec3::X, DVec3::Y, DVec3::Z),
            2 => (DVec3::NEG_Y, DVec3::X, DVec3::Z),
            3 => (DVec3::Y, DVec3::NEG_X, DVec3::Z),
            4 => (DVec3::NEG_Z, DVec3::NEG_X, DVec3::Y),
            _ => (DVec3::Z, DVec3::X, DVec3::Y),
        };
        let half = |axis: DVec3| axis.abs().dot(self.half_m);
        let corner = out * half(out) - right * half(right) - up * half(up);
        Panel {
            corner_m: self.center_m + self.rotation * corner,
            right: self.rotation * right,
            up: self.rotation * up,
            size_m: 2.0 * DVec2::new(half(right), half(up)),
            inset_m: INSET_M,
        }
    }
}

/// Whether the texture changes within a cell or near it. A large Gaussian extends beyond its cell, so it must not be
/// near edges.
fn is_varied(
    panel: &Panel,
    middle_m: DVec2,
    size_m: DVec2,
    texture: &dyn Fn(DVec2) -> Option<Look>,
) -> bool {
    let limit_m = panel.size_m - DVec2::splat(1e-6);
    let (mut low, mut high) = (DVec3::splat(f64::MAX), DVec3::splat(f64::MIN));
    let (mut solid, mut hole) = (false, false);
    for row in 0..6 {
        for column in 0..6 {
            let offset = DVec2::new(f64::from(column), f64::from(row)) / 5.0 - 0.5;
            let p = (middle_m + offset * size_m * 1.5).clamp(DVec2::splat(1e-6), limit_m);
            if let Some(look) = texture(p) {
                // Square roots approximate perceived brightness.
                let seen = look.albedo + look.glow;
                let seen = DVec3::new(seen.x.sqrt(), seen.y.sqrt(), seen.z.sqrt());
                low = low.min(seen);
                high = high.max(seen);
                solid = true;
            } else {
                hole = true;
            }
        }
    }
    solid && (hole || (high - low).max_element() > CONTRAST)
}

/// Standard deviation relative to the side of a cell. The centre of a neighbour is 1.75 standard deviations away, so
/// that cells overlap to an opaque surface.
const SIGMA_PER_SIDE: f64 = 0.57;
/// Depth of patches below a surface, which is about their thickness. [m]
pub(crate) const INSET_M: f64 = 0.003;
/// Side of a patch behind a panel. [m]
const BED_M: f64 = 0.4;
/// Depth of these patches. [m]
const BED_DEPTH_M: f64 = 0.42;
/// Minimum difference of square roots of light for an edge.
const CONTRAST: f64 = 0.13;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faces_lie_on_the_box_and_point_outwards() {
        let block = Block {
            center_m: DVec3::new(1.0, 2.0, 3.0),
            half_m: DVec3::new(0.5, 0.2, 0.1),
            rotation: DQuat::from_rotation_z(0.7),
        };
        for face in 0..6 {
            let panel = block.face(face);
            let middle = panel.corner_m
                + panel.right * panel.size_m.x / 2.0
                + panel.up * panel.size_m.y / 2.0;
            assert!(block.volume().signed_distance_m(middle).abs() < 1e-12);
            let out = panel.right.cross(panel.up);
            assert!((block.volume().outward_normal(middle) - out).length() < 1e-6);
        }
    }
}
