//! Encoding of layers as PNG and JPEG in memory. The same pixels give the same bytes.
//!
//! Encoding takes most of an image's time after rendering, so it uses fast deflate and one filter per layer.

use png::{BitDepth, ColorType, DeflateCompression, Encoder, Filter};

/// Error of an encoder.
#[derive(Debug, thiserror::Error)]
pub enum EncodeError {
    #[error("cannot encode a PNG")]
    Png(#[from] png::EncodingError),
    #[error("cannot encode a JPEG")]
    Jpeg(#[from] vizflyt_rgbd::EncodeError),
}

/// Encodes RGB with 8 bits per channel.
///
/// # Errors
/// [`EncodeError`].
pub fn rgb8(rgb: &[u8], size: [u32; 2]) -> Result<Vec<u8>, EncodeError> {
    png(rgb, size, (ColorType::Rgb, BitDepth::Eight), Filter::Paeth)
}

/// Encodes one channel of 8 bits, with a filter for long runs.
///
/// # Errors
/// [`EncodeError`].
pub fn grey8(grey: &[u8], size: [u32; 2]) -> Result<Vec<u8>, EncodeError> {
    png(grey, size, (ColorType::Grayscale, BitDepth::Eight), Filter::Up)
}

/// Encodes one channel of 16 bits.
///
/// # Errors
/// [`EncodeError`].
pub fn grey16(grey: &[u16], size: [u32; 2]) -> Result<Vec<u8>, EncodeError> {
    png(&bytes(grey), size, (ColorType::Grayscale, BitDepth::Sixteen), Filter::Up)
}

/// Encodes three channels of 16 bits.
///
/// # Errors
/// [`EncodeError`].
pub fn rgb16(rgb: &[u16], size: [u32; 2]) -> Result<Vec<u8>, EncodeError> {
    png(&bytes(rgb), size, (ColorType::Rgb, BitDepth::Sixteen), Filter::Up)
}

/// Encodes RGB as JPEG of a quality from 1 to 100, colour at full resolution.
///
/// # Errors
/// [`EncodeError`].
pub fn jpeg(rgb: &[u8], [width, height]: [u32; 2], quality: u8) -> Result<Vec<u8>, EncodeError> {
    let mut out = Vec::new();
    vizflyt_rgbd::encode_jpeg(rgb, width, height, quality, &mut out)?;
    Ok(out)
}

fn png(
    bytes: &[u8],
    [width, height]: [u32; 2],
    (color, depth): (ColorType, BitDepth),
    filter: Filter,
) -> Result<Vec<u8>, EncodeError> {
    let mut out = Vec::with_capacity(bytes.len() / 4);
    let mut encoder = Encoder::new(&mut out, width, height);
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder.set_deflate_compression(DeflateCompression::FdeflateUltraFast);
    encoder.set_filter(filter);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(bytes)?;
    writer.finish()?;
    Ok(out)
}

/// Converts samples to the big-endian order of PNG.
fn bytes(samples: &[u16]) -> Vec<u8> {
    let mut bytes = vec![0; 2 * samples.len()];
    for (pair, sample) in bytes.chunks_exact_mut(2).zip(samples) {
        pair.copy_from_slice(&sample.to_be_bytes());
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn encoding_is_lossless() {
        let samples: Vec<u16> = (0..3 * 35).map(|n| n * 613).collect();
        let flow = image::load_from_memory(&rgb16(&samples, [7, 5]).unwrap()).unwrap();
        assert_eq!(flow.as_rgb16().unwrap().as_raw(), &samples);
        let grey: Vec<u8> = (0..35).collect();
        let classes = image::load_from_memory(&grey8(&grey, [7, 5]).unwrap()).unwrap();
        assert_eq!(classes.as_luma8().unwrap().as_raw(), &grey);
        let depth = image::load_from_memory(&grey16(&samples[..35], [7, 5]).unwrap()).unwrap();
        assert_eq!(depth.as_luma16().unwrap().as_raw(), &samples[..35]);
        let rgb: Vec<u8> = (0..105).collect();
        let colour = image::load_from_memory(&rgb8(&rgb, [7, 5]).unwrap()).unwrap();
        assert_eq!(colour.as_rgb8().unwrap().as_raw(), &rgb);
        assert_eq!(jpeg(&rgb, [7, 5], 90).unwrap()[..2], [0xff, 0xd8]);
    }
}
