//! Huffman decoding of a scan (ITU-T T.81, annex F.2.2).
//!
//! One look-up returns the total number of bits of a code and the number after it. So the next look-up depends on
//! nothing else, and the number is computed in parallel to this chain.

use super::transform::{Basis, Lanes};

/// Maximum length of codes that are found by one look-up. [bits]
const SHORT: u32 = 10;
/// Maximum length of a code and its number: 16 and 11. [bits]
const LONGEST: u32 = 27;
/// Advance of an end of block, larger than any block.
const END_OF_BLOCK: u32 = 64;

/// Kind of coefficients of a code.
#[derive(Clone, Copy)]
pub(super) enum CodeKind {
    Dc,
    Ac,
}

/// Prefix codes of DC or AC coefficients.
#[derive(Debug)]
pub(super) struct Prefixes {
    /// Entries by the next bits; [`Entry::NONE`] for longer codes.
    short: [Entry; 1 << SHORT],
    /// By length minus one: first 16 bits that do not begin a code of at most this length.
    ends: [u32; 16],
    /// By length minus one: offset from a code to its entry.
    offsets: [u32; 16],
    entries: Vec<Entry>,
}

/// Meaning of a code. Four bytes, the first one lowest: bits of code and number; bits of the code; 63 minus the bits of
/// the number; advance in coefficients.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Entry(u32);

impl Entry {
    const NONE: Self = Self(0);

    fn new(len: u32, size: u32, advance: u32) -> Self {
        Self((len + size) | len << 8 | (63 - size) << 16 | advance << 24)
    }

    #[inline(always)]
    fn bits(self) -> u32 {
        self.0 & 63
    }

    #[inline(always)]
    fn advance(self) -> u32 {
        self.0 >> 24
    }

    /// Returns the number after the code at the beginning of `bits` (F.2.2.1, EXTEND).
    #[inline(always)]
    fn number(self, bits: u64) -> i32 {
        let number = bits << (self.0 >> 8 & 63);
        // All ones for a negative number, which is stored as the complement of its magnitude.
        let negative = !(number.cast_signed() >> 63);
        let size = (number ^ negative.cast_unsigned()) >> 1 >> (self.0 >> 16 & 63);
        (size as i32 ^ negative as i32) - negative as i32
    }
}

impl Default for Prefixes {
    fn default() -> Self {
        let short = [Entry::NONE; 1 << SHORT];
        Self { short, ends: [0; 16], offsets: [0; 16], entries: Vec::new() }
    }
}

impl Prefixes {
    /// Builds the codes (C.2) of these symbols from the number of codes of each length.
    pub(super) fn new(
        kind: CodeKind,
        counts: &[u8; 16],
        symbols: &[u8],
    ) -> Result<Self, &'static str> {
        let mut prefixes = Self::default();
        let mut symbols = symbols.iter();
        let mut code = 0u32;
        for (at, &count) in counts.iter().enumerate() {
            let len = at as u32 + 1;
            prefixes.offsets[at] = (prefixes.entries.len() as u32).wrapping_sub(code);
            for &symbol in symbols.by_ref().take(usize::from(count)) {
                let (run, size) = (u32::from(symbol >> 4), u32::from(symbol & 15));
                let advance = match (kind, run, size) {
                    (CodeKind::Ac, 0, 0) => END_OF_BLOCK,
                    (CodeKind::Ac, 15, 0) | (CodeKind::Ac, _, 1..=10) => run + 1,
                    (CodeKind::Dc, 0, 0..=11) => 0,
                    _ => return Err("a Huffman table has a symbol that baseline does not allow"),
                };
                let entry = Entry::new(len, size, advance);
                if len <= SHORT {
                    let start = (code << (SHORT - len)) as usize;
                    let alike = prefixes.short.get_mut(start..start + (1 << (SHORT - len)));
                    alike.ok_or(OVERFULL)?.fill(entry);
                }
                prefixes.entries.push(entry);
                code += 1;
            }
            if code > 1 << len {
                return Err(OVERFULL);
            }
            prefixes.ends[at] = code << (16 - len);
            code <<= 1;
        }
        Ok(prefixes)
    }

    /// Returns the meaning of the code at the beginning of `bits`; [`Entry::NONE`] for an unknown code.
    #[inline(always)]
    fn find(&self, bits: u64) -> Entry {
        let entry = self.short[(bits >> (64 - SHORT)) as usize];
        if entry == Entry::NONE { self.find_long((bits >> 48) as u32) } else { entry }
    }

    #[cold]
    #[inline(never)]
    fn find_long(&self, bits: u32) -> Entry {
        let Some(at) = self.ends.iter().position(|&end| bits < end) else { return Entry::NONE };
        let index = (bits >> (15 - at)).wrapping_add(self.offsets[at]);
        self.entries.get(index as usize).copied().unwrap_or(Entry::NONE)
    }
}

const OVERFULL: &str = "a Huffman table has too many codes";
const NO_CODE: &str = "a scan has an invalid code";

