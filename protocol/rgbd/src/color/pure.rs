//! JPEG encoded in pure Rust: nothing but Rust and a C compiler to build.

use jpeg_encoder::{ColorType, SamplingFactor};

use crate::error::EncodeError;
use crate::header::ColorMode;

/// Encodes whole JPEGs.
#[derive(Debug, Default)]
pub(super) struct Encoder {}

impl Encoder {
    /// Appends a baseline JPEG to `out`. `rgb` is of this size (width, height).
    #[allow(clippy::unused_self)] // Why: the other library's encoder has state.
    pub(super) fn encode(
        &mut self,
        rgb: &[u8],
        size: (u16, u16),
        quality: u8,
        mode: ColorMode,
        out: &mut Vec<u8>,
    ) -> Result<(), EncodeError> {
        let mut encoder = jpeg_encoder::Encoder::new(out, quality);
        encoder.set_sampling_factor(match mode {
            ColorMode::Jpeg420 => SamplingFactor::R_4_2_0,
            ColorMode::Jpeg444 | ColorMode::Lossless => SamplingFactor::R_4_4_4,
        });
        encoder
            .encode(rgb, size.0, size.1, ColorType::Rgb)
            .map_err(|error| EncodeError::Jpeg(error.to_string()))
    }
}
