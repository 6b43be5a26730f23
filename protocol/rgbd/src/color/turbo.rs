//! JPEG by libjpeg-turbo: a third of the time.

use core::fmt;

use turbojpeg::{Compressor, Decompressor, Image, PixelFormat, Subsamp};

use super::jpeg::damaged;
use crate::error::{DecodeError, EncodeError};
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

/// Decodes whole JPEGs; made at the first.
#[derive(Default)]
pub(super) struct Decoder(Option<Decompressor>);

impl fmt::Debug for Decoder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Decoder(libjpeg-turbo)")
    }
}

impl Decoder {
    /// Decodes a baseline JPEG of exactly this size (width, height) into `rgb_out`.
    pub(super) fn decode(
        &mut self,
        jpeg: &[u8],
        (width, height): (u32, u32),
        rgb_out: &mut [u8],
    ) -> Result<(), DecodeError> {
        let failed = |error: turbojpeg::Error| damaged(&error.to_string());
        let decompressor = match &mut self.0 {
            Some(decompressor) => decompressor,
            none => none.insert(Decompressor::new().map_err(failed)?),
        };
        let header = decompressor.read_header(jpeg).map_err(failed)?;
        let (width, height) = (width as usize, height as usize);
        if (header.width, header.height) != (width, height) {
            let (w, h) = (header.width, header.height);
            return Err(damaged(&format!("JPEG is {w}x{h}, the header has {width}x{height}")));
        }
        let image =
            Image { pixels: rgb_out, width, pitch: 3 * width, height, format: PixelFormat::RGB };
        decompressor.decompress(jpeg, image).map_err(failed)
    }
}
