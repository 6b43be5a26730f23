//! Tables of annex K of ITU-T T.81: divisors of coefficients and codes of the quotients; and the segments before a scan
//! (annex B), which contain both.

use super::super::jpeg::{START_OF_IMAGE, ZIGZAG};
use crate::header::ColorMode;

/// Tables K.1 and K.2, row by row: luma and chroma.
const DIVISORS: [[u8; 64]; 2] = [
    [
        16, 11, 10, 16, 24, 40, 51, 61, //
        12, 12, 14, 19, 26, 58, 60, 55, //
        14, 13, 16, 24, 40, 57, 69, 56, //
        14, 17, 22, 29, 51, 87, 80, 62, //
        18, 22, 37, 56, 68, 109, 103, 77, //
        24, 35, 55, 64, 81, 104, 113, 92, //
        49, 64, 78, 87, 103, 121, 120, 101, //
        72, 92, 95, 98, 112, 100, 103, 99,
    ],
    [
        17, 18, 24, 47, 99, 99, 99, 99, //
        18, 21, 26, 66, 99, 99, 99, 99, //
        24, 26, 56, 99, 99, 99, 99, 99, //
        47, 66, 99, 99, 99, 99, 99, 99, //
        99, 99, 99, 99, 99, 99, 99, 99, //
        99, 99, 99, 99, 99, 99, 99, 99, //
        99, 99, 99, 99, 99, 99, 99, 99, //
        99, 99, 99, 99, 99, 99, 99, 99,
    ],
];

/// Returns the divisors of luma and chroma, row by row, at a quality of 1 to 100. 50 gives those of annex K; others are
/// scaled as in the Independent JPEG Group's library.
pub(super) fn divisors(quality: u8) -> [[u8; 64]; 2] {
    let quality = u32::from(quality);
    let percent = if quality < 50 { 5000 / quality } else { 200 - 2 * quality };
    let scale = |base| ((u32::from(base) * percent + 50) / 100).clamp(1, 255) as u8;
    DIVISORS.map(|table| table.map(scale))
}

/// A Huffman code as in DHT: the number of words of 1 to 16 bits, and their meanings.
struct Code {
    counts: [u8; 16],
    /// Meanings of the shorter words; the 16-bit words have all other meanings, in ascending order.
    short: &'static [u8],
}

/// Tables K.3 and K.4: categories of differences of DC coefficients, in order.
const DC: [Code; 2] = [
    Code {
        counts: [0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0],
        short: &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11],
    },
    Code {
        counts: [0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0],
        short: &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11],
    },
];

/// Tables K.5 and K.6: 16 times the zeros before an AC coefficient, plus its category.
const AC: [Code; 2] = [
    Code {
        counts: [0, 2, 1, 3, 3, 2, 4, 3, 5, 5, 4, 4, 0, 0, 1, 125],
        short: &[
            0x01, 0x02, 0x03, 0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51,
            0x61, 0x07, 0x22, 0x71, 0x14, 0x32, 0x81, 0x91, 0xa1, 0x08, 0x23, 0x42, 0xb1, 0xc1,
            0x15, 0x52, 0xd1, 0xf0, 0x24, 0x33, 0x62, 0x72, 0x82,
        ],
    },
    Code {
        counts: [0, 2, 1, 2, 4, 4, 3, 4, 7, 5, 4, 4, 0, 1, 2, 119],
        short: &[
            0x00, 0x01, 0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07,
            0x61, 0x71, 0x13, 0x22, 0x32, 0x81, 0x08, 0x14, 0x42, 0x91, 0xa1, 0xb1, 0xc1, 0x09,
            0x23, 0x33, 0x52, 0xf0, 0x15, 0x62, 0x72, 0xd1, 0x0a, 0x16, 0x24, 0x34, 0xe1, 0x25,
            0xf1,
        ],
    },
];

impl Code {
    /// Returns the meanings of the words, shorter ones first, padded with zeros; and their number.
    const fn meanings(&self) -> ([u8; 162], usize) {
        let mut all = [0; 162];
        let mut is_short = [false; 256];
        let mut len = 0;
        while len < self.short.len() {
            all[len] = self.short[len];
            is_short[self.short[len] as usize] = true;
            len += 1;
        }
        let mut meaning = 0;
        while self.counts[15] > 0 && meaning < 256 {
            let category = meaning % 16;
            if 1 <= category && category <= 10 && !is_short[meaning] {
                all[len] = meaning as u8;
                len += 1;
            }
            meaning += 1;
        }
        (all, len)
    }

