//! Lossless WebP images with arbitrary data instead of colours.

use std::io::Cursor;

use image_webp::{ColorType, WebPDecoder, WebPEncoder};

use super::invalid;
use crate::format::{Format, FormatError, limit};

/// A decoded texture.
pub(super) struct Texture {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Bytes per pixel, 3 or 4.
    pub(super) channels: usize,
    bytes: Vec<u8>,
}

impl Texture {
    /// Decodes a texture of at most `most_pixels`.
    pub(super) fn decode(name: &str, webp: &[u8], most_pixels: u64) -> Result<Self, FormatError> {
        let damaged =
            |error: image_webp::DecodingError| invalid(name, format!("not a WebP image: {error}"));
        let mut decoder = WebPDecoder::new(Cursor::new(webp)).map_err(damaged)?;
        let (width, height) = decoder.dimensions();
        let pixels = u64::from(width) * u64::from(height);
        limit::at_most(Format::Sog, "the number of pixels of a texture", pixels, most_pixels)?;
        if decoder.is_animated() || decoder.is_lossy() {
            return Err(FormatError::Unsupported {
                format: Format::Sog,
                what: format!("lossy or animated WebP ({name})"),
                advice: "its bytes differ from those of the scene; convert the scene again",
            });
        }
        let channels = if decoder.has_alpha() { 4 } else { 3 };
        let mut bytes = vec![0; pixels as usize * channels];
        decoder.read_image(&mut bytes).map_err(damaged)?;
        Ok(Self { width: width as usize, height: height as usize, channels, bytes })
    }

    /// Returns the number of pixels.
    pub(super) fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// Returns red, green and blue of pixel `pixel`, counted row by row.
    #[inline]
    pub(super) fn rgb(&self, pixel: usize) -> [u8; 3] {
        let at = pixel * self.channels;
        [self.bytes[at], self.bytes[at + 1], self.bytes[at + 2]]
    }

    /// Returns the bytes of consecutive pixels.
    #[inline]
    pub(super) fn run(&self, first: usize, pixels: usize) -> &[u8] {
        &self.bytes[first * self.channels..(first + pixels) * self.channels]
    }

    /// Returns alpha of a pixel; 255 if the texture has no alpha.
    #[inline]
    pub(super) fn alpha(&self, pixel: usize) -> u8 {
        if self.channels == 4 { self.bytes[pixel * 4 + 3] } else { 255 }
    }
}

/// Encodes pixels of `N` bytes, 3 or 4, as WebP.
pub(super) fn encode<const N: usize>(
    name: &str,
    pixels: &[[u8; N]],
    width: usize,
) -> Result<Vec<u8>, FormatError> {
    let colour = if N == 4 { ColorType::Rgba8 } else { ColorType::Rgb8 };
    let mut webp = Vec::new();
    WebPEncoder::new(&mut webp)
        .encode(pixels.as_flattened(), width as u32, (pixels.len() / width) as u32, colour)
        .map_err(|error| invalid(name, format!("cannot be written as WebP: {error}")))?;
    Ok(webp)
}
