//! Directions of the pixels: slopes on a coarse grid with linear interpolation, so that a distorted
//! lens costs no more than a pinhole.

use glam::{DVec2, Vec2};
use vizflyt_protocol::geometry::Intrinsics;

/// Directions of the pixels of one camera.
#[derive(Debug, Default)]
pub(super) struct Rays {
    of: Option<Intrinsics>,
    /// Side of a cell. [px]
    pub(super) cell_px: usize,
    /// Number of corners per row.
    pub(super) columns: usize,
    /// Number of rows of corners.
    pub(super) rows: usize,
    /// `(x / z, y / z)` at the corners, row-major. [cam]
    pub(super) slopes: Vec<Vec2>,
    /// Minimum of the slopes.
    pub(super) low: Vec2,
    /// Maximum of the slopes.
    pub(super) high: Vec2,
}

/// Maximum cells across an image, so that the cost of their corners is the same for images of any
/// size.
const MOST_CELLS: usize = 40;
/// Minimum size of a cell. Smaller cells are not cheaper than single pixels. [px]
const LEAST_CELL_PX: usize = 8;

impl Rays {
    /// Recomputes the grid if the intrinsics differ from those of the previous call.
    pub(super) fn follow(&mut self, k: &Intrinsics) {
        if self.of == Some(*k) {
            return;
        }
        self.of = Some(*k);
        let (width, height) = (k.width_px as usize, k.height_px as usize);
        self.cell_px = width.max(height).div_ceil(MOST_CELLS).max(LEAST_CELL_PX);
        self.columns = width.div_ceil(self.cell_px) + 1;
        self.rows = height.div_ceil(self.cell_px) + 1;
        self.slopes.clear();
        (self.low, self.high) = (Vec2::INFINITY, Vec2::NEG_INFINITY);
        let centre = DVec2::new(k.cx_px, k.cy_px);
        for row in 0..self.rows {
            for column in 0..self.columns {
                let pixel = DVec2::new((column * self.cell_px) as f64, (row * self.cell_px) as f64);
                // Beyond the field of the lens, use the slope at its border.
                let slope = k.slope(pixel).unwrap_or_else(|| {
                    (pixel - centre).normalize_or_zero() * k.distortion.reach().min(FLATTEST)
                });
                let slope = slope.clamp_length_max(FLATTEST).as_vec2();
                self.slopes.push(slope);
                self.low = self.low.min(slope);
                self.high = self.high.max(slope);
            }
        }
    }

    /// Returns the row of corners above a row of pixels, and the share of the distance to the next
    /// row of corners.
    pub(super) fn row_at(&self, y: usize) -> (usize, f32) {
        ((y / self.cell_px), ((y % self.cell_px) as f32 + 0.5) / self.cell_px as f32)
    }

    /// Writes the slopes of a row of pixels.
    pub(super) fn write_row(&self, y: usize, sx: &mut [f32], sy: &mut [f32]) {
        let (row, down) = self.row_at(y);
        let corner = |column: usize| {
            let above = self.slopes[row * self.columns + column];
            above.lerp(self.slopes[(row + 1) * self.columns + column], down)
        };
        let per_px = 1.0 / self.cell_px as f32;
        let cells = sx.chunks_mut(self.cell_px).zip(sy.chunks_mut(self.cell_px)).enumerate();
        for (column, (sx, sy)) in cells {
            let (left, right) = (corner(column), corner(column + 1));
            let step = (right - left) * per_px;
            for (n, (sx, sy)) in sx.iter_mut().zip(sy).enumerate() {
                let across = n as f32 + 0.5;
                (*sx, *sy) = (left.x + step.x * across, left.y + step.y * across);
            }
        }
    }
}

/// Maximum slope: 87 degrees off the axis. Larger slopes are clamped.
const FLATTEST: f64 = 20.0;

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::geometry::Distortion;

    fn check(k: Intrinsics, within_rad: f64) {
        let mut rays = Rays::default();
        rays.follow(&k);
        let width = k.width_px as usize;
        let (mut sx, mut sy) = (vec![0.0; width], vec![0.0; width]);
        for y in (0..k.height_px as usize).step_by(7) {
            rays.write_row(y, &mut sx, &mut sy);
            for x in (0..width).step_by(5) {
                let Some(slope) = k.slope(DVec2::new(x as f64 + 0.5, y as f64 + 0.5)) else {
                    continue;
                };
                let found = DVec2::new(f64::from(sx[x]), f64::from(sy[x]));
                // Compare by the angle between the directions.
                let cos = found.extend(1.0).normalize().dot(slope.extend(1.0).normalize());
                assert!(1.0 - cos < 0.5 * within_rad * within_rad, "({x}, {y}): {found} {slope}");
            }
        }
    }

    #[test]
    fn slopes_match_the_intrinsics() {
        let pinhole = Intrinsics::from_horizontal_fov(163, 121, 1.6);
        check(pinhole, 1e-5);
        check(Intrinsics::from_horizontal_fov(1, 1, 1.0), 1e-5);
        let barrel = Distortion::BrownConrady { k1: -0.2, k2: 0.04, p1: 0.001, p2: 0.0, k3: 0.0 };
        check(Intrinsics { distortion: barrel, ..pinhole }, 5e-3);
        let fisheye = Distortion::KannalaBrandt { k1: 0.01, k2: 0.0, k3: 0.0, k4: 0.0 };
        check(Intrinsics { distortion: fisheye, ..pinhole }, 1e-2);
    }
}
