//! JPEG in pure Rust: nothing but Rust and a C compiler to build.

use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use super::jpeg::damaged;
use crate::error::DecodeError;

/// Decodes whole JPEGs.
#[derive(Debug, Default)]
pub(super) struct Decoder {}

impl Decoder {
    /// Decodes a baseline JPEG of exactly this size (width, height) into `rgb_out`.
    #[allow(clippy::unused_self)] // Why: the other library's decoder has state.
    pub(super) fn decode(
        &mut self,
        jpeg: &[u8],
        (width, height): (u32, u32),
        rgb_out: &mut [u8],
    ) -> Result<(), DecodeError> {
        let options = DecoderOptions::new_fast()
            .set_max_width(width as usize)
            .set_max_height(height as usize)
            .set_strict_mode(true)
            .jpeg_set_out_colorspace(ColorSpace::RGB);
        let mut decoder = JpegDecoder::new_with_options(ZCursor::new(jpeg), options);
        decoder.decode_headers().map_err(|error| damaged(&format!("{error:?}")))?;
        let info = decoder.info().ok_or_else(|| damaged("no image"))?;
        if (u32::from(info.width), u32::from(info.height)) != (width, height) {
            let (w, h) = (info.width, info.height);
            return Err(damaged(&format!("JPEG is {w}x{h}, the header has {width}x{height}")));
        }
        if decoder.output_buffer_size() != Some(rgb_out.len()) {
            return Err(damaged("JPEG does not decode to three bytes a pixel"));
        }
        decoder.decode_into(rgb_out).map_err(|error| damaged(&format!("{error:?}")))
    }
}
