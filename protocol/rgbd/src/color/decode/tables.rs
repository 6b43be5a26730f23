//! The tables before a scan (ITU-T T.81, annex B), parsed once per image.

use super::entropy::{CodeKind, Prefixes};
use super::transform::Basis;

/// Tables for the decoding of a scan.
#[derive(Debug)]
pub(super) struct Tables {
    /// Number of columns of the image. [px]
    pub(super) width: u16,
    /// Luma samples per chroma sample, horizontally and vertically: 1 (4:4:4) or 2 (4:2:0).
    pub(super) halving: usize,
    /// Y, Cb and Cr.
    pub(super) components: [Component; 3],
    dc: [Prefixes; 2],
    ac: [Prefixes; 2],
}

/// Tables of one component.
#[derive(Debug)]
pub(super) struct Component {
    pub(super) basis: Basis,
    dc: usize,
    ac: usize,
}

impl Tables {
    /// Parses all segments up to the scan. Rejects features that this bitstream's encoders never use: only baseline
    /// JPEG with Y, Cb and Cr in one scan, with 4:4:4 or 4:2:0 chroma and without restarts, is accepted.
    pub(super) fn read(bytes: &[u8]) -> Result<Self, &'static str> {
        let mut rest =
            bytes.strip_prefix(&[0xff, 0xd8]).ok_or("its tables do not begin like a JPEG")?;
        let mut steps: [Option<&[u8; 64]>; 4] = [None; 4];
        // By class, DC or AC, and number.
        let mut codes: [[Option<Codes>; 2]; 2] = [[None; 2]; 2];
        let mut frame = None;
        loop {
            let (marker, mut body) = segment(&mut rest)?;
            match marker {
                // DQT (B.2.4.1): baseline has only steps of 8 bits.
                0xdb => {
                    while let Some((&number, after)) = body.split_first() {
                        let steps = steps.get_mut(usize::from(number));
                        let steps = steps.ok_or("a quantisation table is not baseline")?;
                        let (table, after) = after.split_first_chunk().ok_or(CUT)?;
                        if table.contains(&0) {
                            return Err("a quantisation table has a step of 0");
                        }
                        (*steps, body) = (Some(table), after);
                    }
                }
                // DHT (B.2.4.2).
                0xc4 => {
                    while let Some((&number, after)) = body.split_first() {
                        let class = codes.get_mut(usize::from(number >> 4));
                        let table = class.and_then(|class| class.get_mut(usize::from(number & 15)));
                        let table = table.ok_or("a Huffman table is not baseline")?;
                        let (counts, after) = after.split_first_chunk().ok_or(CUT)?;
                        let symbols = counts.iter().map(|&count| usize::from(count)).sum();
                        let (symbols, after) = after.split_at_checked(symbols).ok_or(CUT)?;
                        (*table, body) = (Some((counts, symbols)), after);
                    }
                }
                // SOF0 (B.2.2).
                0xc0 if frame.is_none() => frame = Some(read_frame(body)?),
                0xc0..=0xc3 | 0xc5..=0xc7 | 0xc9..=0xcb | 0xcd..=0xcf => {
                    return Err("its JPEG is not baseline, or has two frames");
                }
                // SOS (B.2.3).
                0xda if rest.is_empty() => {
                    let (width, halving, parts) = frame.ok_or("a scan comes before its frame")?;
                    let scan = read_scan(body, parts.map(|part| part.id))?;
                    let prefixes =
                        |kind: CodeKind, number: usize| match codes[kind as usize][number] {
                            Some((counts, symbols)) => Prefixes::new(kind, counts, symbols),
                            None if scan.iter().any(|part| part[kind as usize] == number) => {
                                Err("a Huffman table is missing")
                            }
                            None => Ok(Prefixes::default()),
                        };
                    let mut bases = parts.map(|part| steps[part.steps].map(Basis::new)).into_iter();
                    let mut components = Vec::with_capacity(3);
                    for [dc, ac] in scan {
                        let basis = bases.next().flatten();
                        let basis = basis.ok_or("a quantisation table is missing")?;
                        components.push(Component { basis, dc, ac });
                    }
                    return Ok(Self {
                        width,
                        halving,
                        components: components.try_into().map_err(|_| CUT)?,
                        dc: [prefixes(CodeKind::Dc, 0)?, prefixes(CodeKind::Dc, 1)?],
                        ac: [prefixes(CodeKind::Ac, 0)?, prefixes(CodeKind::Ac, 1)?],
                    });
                }
                0xda => return Err("bytes follow its tables"),
                0xdd => return Err("its JPEG has restart intervals"),
                // APP14: Adobe's marker for colours other than Y, Cb, Cr.
                0xee if body.starts_with(b"Adobe") && body.get(11) != Some(&1) => {
                    return Err("its colours are not Y, Cb and Cr");
                }
                // APP0 to APP15, COM.
                0xe0..=0xef | 0xfe => {}
                _ => return Err("its tables have an unknown segment"),
            }
        }
    }

    /// Returns the codes of a component's DC and AC coefficients.
    pub(super) fn prefixes(&self, component: &Component) -> (&Prefixes, &Prefixes) {
        (&self.dc[component.dc], &self.ac[component.ac])
    }
}

