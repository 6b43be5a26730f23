//! Conversion of a bitstream's colour to one JPEG file that any viewer opens, and back. Bytes are moved, not decoded.
//! Logs store images in this way, with each byte once.
//!
//! Each slice has a separate scan, and all scans share their tables. A scan has whole blocks and begins without
//! prediction, like a restart interval (ITU-T T.81, E.1.4). So scans joined by restart markers are the scan of the
//! whole image.

use super::jpeg::{END_OF_IMAGE, Layout};
use crate::error::DecodeError;
use crate::header::{
    ColorMode, HEADER_BYTES, SLICE_HEADER_BYTES, SliceHeader, peek, slice_len, split_slice,
};
use zerocopy::FromBytes;

/// Marker and length of the segment "define restart interval" (DRI, ITU-T T.81, B.2.4.4), without the interval.
const RESTART_INTERVAL: [u8; 4] = [0xff, 0xdd, 0, 4];
/// Length of this segment. [bytes]
const RESTART_INTERVAL_BYTES: usize = 6;
/// RST0, the first of eight markers.
const RESTART: u8 = 0xd0;

/// Splits a bitstream: appends its colour to `jpeg` as a complete JPEG, and all other bytes to `rest`. `pieces` are its
/// header and then its slices in order, as transmitted.
///
/// Returns `false` and leaves both unchanged if the colour is not a JPEG or has an unexpected layout. [`join_jpeg`] is
/// the inverse.
pub fn split_jpeg<'a>(
    pieces: impl IntoIterator<Item = &'a [u8]>,
    jpeg: &mut Vec<u8>,
    rest: &mut Vec<u8>,
) -> bool {
    let before = (jpeg.len(), rest.len());
    let is_split = try_split(pieces, jpeg, rest).is_some();
    if !is_split {
        jpeg.truncate(before.0);
        rest.truncate(before.1);
    }
    is_split
}

fn try_split<'a>(
    pieces: impl IntoIterator<Item = &'a [u8]>,
    jpeg: &mut Vec<u8>,
    rest: &mut Vec<u8>,
) -> Option<()> {
    let mut pieces = pieces.into_iter();
    let head = pieces.next()?;
    let info = peek(head).ok()?;
    if !matches!(info.color, Some(ColorMode::Jpeg444 | ColorMode::Jpeg420))
        || head.len() != info.header_len
    {
        return None;
    }
    let tables = &head[HEADER_BYTES..];
    let layout = Layout::of(tables).filter(|layout| layout.scan == tables.len())?;
    let start = jpeg.len();
    jpeg.extend_from_slice(&tables[..layout.scan_header]);
    // Sides are at most 8192, so they fit.
    jpeg[start + layout.rows..][..2].copy_from_slice(&(info.height as u16).to_be_bytes());
    if info.slices > 1 {
        let rows = info.slice_rows(0);
        let blocks = info.width.div_ceil(layout.block.0) * (rows.end / layout.block.1);
        let interval = u16::try_from(blocks).ok()?;
        jpeg.extend_from_slice(&RESTART_INTERVAL);
        jpeg.extend_from_slice(&interval.to_be_bytes());
    }
    jpeg.extend_from_slice(&tables[layout.scan_header..]);
    rest.extend_from_slice(head);
    for index in 0..info.slices {
        let slice = pieces.next()?;
        let parts = split_slice(slice).ok()?;
        let scan = parts.color.strip_suffix(&END_OF_IMAGE)?;
        if parts.index != u16::from(index) {
            return None;
        }
        if index > 0 {
            jpeg.extend_from_slice(&[0xff, RESTART + (index - 1) % 8]);
        }
        jpeg.extend_from_slice(scan);
        rest.extend_from_slice(&slice[..SLICE_HEADER_BYTES]);
        rest.extend_from_slice(&slice[SLICE_HEADER_BYTES + parts.color.len()..]);
    }
    jpeg.extend_from_slice(&END_OF_IMAGE);
    pieces.next().is_none().then_some(())
}

