//! Conversion between trained parameters (logarithms, logits, harmonics) and rendered values.

use glam::Vec3;

use crate::harmonics::C0;

/// Logits beyond which the sigmoid is exactly 1 and exactly 0 in f32. They are finite, because many
/// readers reject infinities.
const OPAQUE_LOGIT: f32 = 18.0;
const TRANSPARENT_LOGIT: f32 = -104.0;
/// Log scale with an exponential of exactly 0 in f32.
const ZERO_LOG_SCALE: f32 = -104.0;

/// Returns `e^x` of each component.
#[inline]
pub(super) fn exp(log: Vec3) -> Vec3 {
    Vec3::new(log.x.exp(), log.y.exp(), log.z.exp())
}

/// Returns the opacity of a logit.
#[inline]
pub(super) fn sigmoid(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

/// Returns the inverse of [`sigmoid`], finite for 0 and 1.
pub(super) fn logit(opacity: f32) -> f32 {
    // In f64, because 1 - opacity loses all digits in f32 if the opacity is near 1.
    let opacity = f64::from(opacity);
    ((opacity / (1.0 - opacity)).ln() as f32).clamp(TRANSPARENT_LOGIT, OPAQUE_LOGIT)
}

/// Returns the natural logarithm of a scale, finite for 0.
pub(super) fn log_scale(scale_m: f32) -> f32 {
    scale_m.ln().max(ZERO_LOG_SCALE)
}

/// Returns the constant harmonic of a colour of 0 to 1.
#[inline]
pub(super) fn harmonic_of_colour(colour: f32) -> f32 {
    (colour - 0.5) * (1.0 / C0) as f32
}

/// Returns the colour of a constant harmonic. It can exceed 0 to 1.
pub(super) fn colour_of_harmonic(harmonic: f32) -> f32 {
    harmonic * C0 as f32 + 0.5
}
