//! Constants of the classic forward pass. A scene looks right only with the values of the trainers.

/// Added to both variances on the image plane: the pixel's own width. (Low-pass filter of the rasterizer of Kerbl et
/// al. 2023.) [px^2]
pub const BLUR_PX2: f64 = 0.3;
/// Maximum alpha of one splat at a pixel.
pub const ALPHA_MAX: f64 = 0.99;
/// Minimum alpha: smaller values do not change 8-bit colour and are skipped.
pub const ALPHA_MIN: f64 = 1.0 / 255.0;
/// A pixel ends before the splat that would reduce its transmittance to this value.
pub const TRANSMITTANCE_MIN: f64 = 1e-4;
/// Splats are linearised within the image, widened on each side by this share of its half size.
pub const JACOBIAN_MARGIN: f64 = 0.3;
/// Maximum scale; larger splats are rendered at this size. A splat of 1000 km already covers every pixel evenly, and
/// its squares are far below the limits of f32. [m]
pub const MAX_SCALE_M: f32 = 1e6;
