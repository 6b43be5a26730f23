//! JPEG by libjpeg-turbo: a third of the time.

use core::fmt;

use turbojpeg::{Decompressor, Image, PixelFormat};

use super::jpeg::damaged;
use crate::error::DecodeError;

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
