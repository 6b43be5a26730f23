//! Encoder of baseline JPEG (ITU-T T.81), 32 pixels of 8 or 16 rows at a time.
//!
//! ```text
//! pixels -> YCbCr -> cosine transform -> quotients and nonzero masks -> words -> bytes
//! |------------------ transform.rs, by lanes.rs -------------------|    |-entropy.rs-|
//! ```
//!
//! Tables are those of annex K, so they depend only on width, quality and mode, and a scan is written without them. All
//! arithmetic is in integers with defined rounding: x86-64 and ARM64 encode the same bytes.

#![allow(
    unsafe_code,
    reason = "calls of functions compiled for more instructions, after detection"
)]

mod entropy;
mod lanes;
mod tables;
#[cfg(test)]
mod tests;
mod transform;

use entropy::{Bits, Coded};
use lanes::Lanes;
use tables::WORDS;
use transform::{ACROSS, BLOCKS, Coefficients, Quantiser, Samples, convert, transform};

use super::jpeg::END_OF_IMAGE;
use crate::error::EncodeError;
use crate::header::{ColorMode, MAX_SIDE};

/// Appends a baseline JPEG, 4:4:4, to `out`: the same bytes on every processor. `rgb` is row-major, three bytes per
/// pixel; quality is 1 to 100.
///
/// # Errors
/// [`EncodeError::Size`], [`EncodeError::Rgb`] or [`EncodeError::Quality`] for arguments out of
/// range.
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
    let (width, height) = (width as u16, height as u16);
    tables::write_segments(out, (width, height), quality, ColorMode::Jpeg444);
    Scan::new(width, quality, ColorMode::Jpeg444).write(rgb, out);
    Ok(())
}

/// Encodes slices.
#[derive(Debug, Default)]
pub(crate) struct JpegSliceEncoder {
    /// Width, quality and mode of `tables` and `scan`.
    made_for: Option<(u16, u8, ColorMode)>,
    /// All segments up to the scan, with 0 rows.
    tables: Vec<u8>,
    scan: Option<Scan>,
}

impl JpegSliceEncoder {
    /// Returns the tables of images with this width, quality and mode, to be stored once.
    pub(crate) fn tables(&mut self, width: u16, quality: u8, mode: ColorMode) -> &[u8] {
        if self.made_for != Some((width, quality, mode)) {
            self.made_for = Some((width, quality, mode));
            self.scan = Some(Scan::new(width, quality, mode));
            self.tables.clear();
            tables::write_segments(&mut self.tables, (width, 0), quality, mode);
        }
        &self.tables
    }

    /// Appends the scan of a range of rows to `out`, to be decoded with the latest [`Self::tables`].
    pub(crate) fn scan(&mut self, rgb: &[u8], out: &mut Vec<u8>) {
        self.scan.as_ref().expect("tables come before scans").write(rgb, out);
    }
}

/// Writes scans of one width, quality and mode.
#[derive(Debug)]
struct Scan {
    width: usize,
    mode: ColorMode,
    /// Luma and chroma.
    quantisers: [Quantiser; 2],
}

impl Scan {
    fn new(width: u16, quality: u8, mode: ColorMode) -> Self {
        let quantisers = tables::divisors(quality).each_ref().map(Quantiser::new);
        Self { width: usize::from(width), mode, quantisers }
    }

    /// Appends the scan of these rows and its end marker.
    fn write(&self, rgb: &[u8], out: &mut Vec<u8>) {
        widest()(self, rgb, out);
    }

    /// Writes with vectors of type `V`.
    #[inline(always)]
    fn write_by<V: Lanes>(&self, rgb: &[u8], out: &mut Vec<u8>) {
        let is_halved = self.mode == ColorMode::Jpeg420;
        let (side, parts): (_, &[Part]) = if is_halved { (16, &HALVED) } else { (8, &FULL) };
        let view = View { rgb, width: self.width, height: rgb.len() / (3 * self.width) };
        let mut samples: [Samples; 3] = [[[0; ACROSS]; 8]; 3];
        let mut coefficients = [const { Coefficients::new() }; 3];
        let mut coded = Coded::new();
        let mut last_dc = [0; 3];
        let mut bits = Bits::new(out);
        for top in (0..view.height).step_by(side) {
            for left in (0..view.width).step_by(ACROSS) {
                if is_halved {
                    view.halved::<V>(left, top, &mut samples);
                } else {
                    view.full::<V>(left, top, &mut samples);
                }
                for (strip, (samples, out)) in samples.iter().zip(&mut coefficients).enumerate() {
                    let is_luma = strip == 0 || strip == 1 && is_halved;
                    transform::<V>(samples, &self.quantisers[usize::from(!is_luma)], out);
                }
                for unit in 0..ACROSS.min(view.width - left).div_ceil(side) {
                    for part in parts {
                        coded.block(
                            &coefficients[part.strip],
                            part.first + part.step * unit,
                            &WORDS[part.component.min(1)],
                            &mut last_dc[part.component],
                        );
                    }
                }
                bits.extend(coded.take());
            }
        }
        bits.finish();
        out.extend_from_slice(&END_OF_IMAGE);
    }
}

