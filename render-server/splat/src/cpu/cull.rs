//! Pass 1: selects the blocks of splats that can touch the image.
//!
//! Budget: 5 planes per block of 256 splats, 20 us per million splats.

use glam::{DMat3, DVec2, DVec3, Vec3};
use vizflyt_protocol::geometry::{Cam, Frame, Pose};

use super::detail::BRANCH;
use super::lens::{Lens, Model};
use super::scene::{Block, Part};
use crate::limits::BLUR_PX2;
use crate::{Atmosphere, Camera};

/// Camera as seen from one part of the scene, with the values that the passes use. f32, except for values that are
/// computed once per image.
#[derive(Clone, Copy, Debug)]
pub(super) struct ObjectView {
    pub(super) width_px: u32,
    pub(super) height_px: u32,
    /// Rows of the rotation into the camera's axes.
    pub(super) rows: [Vec3; 3],
    /// Centre of the camera. [m, part]
    pub(super) center_m: Vec3,
    pub(super) near_m: f32,
    pub(super) fx_px: f32,
    pub(super) fy_px: f32,
    pub(super) cx_px: f32,
    pub(super) cy_px: f32,
    /// Minimum and maximum to which `x/z` is clamped for the linearisation.
    pub(super) slope_x: [f32; 2],
    /// Minimum and maximum to which `y/z` is clamped.
    pub(super) slope_y: [f32; 2],
    /// Background after light and fog.
    pub(super) background: [f32; 3],
    /// Light and fog; `None` if they change nothing.
    pub(super) atmosphere: Option<Atmosphere>,
    pub(super) model: Model,
    /// Maximum length of a slope; splats with longer slopes are dropped. Infinite without a lens.
    pub(super) reach: f32,
    planes: [Plane; 5],
    /// [`ShownSlopes::large`](super::lens::ShownSlopes::large).
    large: f32,
}

/// A splat at `p` may touch the image if `normal . (p - camera) + reach * weight >= offset`.
#[derive(Clone, Copy, Debug)]
struct Plane {
    normal: Vec3,
    offset: f32,
    weight: f32,
}

impl ObjectView {
    /// Prepares a validated camera with its lens, for a part relative to which it has the pose `part_from_cam`.
    pub(super) fn new<F: Frame>(
        camera: &Camera,
        lens: &Lens,
        part_from_cam: &Pose<F, Cam>,
    ) -> Self {
        let k = &camera.intrinsics;
        let rotation = DMat3::from_quat(part_from_cam.rotation.normalize()).transpose();
        let [x, y, z] = [rotation.row(0), rotation.row(1), rotation.row(2)];
        let (w, h) = (f64::from(k.width_px), f64::from(k.height_px));
        let bounds = |[low, high]: [DVec2; 2]| [[low.x, high.x], [low.y, high.y]];
        let [slope_x, slope_y] = bounds(lens.slopes);
        let plane = |normal: DVec3, weight: f64| {
            let length = normal.length();
            Plane {
                normal: (normal / length).as_vec3(),
                offset: 0.0,
                weight: (weight / length) as f32,
            }
        };
        let ahead = Plane { normal: z.as_vec3(), offset: camera.near_m, weight: 0.0 };
        let shown = &lens.shown;
        let planes = if lens.model == Model::Pinhole {
            // A splat's mean is at u = fx x/z + cx; its extent is at most
            //   sqrt(reach^2 fx^2 (1 + jx^2) / z^2 + 2 ln(255) 0.3),
            // with jx the clamped slope. Both sides times z > 0 are linear in the position: u +
            // extent >= 0 becomes fx x + (cx + blur) z + reach fx sqrt(1 + jx^2) >= 0, and so on.
            let blur = (2.0 * 255f64.ln() * BLUR_PX2).sqrt();
            let steep = |f: f64, [a, b]: [f64; 2]| f * (1.0 + (a * a).max(b * b)).sqrt();
            let (steep_x, steep_y) = (steep(k.fx_px, slope_x), steep(k.fy_px, slope_y));
            [
                ahead,
                plane(x * k.fx_px + z * (k.cx_px + blur), steep_x),
                plane(-x * k.fx_px + z * (w - k.cx_px + blur), steep_x),
                plane(y * k.fy_px + z * (k.cy_px + blur), steep_y),
                plane(-y * k.fy_px + z * (h - k.cy_px + blur), steep_y),
            ]
        } else {
            // Also linear in the position: x - low z + spread d >= 0. `sees` keeps large splats.
            let [shown_x, shown_y] = bounds([shown.low, shown.high]);
            [
                ahead,
                plane(x - z * shown_x[0], shown.spread),
                plane(z * shown_x[1] - x, shown.spread),
                plane(y - z * shown_y[0], shown.spread),
                plane(z * shown_y[1] - y, shown.spread),
            ]
        };
        Self {
            width_px: k.width_px,
            height_px: k.height_px,
            rows: [x.as_vec3(), y.as_vec3(), z.as_vec3()],
            center_m: part_from_cam.translation_m.as_vec3(),
            near_m: camera.near_m,
            fx_px: k.fx_px as f32,
            fy_px: k.fy_px as f32,
            cx_px: k.cx_px as f32,
            cy_px: k.cy_px as f32,
            slope_x: slope_x.map(|v| v as f32),
            slope_y: slope_y.map(|v| v as f32),
            background: camera.atmosphere.background(camera.background),
            atmosphere: Some(camera.atmosphere).filter(|atmosphere| !atmosphere.is_clear()),
            model: lens.model,
            // Widened by the rounding of f32, so that splats exactly at the reach are rendered.
            reach: (lens.reach * (1.0 + 1e-6)) as f32,
            planes,
            large: shown.large as f32,
        }
    }