/// Appends the bitstream that [`split_jpeg`] has split to `out`.
///
/// # Errors
/// [`DecodeError::Short`] if the two parts do not match, and the errors of [`peek`].
pub fn join_jpeg(jpeg: &[u8], rest: &[u8], out: &mut Vec<u8>) -> Result<(), DecodeError> {
    let info = peek(rest)?;
    let short = || DecodeError::Short(jpeg.len() + rest.len());
    let (head, mut rest) = rest.split_at_checked(info.header_len).ok_or_else(short)?;
    let dri = if info.slices > 1 { RESTART_INTERVAL_BYTES } else { 0 };
    let mut scans = jpeg.get(info.header_len - HEADER_BYTES + dri..).ok_or_else(short)?;
    out.extend_from_slice(head);
    for _ in 0..info.slices {
        let (header, _) = SliceHeader::read_from_prefix(rest).map_err(|_| short())?;
        let color_len = header.color_len.get() as usize;
        let len = slice_len(rest).ok_or_else(short)?;
        let others = usize::try_from(len).map_err(|_| short())?.checked_sub(color_len);
        let (slice, after) = rest.split_at_checked(others.ok_or_else(short)?).ok_or_else(short)?;
        let scan_len = color_len.checked_sub(END_OF_IMAGE.len()).ok_or_else(short)?;
        // A restart marker, or the end of the image, has the same length as the end marker that it replaces.
        let (scan, next) = scans.split_at_checked(color_len).ok_or_else(short)?;
        out.extend_from_slice(&slice[..SLICE_HEADER_BYTES]);
        out.extend_from_slice(&scan[..scan_len]);
        out.extend_from_slice(&END_OF_IMAGE);
        out.extend_from_slice(&slice[SLICE_HEADER_BYTES..]);
        (rest, scans) = (after, next);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Decoder, EncodeOptions, Encoder, RgbdView};
    use proptest::prelude::*;

    /// Returns a bitstream of a picture with smooth parts and edges, and its pieces.
    fn bitstream(width: u32, height: u32, color: ColorMode, slices: u8) -> (Vec<u8>, Vec<Vec<u8>>) {
        let pixels = (width * height) as usize;
        let rgb: Vec<u8> = (0..3 * pixels)
            .map(|n| {
                ((n / 3 % width as usize) * 3 + (n / 3 / width as usize) * 2 + n % 3 * 40) as u8
            })
            .collect();
        let depth_mm: Vec<u16> = (0..pixels).map(|n| 1000 + (n % 700) as u16).collect();
        let view = RgbdView { width, height, rgb: &rgb, depth_mm: &depth_mm };
        let mut all = Vec::new();
        let options = EncodeOptions { color_mode: color, slices, ..EncodeOptions::default() };
        Encoder::new(options).encode(&view, &mut all).unwrap();
        let (head, mut rest) = all.split_at(peek(&all).unwrap().header_len);
        let mut pieces = vec![head.to_vec()];
        while !rest.is_empty() {
            let (slice, after) = rest.split_at(slice_len(rest).unwrap() as usize);
            pieces.push(slice.to_vec());
            rest = after;
        }
        (all, pieces)
    }

    fn split(pieces: &[Vec<u8>]) -> Option<(Vec<u8>, Vec<u8>)> {
        let (mut jpeg, mut rest) = (vec![1, 2, 3], Vec::new());
        let is_split = split_jpeg(pieces.iter().map(Vec::as_slice), &mut jpeg, &mut rest);
        assert!(is_split || (jpeg.len(), rest.len()) == (3, 0), "both are unchanged");
        is_split.then(|| (jpeg.split_off(3), rest))
    }

    fn check(width: u32, height: u32, color: ColorMode, slices: u8) {
        let (all, pieces) = bitstream(width, height, color, slices);
        let (jpeg, rest) = split(&pieces).expect("it is a JPEG");
        // An independent decoder of whole files returns the same pixels.
        let mut decoder = zune_jpeg::JpegDecoder::new(std::io::Cursor::new(&jpeg));
        let file = decoder.decode().unwrap();
        let info = decoder.info().unwrap();
        assert_eq!((u32::from(info.width), u32::from(info.height)), (width, height));
        let mut rgb = vec![0; file.len()];
        let mut depth_mm = vec![0; (width * height) as usize];
        Decoder::default().decode(&all, &mut rgb, &mut depth_mm).unwrap();
        // Halved chroma is smoothed over neighbouring rows: there, slices differ from the whole image.
        let most = if color == ColorMode::Jpeg444 { 2 } else { 90 };
        let off = file.iter().zip(&rgb).map(|(&a, &b)| a.abs_diff(b)).max().unwrap();
        assert!(off <= most, "{width}x{height} {color:?} {slices}: off by {off}");
        let mut joined = Vec::new();
        join_jpeg(&jpeg, &rest, &mut joined).unwrap();
        assert_eq!(joined, all, "every byte comes back");
        assert!(jpeg.len() + rest.len() < all.len() + tables_len(&all) + 16, "each byte once");
    }

    fn tables_len(all: &[u8]) -> usize {
        peek(all).unwrap().header_len - HEADER_BYTES
    }

    #[test]
    fn splits_colour_as_one_jpeg_and_joins_it_again() {
        check(64, 48, ColorMode::Jpeg444, 1);
        check(64, 48, ColorMode::Jpeg444, 3);
        check(61, 43, ColorMode::Jpeg444, 2);
        check(320, 240, ColorMode::Jpeg444, 4);
        check(320, 240, ColorMode::Jpeg420, 4);
        check(33, 330, ColorMode::Jpeg420, 11);
    }

    #[test]
    fn does_not_split_colour_that_is_not_a_jpeg() {
        let (_, pieces) = bitstream(64, 48, ColorMode::Lossless, 3);
        assert_eq!(split(&pieces), None);
        let (_, mut pieces) = bitstream(64, 48, ColorMode::Jpeg444, 3);
        assert_eq!(split(&pieces[..3]), None, "a slice is missing");
        pieces.swap(1, 2);
        assert_eq!(split(&pieces), None, "slices out of order");
        assert_eq!(split(&[]), None);
    }

    proptest! {
        #[test]
        fn join_does_not_panic_on_parts_that_do_not_match(
            cut in any::<prop::sample::Index>(), byte in any::<(prop::sample::Index, u8)>()
        ) {
            let (_, pieces) = bitstream(40, 64, ColorMode::Jpeg444, 4);
            let (jpeg, mut rest) = split(&pieces).unwrap();
            let mut out = Vec::new();
            let _ = join_jpeg(&jpeg[..cut.index(jpeg.len())], &rest, &mut out);
            let _ = join_jpeg(&jpeg, &rest[..cut.index(rest.len())], &mut out);
            let at = byte.0.index(rest.len());
            rest[at] = byte.1;
            let _ = join_jpeg(&jpeg, &rest, &mut out);
        }
    }
}