/// Function that writes a scan.
type Way = fn(&Scan, &[u8], &mut Vec<u8>);

/// Returns the implementation with the machine's widest vectors.
#[cfg(target_arch = "x86_64")]
fn widest() -> Way {
    by_avx512().or_else(by_avx2).unwrap_or(Scan::write_by::<lanes::Plain>)
}

/// Returns the implementation with the machine's vectors.
#[cfg(target_arch = "aarch64")]
fn widest() -> Way {
    Scan::write_by::<lanes::Neon>
}

#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
fn widest() -> Way {
    Scan::write_by::<lanes::Plain>
}

/// Defines a function that returns an implementation compiled for these instructions, if the machine has them.
#[cfg(target_arch = "x86_64")]
macro_rules! way {
    ($name:ident, $lanes:ident, $features:literal, [$($feature:tt),*]) => {
        fn $name() -> Option<Way> {
            #[target_feature(enable = $features)]
            fn compiled(scan: &Scan, rgb: &[u8], out: &mut Vec<u8>) {
                scan.write_by::<lanes::$lanes>(rgb, out);
            }
            let is_there = $(is_x86_feature_detected!($feature))&&*;
            // SAFETY: the machine supports the features for which the function is compiled.
            is_there.then_some(|scan, rgb, out| unsafe { compiled(scan, rgb, out) })
        }
    };
}

#[cfg(target_arch = "x86_64")]
way!(by_avx2, Avx2, "avx2,bmi1,bmi2,lzcnt,popcnt", ["avx2", "bmi1", "bmi2", "lzcnt", "popcnt"]);
#[cfg(target_arch = "x86_64")]
way!(
    by_avx512,
    Avx512,
    "avx512bw,avx512vl,bmi1,bmi2,lzcnt,popcnt",
    ["avx512bw", "avx512vl", "bmi1", "bmi2", "lzcnt", "popcnt"]
);

/// One block of a coding unit: its strip of blocks side by side, the index of the first unit's block, and the step to
/// the next unit's block.
struct Part {
    strip: usize,
    first: usize,
    step: usize,
    component: usize,
}

const fn part(strip: usize, first: usize, step: usize, component: usize) -> Part {
    Part { strip, first, step, component }
}

/// 4:4:4: one strip per component.
const FULL: [Part; 3] = [part(0, 0, 1, 0), part(1, 0, 1, 1), part(2, 0, 1, 2)];
/// 4:2:0: two strips of luma, and one with both chroma components.
const HALVED: [Part; 6] = [
    part(0, 0, 2, 0),
    part(0, 1, 2, 0),
    part(1, 0, 2, 0),
    part(1, 1, 2, 0),
    part(2, 0, 1, 1),
    part(2, BLOCKS / 2, 1, 2),
];

/// Pixels, with the last ones repeated beyond the edges.
struct View<'a> {
    rgb: &'a [u8],
    width: usize,
    height: usize,
}

impl View<'_> {
    /// Fills strips for [`FULL`].
    #[inline(always)]
    fn full<V: Lanes>(&self, left: usize, top: usize, strips: &mut [Samples; 3]) {
        let [y, cb, cr] = strips;
        for (row, ((y, cb), cr)) in y.iter_mut().zip(cb).zip(cr).enumerate() {
            self.row::<V>(left, top + row, y, cb, cr);
        }
    }

    /// Fills strips for [`HALVED`]; chroma is the mean of four pixels.
    #[inline(always)]
    fn halved<V: Lanes>(&self, left: usize, top: usize, strips: &mut [Samples; 3]) {
        let [above, below, chroma] = strips;
        let mut luma = above.iter_mut().chain(below);
        let mut pair = [[[0; ACROSS]; 2]; 2];
        for (row, out) in chroma.iter_mut().enumerate() {
            for (n, y) in luma.by_ref().take(2).enumerate() {
                let [cb, cr] = &mut pair;
                self.row::<V>(left, top + 2 * row + n, y, &mut cb[n], &mut cr[n]);
            }
            for (out, [upper, lower]) in out.chunks_exact_mut(ACROSS / 2).zip(&pair) {
                for (n, out) in out.iter_mut().enumerate() {
                    let sum = upper[2 * n] + upper[2 * n + 1] + lower[2 * n] + lower[2 * n + 1];
                    *out = (sum + 2) >> 2;
                }
            }
        }
    }

    #[inline(always)]
    fn row<V: Lanes>(
        &self,
        left: usize,
        row: usize,
        y: &mut [i16; ACROSS],
        cb: &mut [i16; ACROSS],
        cr: &mut [i16; ACROSS],
    ) {
        let row = &self.rgb[3 * self.width * row.min(self.height - 1)..][..3 * self.width];
        let pixels = &row[3 * left..];
        if let Some(pixels) = pixels.first_chunk() {
            convert::<V>(pixels, y, cb, cr);
        } else {
            let (pixels, _) = pixels.as_chunks::<3>();
            let last = pixels.len() - 1;
            let padded: [[u8; 3]; ACROSS] = std::array::from_fn(|n| pixels[n.min(last)]);
            convert::<V>(padded.as_flattened().first_chunk().expect("as long"), y, cb, cr);
        }
    }
}
