//! Constants of the classic forward pass, as the trainers use them: a scene looks right only with
//! the values it was trained with.

/// Added to both variances on the image plane: the pixel's own width. (Kerbl et al. 2023, their
/// rasterizer's low-pass filter.) [px^2]
pub const BLUR_PX2: f64 = 0.3;
/// No single splat hides more than this.
pub const ALPHA_MAX: f64 = 0.99;
/// What 8 bits cannot show is skipped.
pub const ALPHA_MIN: f64 = 1.0 / 255.0;
/// A pixel ends before the splat that would bring it here.
pub const TRANSMITTANCE_MIN: f64 = 1e-4;
/// The projection is linearised within the image widened by this share of its half size.
pub const JACOBIAN_MARGIN: f64 = 0.3;
/// Splats larger than this are rendered as if they had this size; a 1000 km splat already covers every
/// pixel evenly, and its squares stay far from f32's limits. [m]
pub const MAX_SCALE_M: f32 = 1e6;
