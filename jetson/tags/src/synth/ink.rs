//! Lays the ink of tags onto an image that shows white sheets where they are: the sheets' light, what stands before them and
//! the lens are the image's own, and only what is black is made so.

use vizflyt_protocol::geometry::{Cam, Pose, World};

use super::{Pattern, Placed, Renderer, SAMPLES, SyntheticExposure, paper_edge};
use crate::layout::TagLayout;

/// An image that shows the sheets.
#[derive(Debug)]
pub struct Sheets<'a> {
    /// Linear light, H x W x 3 of the lens's size.
    pub light: &'a mut [f32],
    /// Camera-z depth of what is seen, H x W; 0 where nothing is. [m, cam]
    pub depth_m: &'a [f32],
    /// Where it is seen from.
    pub world_from_cam: Pose<World, Cam>,
}

impl Renderer {
    /// Inks the tags of a layout in the room: light that leaves a sheet is multiplied by [`INK`] where it is black. A pixel
    /// whose depth is not the sheet's shows something else, which stays as it is. `blur_px` is one standard deviation of
    /// the image's own blur.
    ///
    /// # Panics
    /// If the image is of another size than the lens's, or the layout one on a vehicle.
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
        // White everywhere; each tag is drawn onto it, looked at, and wiped off.
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
                // The homography's third component is one over the depth of the tag's plane.
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

/// What a laser printer's black throws back, of what its paper does: 4 % of light to 85 %.
pub const INK: f32 = 0.05;
/// A pixel as far away as the sheet shows it: splats are some centimetres thick in depth at a grazing angle, and what stands
/// before a sheet is further from it.
const SAME_M: f64 = 0.04;
/// The same, of its distance.
const SAME_SHARE: f64 = 0.01;

#[cfg(test)]
mod tests;
