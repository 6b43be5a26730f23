//! A tag detected in an image.

use glam::DVec2;

use crate::family::TagFamily;

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Detection {
    pub family: TagFamily,
    /// Number in the family.
    pub id: u32,
    /// Corners in the order of [`crate::layout::CORNERS`]: lower left, lower right, upper right, upper left of the
    /// upright tag. Continuous pixels; (0, 0) is the image's outer corner. [px]
    pub corners_px: [DVec2; 4],
    /// Number of code bits that were misread and corrected.
    pub hamming: u32,
    /// Mean contrast between black and white cells; a small value means an unreliable detection. [grey levels of 255]
    pub margin: f64,
}
