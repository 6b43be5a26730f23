//! The tables before a scan (ITU-T T.81, annex B), read once an image.

use super::entropy::{CodeKind, Prefixes};
use super::transform::Basis;

/// What decoding a scan takes.
#[derive(Debug)]
pub(super) struct Tables {
    /// Columns of the image. [px]
    pub(super) width: u16,
    /// Luma samples per chroma sample, across and down: 1 (4:4:4) or 2 (4:2:0).
    pub(super) halving: usize,
    /// Of Y, Cb and Cr.
    pub(super) components: [Component; 3],
    dc: [Prefixes; 2],
    ac: [Prefixes; 2],
}

/// What one component's blocks are decoded with.
#[derive(Debug)]
pub(super) struct Component {
    pub(super) basis: Basis,
    dc: usize,
    ac: usize,
}

impl Tables {
    /// Reads all up to the scan. Refuses what this bitstream's encoders never wrote: anything but
    /// baseline with Y, Cb and Cr in one scan, chroma whole or halved both ways, no restarts.
    pub(super) fn read(bytes: &[u8]) -> Result<Self, &'static str> {
        let mut rest =
            bytes.strip_prefix(&[0xff, 0xd8]).ok_or("its tables are those of no JPEG")?;
        let mut steps: [Option<&[u8; 64]>; 4] = [None; 4];
        // By class, DC or AC, and number.
        let mut codes: [[Option<Codes>; 2]; 2] = [[None; 2]; 2];
        let mut frame = None;
        loop {
            let (marker, mut body) = segment(&mut rest)?;
            match marker {
                // DQT (B.2.4.1): baseline has steps of 8 bits alone.
                0xdb => {
                    while let Some((&number, after)) = body.split_first() {
                        let steps = steps.get_mut(usize::from(number));
                        let steps = steps.ok_or("a quantisation table is none of baseline's")?;
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
                        let table = table.ok_or("a Huffman table is none of baseline's")?;
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
                // APP14: Adobe's mark of colours that are not Y, Cb, Cr.
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

/// How many codes have each length, and their symbols.
type Codes<'a> = (&'a [u8; 16], &'a [u8]);

const CUT: &str = "its tables are cut short";

/// Takes the next segment: its marker, and what follows its length.
fn segment<'a>(bytes: &mut &'a [u8]) -> Result<(u8, &'a [u8]), &'static str> {
    let &[0xff, marker, high, low, ref rest @ ..] = *bytes else {
        return Err(if bytes.len() < 4 { CUT } else { "its tables have bytes between segments" });
    };
    let len = usize::from(u16::from_be_bytes([high, low])).checked_sub(2).ok_or(CUT)?;
    let (body, after) = rest.split_at_checked(len).ok_or(CUT)?;
    *bytes = after;
    Ok((marker, body))
}

/// A component as the frame names it.
#[derive(Clone, Copy)]
struct Part {
    id: u8,
    /// Number of its quantisation table.
    steps: usize,
}

/// Reads width, halving of chroma, and components.
fn read_frame(body: &[u8]) -> Result<(u16, usize, [Part; 3]), &'static str> {
    let &[precision, _, _, high, low, 3, ref parts @ ..] = body else {
        return Err("its JPEG has not three components");
    };
    let (&[luma, cb, cr], &[]) = parts.as_chunks::<3>() else { return Err(CUT) };
    if precision != 8 {
        return Err("its JPEG has not 8 bits a sample");
    }
    let halving = match [luma[1], cb[1], cr[1]] {
        [0x11, 0x11, 0x11] => 1,
        [0x22, 0x11, 0x11] => 2,
        _ => return Err("its chroma is neither 4:4:4 nor 4:2:0"),
    };
    let parts = [luma, cb, cr].map(|[id, _, steps]| Part { id, steps: usize::from(steps) });
    if parts.iter().any(|part| part.steps > 3) {
        return Err("a quantisation table is none of baseline's");
    }
    Ok((u16::from_be_bytes([high, low]), halving, parts))
}

/// Reads the numbers of every component's DC and AC codes.
fn read_scan(body: &[u8], ids: [u8; 3]) -> Result<[[usize; 2]; 3], &'static str> {
    let &[3, a, a_codes, b, b_codes, c, c_codes, 0, 63, 0] = body else {
        return Err("its scan is not all of three components");
    };
    if [a, b, c] != ids {
        return Err("its scan has other components than its frame");
    }
    let codes = [a_codes, b_codes, c_codes].map(|both| [both >> 4, both & 15].map(usize::from));
    if codes.as_flattened().iter().any(|&number| number > 1) {
        return Err("a Huffman table is none of baseline's");
    }
    Ok(codes)
}
