//! JPEG encoded by libjpeg-turbo: a third of the time.

use core::fmt;

use turbojpeg::{Compressor, Image, PixelFormat, Subsamp};

use crate::error::EncodeError;
use crate::header::ColorMode;

/// Encodes whole JPEGs; made at the first.
#[derive(Default)]
pub(super) struct Encoder(Option<Compressor>);

impl fmt::Debug for Encoder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Encoder(libjpeg-turbo)")
    }
}

impl Encoder {
    /// Appends a baseline JPEG to `out`. `rgb` is of this size (width, height).
    pub(super) fn encode(
        &mut self,
        rgb: &[u8],
        (width, height): (u16, u16),
        quality: u8,
        mode: ColorMode,
        out: &mut Vec<u8>,
    ) -> Result<(), EncodeError> {
        let failed = |error: turbojpeg::Error| EncodeError::Jpeg(error.to_string());
        let compressor = match &mut self.0 {
            Some(compressor) => compressor,
            none => none.insert(Compressor::new().map_err(failed)?),
        };
        compressor.set_quality(i32::from(quality)).map_err(failed)?;
        let subsamp = match mode {
            ColorMode::Jpeg420 => Subsamp::Sub2x2,
            ColorMode::Jpeg444 | ColorMode::Lossless => Subsamp::None,
        };
        compressor.set_subsamp(subsamp).map_err(failed)?;
        let (width, height) = (usize::from(width), usize::from(height));
        let image =
            Image { pixels: rgb, width, pitch: 3 * width, height, format: PixelFormat::RGB };
        let start = out.len();
        out.resize(start + compressor.buf_len(width, height).map_err(failed)?, 0);
        let len = compressor.compress_to_slice(image, &mut out[start..]).map_err(failed)?;
        out.truncate(start + len);
        Ok(())
    }
}