    /// Returns word and length by meaning (annex C); 0 bits for a meaning without a word.
    const fn words(&self) -> [(u16, u8); 256] {
        let mut words = [(0, 0); 256];
        let (meanings, _) = self.meanings();
        let (mut at, mut word, mut bits) = (0, 0, 1);
        while bits <= 16 {
            let mut count = self.counts[bits - 1];
            while count > 0 {
                words[meanings[at] as usize] = (word, bits as u8);
                at += 1;
                word += 1;
                count -= 1;
            }
            word <<= 1;
            bits += 1;
        }
        words
    }
}

/// Words for the coefficients of a component.
pub(super) struct Words {
    /// By category: the word, shifted up by the number of bits that follow it, multiplied by 32; plus the length of
    /// both. [bits]
    pub(super) dc: [u32; 12],
    /// As `dc`, but by 16 times the preceding zeros plus the leading zeros of the coefficient's magnitude in 32 bits,
    /// modulo 256.
    pub(super) ac: [u32; 256],
    pub(super) sixteen_zeros: u32,
    /// End of block: only zeros follow.
    pub(super) end: u32,
}

impl Words {
    const fn new(dc: &Code, ac: &Code) -> Self {
        const fn joined((word, bits): (u16, u8), category: u32) -> u32 {
            (word as u32) << (category + 5) | (bits as u32 + category)
        }
        let (dc, ac) = (dc.words(), ac.words());
        let mut words = Self {
            dc: [0; 12],
            ac: [0; 256],
            sixteen_zeros: joined(ac[0xf0], 0),
            end: joined(ac[0], 0),
        };
        let mut category = 0;
        while category < 12 {
            words.dc[category] = joined(dc[category], category as u32);
            category += 1;
        }
        let mut meaning = 0;
        while meaning < 256 {
            let category = meaning % 16;
            if 1 <= category && category <= 10 {
                let at = (meaning - category + 32 - category) % 256;
                words.ac[at] = joined(ac[meaning], category as u32);
            }
            meaning += 1;
        }
        words
    }
}

/// Luma and chroma.
pub(super) static WORDS: [Words; 2] = [Words::new(&DC[0], &AC[0]), Words::new(&DC[1], &AC[1])];

/// Appends all segments of a JPEG up to its scan.
pub(super) fn write_segments(
    out: &mut Vec<u8>,
    (width, rows): (u16, u16),
    quality: u8,
    mode: ColorMode,
) {
    out.extend_from_slice(&START_OF_IMAGE);
    let mut segment = |marker: u8, parts: &[&[u8]]| {
        let len = 2 + parts.iter().map(|part| part.len()).sum::<usize>();
        out.extend_from_slice(&[0xff, marker]);
        out.extend_from_slice(&(len as u16).to_be_bytes());
        for part in parts {
            out.extend_from_slice(part);
        }
    };
    // APP0 of JFIF 1.2: square pixels, no thumbnail.
    segment(0xe0, &[b"JFIF\0", &[1, 2, 0, 0, 1, 0, 1, 0, 0]]);
    // DQT.
    for (id, table) in divisors(quality).iter().enumerate() {
        segment(0xdb, &[&[id as u8], &ZIGZAG.map(|at| table[usize::from(at)])]);
    }
    // SOF0: sampling factors and divisors of each component.
    let [rows, width] = [rows, width].map(u16::to_be_bytes);
    let luma = if mode == ColorMode::Jpeg420 { 0x22 } else { 0x11 };
    segment(0xc0, &[&[8], &rows, &width, &[3, 1, luma, 0, 2, 0x11, 1, 3, 0x11, 1]]);
    // DHT: class and number.
    for (class, codes) in [&DC, &AC].into_iter().enumerate() {
        for (id, code) in codes.iter().enumerate() {
            let (meanings, len) = code.meanings();
            segment(0xc4, &[&[(16 * class + id) as u8], &code.counts, &meanings[..len]]);
        }
    }
    // SOS: codes of each component; all coefficients, all bits.
    segment(0xda, &[&[3, 1, 0, 2, 0x11, 3, 0x11, 0, 63, 0]]);
}
