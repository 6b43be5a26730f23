//! JPEGs put together of tables and scans, and decoded.

use super::library;
use crate::error::DecodeError;

/// Decodes slices; owns the scratch memory.
#[derive(Debug, Default)]
pub(crate) struct JpegSliceDecoder {
    library: library::Decoder,
    tables: Vec<u8>,
    /// Where the tables have the number of rows.
    rows: usize,
    jpeg: Vec<u8>,
}

impl JpegSliceDecoder {
    /// Takes the tables of the image to come.
    pub(crate) fn start(&mut self, tables: &[u8], width: u32) -> Result<(), DecodeError> {
        let layout = Layout::of(tables).filter(|layout| layout.scan == tables.len());
        let layout = layout.ok_or_else(|| damaged("its tables are those of no baseline JPEG"))?;
        if u32::from(layout.width) != width {
            let found = layout.width;
            return Err(damaged(&format!("its tables are for a width of {found}, not {width}")));
        }
        self.tables.clear();
        self.tables.extend_from_slice(tables);
        self.rows = layout.rows;
        Ok(())
    }

    /// Decodes some rows, H x W x 3.
    pub(crate) fn decode(
        &mut self,
        scan: &[u8],
        size: (u32, u32),
        rgb_out: &mut [u8],
    ) -> Result<(), DecodeError> {
        // Libraries fill what a cut image lacks with grey, and follow markers to further scans,
        // which make a small file cost any amount of time. Our scans have no markers inside.
        let Some(entropy) = scan.strip_suffix(&END_OF_IMAGE) else {
            return Err(damaged("a scan lacks its end"));
        };
        let mut rest = entropy;
        while let Some(at) = rest.iter().position(|&byte| byte == 0xff) {
            if rest.get(at + 1) != Some(&0) {
                return Err(damaged("a scan has a marker inside"));
            }
            rest = &rest[at + 2..];
        }
        self.jpeg.clear();
        self.jpeg.extend_from_slice(&self.tables);
        self.jpeg[self.rows..self.rows + 2].copy_from_slice(&(size.1 as u16).to_be_bytes());
        self.jpeg.extend_from_slice(scan);
        self.library.decode(&self.jpeg, size, rgb_out)
    }
}

/// Where things are in a baseline JPEG of three components.
#[derive(Clone, Copy, Debug)]
pub(super) struct Layout {
    width: u16,
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
                    let &[8, _, _, high, low, 3, ref parts @ ..] = body else { return None };
                    let factors = || parts.chunks(3).filter_map(|part| part.get(1));
                    let across = factors().map(|factor| u32::from(factor >> 4)).max()?;
                    let down = factors().map(|factor| u32::from(factor & 15)).max()?;
                    if !((1..=4).contains(&across) && (1..=4).contains(&down)) {
                        return None;
                    }
                    let block = (8 * across, 8 * down);
                    frame = Some((u16::from_be_bytes([high, low]), at + 5, block));
                }
                // SOS, of all components.
                0xda => {
                    let ((width, rows, block), &[3, ..]) = (frame?, body) else { return None };
                    return Some(Self { width, rows, scan_header: at, scan: at + 2 + len, block });
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
pub(super) const START_OF_IMAGE: [u8; 2] = [0xff, 0xd8];
/// ITU-T T.81, table B.1: EOI.
pub(super) const END_OF_IMAGE: [u8; 2] = [0xff, 0xd9];