/// Number of codes of each length, and their symbols.
type Codes<'a> = (&'a [u8; 16], &'a [u8]);

const CUT: &str = "its tables are cut short";

/// Takes the next segment; returns its marker and its bytes after the length.
fn segment<'a>(bytes: &mut &'a [u8]) -> Result<(u8, &'a [u8]), &'static str> {
    let &[0xff, marker, high, low, ref rest @ ..] = *bytes else {
        return Err(if bytes.len() < 4 { CUT } else { "its tables have bytes between segments" });
    };
    let len = usize::from(u16::from_be_bytes([high, low])).checked_sub(2).ok_or(CUT)?;
    let (body, after) = rest.split_at_checked(len).ok_or(CUT)?;
    *bytes = after;
    Ok((marker, body))
}

/// A component in the frame.
#[derive(Clone, Copy)]
struct Part {
    id: u8,
    /// Number of its quantisation table.
    steps: usize,
}

/// Parses width, chroma halving, and components.
fn read_frame(body: &[u8]) -> Result<(u16, usize, [Part; 3]), &'static str> {
    let &[precision, _, _, high, low, 3, ref parts @ ..] = body else {
        return Err("its JPEG does not have three components");
    };
    let (&[luma, cb, cr], &[]) = parts.as_chunks::<3>() else { return Err(CUT) };
    if precision != 8 {
        return Err("its JPEG does not have 8 bits per sample");
    }
    let halving = match [luma[1], cb[1], cr[1]] {
        [0x11, 0x11, 0x11] => 1,
        [0x22, 0x11, 0x11] => 2,
        _ => return Err("its chroma is neither 4:4:4 nor 4:2:0"),
    };
    let parts = [luma, cb, cr].map(|[id, _, steps]| Part { id, steps: usize::from(steps) });
    if parts.iter().any(|part| part.steps > 3) {
        return Err("a quantisation table is not baseline");
    }
    Ok((u16::from_be_bytes([high, low]), halving, parts))
}

/// Parses the numbers of every component's DC and AC codes.
fn read_scan(body: &[u8], ids: [u8; 3]) -> Result<[[usize; 2]; 3], &'static str> {
    let &[3, a, a_codes, b, b_codes, c, c_codes, 0, 63, 0] = body else {
        return Err("its scan does not have three complete components");
    };
    if [a, b, c] != ids {
        return Err("its scan and its frame have different components");
    }
    let codes = [a_codes, b_codes, c_codes].map(|both| [both >> 4, both & 15].map(usize::from));
    if codes.as_flattened().iter().any(|&number| number > 1) {
        return Err("a Huffman table is not baseline");
    }
    Ok(codes)
}
