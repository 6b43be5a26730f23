//! What a renderer writes.

/// Colour, depth and alpha of one camera; row-major, reused from image to image.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RgbdImage {
    /// Width. [px]
    pub width_px: u32,
    /// Height. [px]
    pub height_px: u32,
    /// H x W x 3, on the background, unclamped.
    pub rgb: Vec<f32>,
    /// H x W accumulated opacity, 0 to 1.
    pub alpha: Vec<f32>,
    /// H x W expected camera-z depth `sum(w z) / sum(w)`; 0 where nothing contributes. [m, cam]
    pub depth_expected_m: Vec<f32>,
    /// H x W median camera-z depth: z of the splat at which transmittance falls to one half; 0
    /// where it never does. [m, cam]
    pub depth_median_m: Vec<f32>,
}
