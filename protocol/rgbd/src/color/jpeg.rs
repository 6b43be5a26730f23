//! JPEGs whole, and JPEGs cut into tables and scans.

use super::library;
use crate::error::{DecodeError, EncodeError};
use crate::header::{ColorMode, MAX_SIDE};

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
    // Sides are at most 8192, so they fit.
    let size = (width as u16, height as u16);
    library::Encoder::default().encode(rgb, size, quality, ColorMode::Jpeg444, out)
}

/// Encodes slices; owns the scratch memory.
#[derive(Debug, Default)]
pub(crate) struct JpegSliceEncoder {
    library: library::Encoder,
    /// What `tables` are of.
    made_for: Option<(u16, u8, ColorMode)>,
    /// All up to the scan, for 0 rows.
    tables: Vec<u8>,
    jpeg: Vec<u8>,
}

impl JpegSliceEncoder {
    /// Returns the tables of images so wide, of this quality and mode, to be stored once.
    pub(crate) fn tables(
        &mut self,
        width: u16,
        quality: u8,
        mode: ColorMode,
    ) -> Result<&[u8], EncodeError> {
        if self.made_for != Some((width, quality, mode)) {
            self.made_for = None;
            // They do not depend on the pixels, so the least image serves.
            let row = vec![0; 3 * usize::from(width)];
            self.compress(&row, (width, 1), quality, mode)?;
            self.made_for = Some((width, quality, mode));
        }
        Ok(&self.tables)
    }

    /// Appends the scan of some rows to `out`, to be decoded with [`Self::tables`].
    pub(crate) fn scan(
        &mut self,
        rgb: &[u8],
        rows: u16,
        out: &mut Vec<u8>,
    ) -> Result<(), EncodeError> {
        let Some((width, quality, mode)) = self.made_for else {
            return Err(EncodeError::Jpeg("no tables were made".into()));
        };
        let before = self.tables.len();
        let scan = self.compress(rgb, (width, rows), quality, mode)?;
        debug_assert_eq!(self.tables.len(), before, "tables depend on pixels");
        out.extend_from_slice(&self.jpeg[scan..]);
        Ok(())
    }

    /// Leaves a JPEG, returns where its scan begins, and leaves its tables apart.
    fn compress(
        &mut self,
        rgb: &[u8],
        size: (u16, u16),
        quality: u8,
        mode: ColorMode,
    ) -> Result<usize, EncodeError> {
        self.jpeg.clear();
        self.library.encode(rgb, size, quality, mode, &mut self.jpeg)?;
        let layout = Layout::of(&self.jpeg)
            .ok_or_else(|| EncodeError::Jpeg("the library writes no baseline JPEG".into()))?;
        let tables = &self.jpeg[..layout.scan];
        let (rows, after) = (layout.rows..layout.rows + 2, layout.rows + 2);
        let same = self.made_for.is_none_or(|_| {
            self.tables.len() == tables.len()
                && self.tables[..rows.start] == tables[..rows.start]
                && self.tables[after..] == tables[after..]
        });
        if !same {
            return Err(EncodeError::Jpeg("the library's tables depend on the pixels".into()));
        }
        if self.made_for.is_none() {
            self.tables.clear();
            self.tables.extend_from_slice(tables);
            self.tables[rows].fill(0);
        }
        Ok(layout.scan)
    }
}

/// Where things are in a baseline JPEG of three components.
#[derive(Clone, Copy, Debug)]
pub(super) struct Layout {
    /// Offset of the number of rows.
    pub(super) rows: usize,
    /// Offset of the scan's header.
    pub(super) scan_header: usize,
    /// Offset of the first byte of the scan.
    pub(super) scan: usize,
    /// Width and height of what is coded together. [px]
    pub(super) block: (u32, u32),
}

impl Layout {
    /// Reads the segments (ITU-T T.81, annex B) up to the first scan. `None` for anything that our
    /// encoders do not write.
    pub(super) fn of(jpeg: &[u8]) -> Option<Self> {
        let mut at = START_OF_IMAGE.len();
        if !jpeg.starts_with(&START_OF_IMAGE) {
            return None;
        }
        let mut frame = None;
        loop {
            let segment = jpeg.get(at..)?;
            let &[0xff, marker, high, low, ref rest @ ..] = segment else { return None };
            let len = usize::from(u16::from_be_bytes([high, low]));
            let body = rest.get(..len.checked_sub(2)?)?;
            match marker {
                // APP0 to APP15, DQT, DHT, COM.
                0xe0..=0xef | 0xdb | 0xc4 | 0xfe => {}
                // SOF0: precision, rows, columns, components.
                0xc0 if frame.is_none() => {
                    let &[8, _, _, _, _, 3, ref parts @ ..] = body else { return None };
                    let factors = || parts.chunks(3).filter_map(|part| part.get(1));
                    let across = factors().map(|factor| u32::from(factor >> 4)).max()?;
                    let down = factors().map(|factor| u32::from(factor & 15)).max()?;
                    if !((1..=4).contains(&across) && (1..=4).contains(&down)) {
                        return None;
                    }
                    let block = (8 * across, 8 * down);
                    frame = Some((at + 5, block));
                }
                // SOS, of all components.
                0xda => {
                    let ((rows, block), &[3, ..]) = (frame?, body) else { return None };
                    return Some(Self { rows, scan_header: at, scan: at + 2 + len, block });
                }
                _ => return None,
            }
            at += 2 + len;
        }
    }
}

pub(super) fn damaged(why: &str) -> DecodeError {
    DecodeError::Color(why.to_owned())
}

/// ITU-T T.81, table B.1: SOI.
const START_OF_IMAGE: [u8; 2] = [0xff, 0xd8];
/// ITU-T T.81, table B.1: EOI.
pub(super) const END_OF_IMAGE: [u8; 2] = [0xff, 0xd9];
