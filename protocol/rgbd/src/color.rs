//! Colour: baseline JPEG, 4:4:4. `docs/BENCHMARKS.md` has the comparison that chose it.

use jpeg_encoder::{ColorType, SamplingFactor};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use crate::codec::{DecodeError, EncodeError};
use crate::header::MAX_SIDE;

/// Appends a baseline JPEG, 4:4:4, to `out`. `rgb` is row-major, three bytes a pixel; quality is
/// 1 to 100.
///
/// # Errors
/// [`EncodeError::Size`], [`EncodeError::Rgb`] or [`EncodeError::Quality`] for arguments out of
/// range; [`EncodeError::Jpeg`] if the JPEG library declines.
pub fn encode_jpeg(
    rgb: &[u8],
    width: u32,
    height: u32,
    quality: u8,
    out: &mut Vec<u8>,
) -> Result<(), EncodeError> {
    let side = 1..=MAX_SIDE;
    if !side.contains(&width) || !side.contains(&height) {
        return Err(EncodeError::Size(width, height));
    }
    let expected = width as usize * height as usize * 3;
    if rgb.len() != expected {
        return Err(EncodeError::Rgb { found: rgb.len(), expected, width, height });
    }
    if !(1..=100).contains(&quality) {
        return Err(EncodeError::Quality(quality));
    }
    let mut encoder = jpeg_encoder::Encoder::new(out, quality);
    encoder.set_sampling_factor(SamplingFactor::R_4_4_4);
    // Sides are at most 8192, so they fit.
    encoder
        .encode(rgb, width as u16, height as u16, ColorType::Rgb)
        .map_err(|error| EncodeError::Jpeg(error.to_string()))
}

/// Decodes a baseline JPEG of exactly this size into `rgb_out`, H x W x 3.
pub(crate) fn decode_jpeg(
    jpeg: &[u8],
    width: u32,
    height: u32,
    rgb_out: &mut [u8],
) -> Result<(), DecodeError> {
    let failed = |reason: String| DecodeError::Color(reason);
    // The library fills what a cut image lacks with grey; the end marker tells the cut.
    if !(jpeg.starts_with(&START_OF_IMAGE) && jpeg.ends_with(&END_OF_IMAGE)) {
        return Err(failed("JPEG lacks its first or last marker".into()));
    }
    let options = DecoderOptions::new_fast()
        .set_max_width(width as usize)
        .set_max_height(height as usize)
        .set_strict_mode(true)
        .jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(jpeg), options);
    decoder.decode_headers().map_err(|error| failed(format!("{error:?}")))?;
    let info = decoder.info().ok_or_else(|| failed("no image".into()))?;
    if (u32::from(info.width), u32::from(info.height)) != (width, height) {
        let (w, h) = (info.width, info.height);
        return Err(failed(format!("JPEG is {w}x{h}, the header says {width}x{height}")));
    }
    // Progressive scans can make a small file cost any amount of time; our encoder writes none.
    if !info.sof.is_sequential_dct() {
        return Err(failed("only baseline JPEG is allowed".into()));
    }
    if decoder.output_buffer_size() != Some(rgb_out.len()) {
        return Err(failed("JPEG does not decode to three bytes a pixel".into()));
    }
    decoder.decode_into(rgb_out).map_err(|error| failed(format!("{error:?}")))
}

/// ITU-T T.81, table B.1: SOI.
const START_OF_IMAGE: [u8; 2] = [0xff, 0xd8];
/// ITU-T T.81, table B.1: EOI.
const END_OF_IMAGE: [u8; 2] = [0xff, 0xd9];
