//! A tag seen in an image.

use glam::DVec2;

use crate::family::TagFamily;

/// A tag seen in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Detection {
    /// Its family.
    pub family: TagFamily,
    /// Its number in the family.
    pub id: u32,
    /// Its corners in the order of [`crate::layout::CORNERS`]: lower left, lower right, upper right,
    /// upper left of the upright tag. Continuous pixels, (0, 0) the image's outer corner. [px]
    pub corners_px: [DVec2; 4],
    /// How many bits of its code were read wrong and put right.
    pub hamming: u32,
    /// How far apart black and white were, on average; small is doubtful. [grey levels of 255]
    pub margin: f64,
}