    /// Whether a splat of the block may touch the image.
    pub(super) fn sees(&self, block: &Block) -> bool {
        let center = block.center_m - self.center_m;
        let beyond = |plane: &Plane| {
            let slack = plane.normal.abs().dot(block.half_m) + block.reach_m * plane.weight;
            // Rounding error of the sums, so that nothing is lost at the edge.
            let rounding = 1e-5 * (center.abs().max_element() + slack);
            // Not written as `>=`, so that an overflow to NaN keeps the block.
            plane.normal.dot(center) + slack + rounding < plane.offset
        };
        if beyond(&self.planes[0]) {
            return false;
        }
        let [z, half] = [self.rows[2].dot(center), self.rows[2].abs().dot(block.half_m)];
        self.large > 0.0 && !(z - half >= self.large * block.reach_m)
            || !self.planes[1..].iter().any(beyond)
    }
}

/// A block that may touch the image.
#[derive(Clone, Copy, Debug)]
pub(super) struct Visible {
    /// Part index.
    pub(super) part: u32,
    /// Block index within the part.
    pub(super) block: u32,
}

/// Appends the blocks of a part that may touch the image. Selects everywhere the coarsest level whose error is at
/// most `max_error_px`.
pub(super) fn cull(
    index: usize,
    part: &Part,
    view: &ObjectView,
    max_error_px: f32,
    visible: &mut Vec<Visible>,
) {
    let walk = Walk { index: index as u32, part, view, max_error_px };
    let coarsest = part.levels.len() - 1;
    let last = part.blocks.len() - part.levels[coarsest];
    for block in 0..last {
        walk.descend(coarsest, block, visible);
    }
}

/// Traversal of the tree of a part's levels.
struct Walk<'a> {
    index: u32,
    part: &'a Part,
    view: &'a ObjectView,
    max_error_px: f32,
}

impl Walk<'_> {
    /// Visits a block, given by its index within its level, and its children.
    fn descend(&self, level: usize, block: usize, visible: &mut Vec<Visible>) {
        let at = self.part.levels[level] + block;
        let bounds = &self.part.blocks[at];
        if !self.view.sees(bounds) {
            return;
        }
        if level == 0 || bounds.error_m * self.view.px_per_m(bounds) <= self.max_error_px {
            visible.push(Visible { part: self.index, block: at as u32 });
            return;
        }
        let finer = self.part.levels[level] - self.part.levels[level - 1];
        for child in block * BRANCH..((block + 1) * BRANCH).min(finer) {
            self.descend(level - 1, child, visible);
        }
    }
}

impl ObjectView {
    /// Returns the maximum number of pixels per metre within the block, at its point nearest to the camera.
    pub(super) fn px_per_m(&self, block: &Block) -> f32 {
        let forward = self.rows[2];
        let center = block.center_m - self.center_m;
        let nearest_m = forward.dot(center) - forward.abs().dot(block.half_m);
        self.fx_px.abs().max(self.fy_px.abs()) / nearest_m.max(self.near_m)
    }
}

#[cfg(test)]
mod tests;
