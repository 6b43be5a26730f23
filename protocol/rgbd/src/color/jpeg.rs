//! Layout of a baseline JPEG: its segments, and the order of a block's coefficients.

use crate::error::DecodeError;

/// Offsets in a baseline JPEG of three components.
#[derive(Clone, Copy, Debug)]
pub(super) struct Layout {
    /// Offset of the number of rows.
    pub(super) rows: usize,
    /// Offset of the scan's header.
    pub(super) scan_header: usize,
    /// Offset of the first byte of the scan.
    pub(super) scan: usize,
    /// Width and height of a coding unit (MCU). [px]
    pub(super) block: (u32, u32),
}

impl Layout {
    /// Parses the segments (ITU-T T.81, annex B) up to the first scan. `None` for segments that this crate's encoders
    /// do not write.
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
pub(super) const START_OF_IMAGE: [u8; 2] = [0xff, 0xd8];
/// ITU-T T.81, table B.1: EOI.
pub(super) const END_OF_IMAGE: [u8; 2] = [0xff, 0xd9];

/// Position of the zigzag's n-th coefficient: 8 times its vertical frequency plus its horizontal one (figure A.6).
pub(super) const ZIGZAG: [u8; 64] = {
    let mut order = [0; 64];
    let (mut at, mut diagonal) = (0, 0);
    while diagonal < 15 {
        // Odd diagonals go down, even diagonals go up.
        let mut step = 0;
        while step <= diagonal {
            let (v, u) =
                if diagonal % 2 == 1 { (step, diagonal - step) } else { (diagonal - step, step) };
            if v < 8 && u < 8 {
                order[at] = 8 * v + u;
                at += 1;
            }
            step += 1;
        }
        diagonal += 1;
    }
    order
};
