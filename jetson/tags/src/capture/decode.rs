//! Image files: PNG, JPEG, PGM.

use std::io::Cursor;

use image::ImageDecoder as _;
use vizflyt_protocol::geometry::Intrinsics;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use crate::image::Gray;

/// Decodes a PNG, JPEG or PGM file to grey. The format is detected.
///
/// # Errors
/// A message about the problem.
///
/// ```
/// use vizflyt_tags::capture::decode;
/// let image = decode(b"P5 2 1 255\n\x00\xff").unwrap();
/// assert_eq!((image.width_px(), image.height_px(), image.pixels()), (2, 1, &[0, 255][..]));
/// assert!(decode(b"GIF89a").unwrap_err().contains("neither PNG"));
/// ```
pub fn decode(bytes: &[u8]) -> Result<Gray, String> {
    if bytes.starts_with(b"\x89PNG") {
        return png(bytes);
    }
    if bytes.starts_with(b"\xff\xd8") {
        return jpeg(bytes);
    }
    if bytes.starts_with(b"P5") {
        return pgm(bytes).ok_or_else(|| "damaged or not of 8 bits".into());
    }
    Err("neither PNG, JPEG nor PGM; convert it to one of them".into())
}

fn png(bytes: &[u8]) -> Result<Gray, String> {
    let decoder = image::codecs::png::PngDecoder::new(Cursor::new(bytes))
        .map_err(|error| error.to_string())?;
    let (width, height) = decoder.dimensions();
    check(width, height)?;
    if decoder.total_bytes() > MAX_DECODED {
        return Err(format!("{width}x{height} in this depth of colour is too large"));
    }
    let image = image::DynamicImage::from_decoder(decoder).map_err(|error| error.to_string())?;
    let pixels = image.into_luma8().into_raw();
    Gray::new(width, height, pixels).ok_or_else(|| "damaged".into())
}

/// Decodes the brightness of a JPEG, without its colours.
pub(super) fn jpeg(bytes: &[u8]) -> Result<Gray, String> {
    let side = Intrinsics::MAX_SIDE_PX as usize;
    let options = DecoderOptions::new_fast()
        .set_max_width(side)
        .set_max_height(side)
        .jpeg_set_out_colorspace(ColorSpace::Luma);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    let pixels = decoder.decode().map_err(|error| format!("{error:?}"))?;
    let info = decoder.info().ok_or("no image")?;
    Gray::new(info.width.into(), info.height.into(), pixels).ok_or_else(|| "damaged".into())
}

/// Decodes an 8-bit PGM (netpbm's pgm(5)).
fn pgm(bytes: &[u8]) -> Option<Gray> {
    let mut rest = bytes.strip_prefix(b"P5")?;
    let mut numbers = [0u32; 3];
    for number in &mut numbers {
        // At least one byte of white space or comments, which end with the line.
        let mut spaces = 0;
        loop {
            match rest.first()? {
                b'#' => {
                    let end = rest.iter().position(|&b| b == b'\n')?;
                    rest = &rest[end..];
                }
                byte if byte.is_ascii_whitespace() => {
                    rest = &rest[1..];
                    spaces += 1;
                }
                _ => break,
            }
        }
        let digits = rest.iter().take_while(|b| b.is_ascii_digit()).count();
        if spaces == 0 || digits == 0 {
            return None;
        }
        *number = std::str::from_utf8(&rest[..digits]).ok()?.parse().ok()?;
        rest = &rest[digits..];
    }
    let [width, height, most] = numbers;
    check(width, height).ok()?;
    if most != 255 || !rest.first()?.is_ascii_whitespace() {
        return None;
    }
    let count = width as usize * height as usize;
    Gray::new(width, height, rest[1..].get(..count)?.to_vec())
}

pub(super) fn check(width: u32, height: u32) -> Result<(), String> {
    let sides = 1..=Intrinsics::MAX_SIDE_PX;
    if sides.contains(&width) && sides.contains(&height) {
        return Ok(());
    }
    Err(format!("{width}x{height} is outside 1x1 to {0}x{0}", Intrinsics::MAX_SIDE_PX))
}

/// Maximum decoded size: an 8K image in three colours. A small file can claim far more. [bytes]
const MAX_DECODED: u64 = 128 << 20;