/// Bits of a scan, high bits first.
///
/// The rare refill takes a copy and returns it, so that the fields of the original stay in registers.
#[derive(Clone, Copy)]
pub(super) struct Bits<'a> {
    /// The next bits, the first one highest. After `len` bits come zeros, or bits of `plain`.
    next: u64,
    /// Number of bits in `next` that were taken from the bytes. [bits]
    len: u32,
    /// Number of these bits beyond the end of the bytes. [bits]
    missing: u32,
    /// Bytes before the next 0xff.
    plain: &'a [u8],
    /// Bytes from the next 0xff, if any.
    rest: &'a [u8],
}

impl<'a> Bits<'a> {
    /// Begins a scan; `scan` does not include its end marker.
    pub(super) fn new(scan: &'a [u8]) -> Self {
        let (plain, rest) = split_plain(scan);
        Self { next: 0, len: 0, missing: 0, plain, rest }
    }

    /// Refills to at least 56 bits.
    #[inline(always)]
    fn refill(&mut self) {
        if let Some(eight) = self.plain.first_chunk() {
            self.next |= u64::from_be_bytes(*eight) >> (self.len & 63);
            self.plain = &self.plain[(!self.len as usize >> 3) % 8..];
            self.len |= 0b11_1000;
        } else {
            *self = self.refilled();
        }
    }

    #[cold]
    #[inline(never)]
    fn refilled(mut self) -> Self {
        while self.len < 56 {
            let byte = if let Some((&byte, plain)) = self.plain.split_first() {
                self.plain = plain;
                byte
            } else if let [0xff, 0, rest @ ..] = self.rest {
                (self.plain, self.rest) = split_plain(rest);
                0xff
            } else {
                self.missing += 8;
                0
            };
            self.next |= u64::from(byte) << (56 - self.len);
            self.len += 8;
        }
        self
    }

    #[inline(always)]
    fn skip(&mut self, bits: u32) {
        self.next <<= bits;
        self.len -= bits;
    }

    /// Decodes a block to its coefficients' contributions to every column, as input of the column transform. `dc` is
    /// the DC of the previous block.
    #[inline(always)]
    pub(super) fn block(
        &mut self,
        (dc_codes, ac_codes): (&Prefixes, &Prefixes),
        basis: &Basis,
        dc: &mut i32,
    ) -> Result<[Lanes; 8], &'static str> {
        self.refill();
        let entry = dc_codes.find(self.next);
        if entry == Entry::NONE {
            return Err(self.why(NO_CODE, 16));
        }
        *dc = dc.wrapping_add(entry.number(self.next));
        self.skip(entry.bits());
        let mut rows = basis.start(*dc);
        let mut at = 0;
        let (entry, number) = 'codes: loop {
            self.refill();
            // A refill usually provides enough bits for three codes.
            for turn in 0..3 {
                if turn > 0 && self.len < LONGEST {
                    break;
                }
                let entry = ac_codes.find(self.next);
                if entry == Entry::NONE {
                    return Err(self.why(NO_CODE, 16));
                }
                let number = entry.number(self.next);
                self.skip(entry.bits());
                at += entry.advance();
                if at >= 63 {
                    break 'codes (entry, number);
                }
                basis.add(&mut rows, at as usize, number);
            }
        };
        if at == 63 {
            basis.add(&mut rows, 63, number);
        } else if entry.advance() != END_OF_BLOCK {
            return Err(self.why("a scan has a run beyond its block", 0));
        }
        if self.missing > self.len {
            return Err(self.why(NO_CODE, 16));
        }
        Ok(rows)
    }

    /// Checks that only padding is left: less than a byte of ones (F.1.2.3).
    pub(super) fn finish(&self) -> Result<(), &'static str> {
        if !self.rest.is_empty() && self.rest.get(1) != Some(&0) {
            return Err(MARKER);
        }
        let left = (self.len - self.missing) as usize + 8 * self.plain.len();
        if left >= 8 || !self.rest.is_empty() {
            return Err("a scan goes on after its pixels");
        }
        // Bits beyond the end are zero.
        if self.next.leading_ones() as usize != left {
            return Err("a scan has padding other than ones");
        }
        Ok(())
    }

    /// Returns the error of a scan. `seen` is the error found in the next `ahead` bits; missing bits or a marker can be
    /// its cause.
    #[cold]
    fn why(&self, seen: &'static str, ahead: u32) -> &'static str {
        if self.missing == 0 {
            seen
        } else if !self.rest.is_empty() {
            MARKER
        } else if self.missing + ahead > self.len {
            "a scan ends before its pixels do"
        } else {
            seen
        }
    }
}

const MARKER: &str = "a scan has a marker inside";

/// Splits off the bytes before the first 0xff.
fn split_plain(bytes: &[u8]) -> (&[u8], &[u8]) {
    // Chunks of constant length are compared with vector instructions.
    let (chunks, _) = bytes.as_chunks::<32>();
    let is_plain = |chunk: &&[u8; 32]| chunk.iter().fold(0, |most, &byte| byte.max(most)) < 255;
    let start = 32 * chunks.iter().take_while(is_plain).count();
    let len = bytes[start..].iter().position(|&byte| byte == 0xff);
    bytes.split_at(len.map_or(bytes.len(), |len| start + len))
}
