//! Draws the ink of tags onto an image that already shows white sheets. Light, occlusion and lens effects come from the
//! image; only the black cells are darkened.

use vizflyt_protocol::geometry::{Cam, Pose, World};

use super::{Pattern, Placed, Renderer, SAMPLES, SyntheticExposure, paper_edge};
use crate::layout::TagLayout;

/// An image that shows the sheets.
#[derive(Debug)]
pub struct Sheets<'a> {
    /// Linear light, H x W x 3, in the size of the lens.
    pub light: &'a mut [f32],
    /// Camera-z depth, H x W; 0 for no surface. [m, cam]
    pub depth_m: &'a [f32],
    /// Pose of the camera.
    pub world_from_cam: Pose<World, Cam>,
}

impl Renderer {
    /// Draws the tags of a layout in the room: light from a black cell is multiplied by [`INK`]. A pixel whose depth
    /// differs from the sheet's shows another object and is not changed. `blur_px` is the standard deviation of the
    /// image's own blur.
    ///
    /// # Panics
    /// If the image does not have the size of the lens, or the layout is in the body frame.
    pub fn ink(&self, layout: &TagLayout, sheets: Sheets<'_>, blur_px: f64) {
        let Sheets { light, depth_m, world_from_cam } = sheets;
        assert_eq!(light.len(), 3 * self.intrinsics.pixels());
        assert_eq!(depth_m.len(), self.intrinsics.pixels());
        let placed = [Placed::fixed(layout)];
        let shot = SyntheticExposure::still(&placed, world_from_cam);
        let tags = Self::farthest_first(&shot);
        if tags.is_empty() {
            return;
        }
        let pattern = Pattern::new(SAMPLES, blur_px);
        // A white canvas: each tag is rendered onto it, read back, and erased.
        let mut white = vec![1f32; self.intrinsics.pixels()];
        let width = self.intrinsics.width_px;
        for (tag_from_slope, tag) in &tags {
            let Some(cells) = tag.family.cells(tag.id) else { continue };
            let Some([left, top, right, bottom]) =
                self.bounds(tag_from_slope, paper_edge(&cells), &pattern)
            else {
                continue;
            };
            self.render_tag(&mut white, &pattern, tag_from_slope, tag);
            for (x, y) in (top..bottom).flat_map(|y| (left..right).map(move |x| (x, y))) {
                let at = (y * width + x) as usize;
                let share = std::mem::replace(&mut white[at], 1.0);
                if share >= 1.0 {
                    continue;
                }
                let Some((slope, _)) = self.rays.at(x, y) else { continue };
                // The homography's third component is the inverse depth of the tag's plane.
                let near = (tag_from_slope[0] * slope.extend(1.0)).z;
                if !(near > 0.0) {
                    continue;
                }
                let seen_m = f64::from(depth_m[at]);
                let off_m = (seen_m - 1.0 / near).abs();
                if !(seen_m > 0.0 && off_m < SAME_M + SAME_SHARE / near) {
                    continue;
                }
                let factor = INK + (1.0 - INK) * share;
                for c in &mut light[3 * at..3 * at + 3] {
                    *c *= factor;
                }
            }
        }
    }
}

/// Reflectance of a laser printer's black relative to its paper: 4 % to 85 %.
pub const INK: f32 = 0.05;
/// Depth tolerance between pixel and sheet: at a grazing angle splats are some centimetres thick. Objects in front of a
/// sheet are further away from it. [m]
const SAME_M: f64 = 0.04;
/// Additional depth tolerance, as a share of the distance.
const SAME_SHARE: f64 = 0.01;

#[cfg(test)]
mod tests;
