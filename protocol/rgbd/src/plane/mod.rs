//! Entropy-coded planes: depth in its small mode, alpha, and each channel of lossless colour. Budget: 2 to 3 ms each
//! for encoding and decoding a plane of 640x480 on one core. The latency from one pixel to the next is the bottleneck;
//! four stripes are processed in parallel to hide it.
//!
//! 1. **Stripes.** The plane is divided into 4 stripes of columns, each with its own coder state. They advance
//!    together, 16 columns (a run) at a time.
//! 2. **Runs.** A symbol encodes whether all pixels of a run are as predicted, coded, invalid, or mixed. Its context is
//!    the runs to the left and above. The mask of a mixed run follows as four symbols. So flat areas need very few
//!    bits, and masks only where validity changes.
//! 3. **Prediction.** By the median edge detector, or by the mean of left and above. The encoder selects the one with
//!    smaller residuals in a sample of the rows (the mean for noisy planes). Invalid pixels are replaced by their
//!    prediction, so that pixels beyond a hole are predicted well.
//! 4. **Symbols.** Zig-zagged residuals up to 7 are symbols. Larger ones have a symbol for their bit length, and raw
//!    bits. Frequencies adapt, in contexts by the roughness of the neighbourhood.
//!
//! Bytes: predictor, base of each stripe, then [`rans`]. Encoder and decoder use the same function to walk the pixels,
//! so their models cannot differ.

mod cdf;
mod rans;

use cdf::{Cdf, SYMBOLS};
use rans::{Coder, LANES, SymbolReader, SymbolWriter};

use crate::depth::predict::{med, unzigzag, zigzag};

/// Kind of samples in a plane.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Samples {
    /// 0 to 255; residuals wrap at 256.
    Bytes,
    /// 0 to 65535; 0 is invalid.
    Masked,
}

/// Encodes planes. Owns the scratch memory.
#[derive(Clone, Debug, Default)]
pub(crate) struct PlaneEncoder {
    walk: Walk,
    symbols: SymbolWriter,
}

impl PlaneEncoder {
    /// Appends the encoding of a row-major plane to `out`.
    pub(crate) fn encode(
        &mut self,
        samples: &[u16],
        width: usize,
        kind: Samples,
        out: &mut Vec<u8>,
    ) {
        assert!(width > 0 && !samples.is_empty() && samples.len().is_multiple_of(width));
        let stripe = stripe_columns(width);
        let bases: [u16; LANES] = std::array::from_fn(|lane| {
            let row = &samples[(lane * stripe).min(width)..((lane + 1) * stripe).min(width)];
            // The base of a masked stripe is its first return, if there is one.
            let first = row.iter().find(|&&sample| sample > 0 || kind == Samples::Bytes);
            first.copied().unwrap_or(0)
        });
        let mean = mean_is_better(samples, width, kind);
        out.push(u8::from(mean));
        out.extend(bases.iter().flat_map(|base| base.to_le_bytes()));
        // At most 3 + 15 raw bits per pixel.
        self.symbols.start(18 * samples.len());
        let end = Giving { symbols: &mut self.symbols, samples };
        self.walk.run(end, width, samples.len() / width, kind, mean, bases);
        self.symbols.finish(out);
    }
}

/// Decodes planes. Owns the scratch memory.
#[derive(Clone, Debug, Default)]
pub(crate) struct PlaneDecoder {
    walk: Walk,
}

impl PlaneDecoder {
    /// Decodes to a row-major plane; `None` if the bytes are damaged.
    pub(crate) fn decode(
        &mut self,
        bytes: &[u8],
        width: usize,
        kind: Samples,
        samples: &mut [u16],
    ) -> Option<()> {
        assert!(width > 0 && !samples.is_empty() && samples.len().is_multiple_of(width));
        let (&[mean, ref bases @ ..], rest) = bytes.split_first_chunk::<{ 1 + 2 * LANES }>()?;
        if mean > 1 {
            return None;
        }
        let bases =
            std::array::from_fn(|lane| u16::from_le_bytes([bases[2 * lane], bases[2 * lane + 1]]));
        let rows = samples.len() / width;
        let mut symbols = SymbolReader::new(rest)?;
        let end = Taking { symbols: &mut symbols, samples };
        self.walk.run(end, width, rows, kind, mean == 1, bases);
        symbols.is_finished().then_some(())
    }
}

/// Direction of the walk: encoding or decoding.
trait End {
    type Coder: Coder;
    /// Whether the samples are known in advance, as in the encoder.
    const KNOWS: bool;
    fn coder(&mut self) -> &mut Self::Coder;
    /// Copies samples to `run`, in the encoder.
    fn know(&self, at: usize, run: &mut [u16]);
    /// Stores samples of `run`, in the decoder.
    fn put(&mut self, at: usize, run: &[u16]);
}

struct Giving<'a> {
    symbols: &'a mut SymbolWriter,
    samples: &'a [u16],
}

impl End for Giving<'_> {
    type Coder = SymbolWriter;
    const KNOWS: bool = true;
    #[inline(always)]
    fn coder(&mut self) -> &mut SymbolWriter {
        self.symbols
    }
    #[inline(always)]
    fn know(&self, at: usize, run: &mut [u16]) {
        run.copy_from_slice(&self.samples[at..at + run.len()]);
    }
    #[inline(always)]
    fn put(&mut self, _: usize, _: &[u16]) {}
}

struct Taking<'a, 'b> {
    symbols: &'a mut SymbolReader<'b>,
    samples: &'a mut [u16],
}

impl<'b> End for Taking<'_, 'b> {
    type Coder = SymbolReader<'b>;
    const KNOWS: bool = false;
    #[inline(always)]
    fn coder(&mut self) -> &mut SymbolReader<'b> {
        self.symbols
    }
    #[inline(always)]
    fn know(&self, _: usize, _: &mut [u16]) {}
    #[inline(always)]
    fn put(&mut self, at: usize, run: &[u16]) {
        self.samples[at..at + run.len()].copy_from_slice(run);
    }
}

/// Kind of a run of pixels.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Run {
    /// All pixels are valid and as predicted.
    Flat = 0,
    /// All pixels are valid.
    Coded = 1,
    /// All pixels are invalid.
    Invalid = 2,
    /// Some pixels are valid.
    Mixed = 3,
}

/// Model and its walk over the pixels.
#[derive(Clone, Debug)]
struct Walk {
    /// Row above, overwritten by the present row; per lane, with one extra column for the upper right.
    row: Vec<u16>,
    /// Kinds of the runs above, per lane.
    runs: Vec<u8>,
    /// Frequencies of residuals, of run kinds, and of quarters of masks.
    residuals: [Cdf; ROUGHNESSES],
    run_kinds: [Cdf; 16],
    masks: [Cdf; 16],
}

impl Default for Walk {
    fn default() -> Self {
        Self {
            row: Vec::new(),
            runs: Vec::new(),
            residuals: [Cdf::even(SYMBOLS); ROUGHNESSES],
            run_kinds: [Cdf::even(4); 16],
            masks: [Cdf::even(SYMBOLS); 16],
        }
    }
}

/// Position of a lane in its row, and its present run.
#[derive(Clone, Copy, Default)]
struct Lane {
    /// First column of the stripe, and number of columns.
    first: usize,
    columns: usize,
    left: u16,
    corner: u16,
    left_run: u8,
    /// Masks of valid pixels and of pixels with coded residuals.
    valid: u16,
    coded: u16,
    /// Row above the run including its upper right; overwritten by the run, with holes filled.
    row: [u16; RUN + 1],
    /// Samples of the run: input of the encoder, output of the decoder.
    samples: [u16; RUN],
}

impl Walk {
    fn run(
        &mut self,
        end: impl End,
        width: usize,
        rows: usize,
        kind: Samples,
        mean: bool,
        bases: [u16; LANES],
    ) {
        let stripe = stripe_columns(width);
        self.row.clear();
        for base in bases {
            self.row.resize(self.row.len() + stripe + 1, base);
        }
        self.runs.clear();
        self.runs.resize(LANES * stripe / RUN, Run::Coded as u8);
        self.residuals.fill(Cdf::even(SYMBOLS));
        self.run_kinds.fill(Cdf::even(4));
        self.masks.fill(Cdf::even(SYMBOLS));
        match (kind, mean) {
            (Samples::Bytes, false) => self.rows::<_, 8, false>(end, width, rows),
            (Samples::Bytes, true) => self.rows::<_, 8, true>(end, width, rows),
            (Samples::Masked, false) => self.rows::<_, 16, false>(end, width, rows),
            (Samples::Masked, true) => self.rows::<_, 16, true>(end, width, rows),
        }
    }

    fn rows<E: End, const BITS: u32, const MEAN: bool>(
        &mut self,
        mut end: E,
        width: usize,
        rows: usize,
    ) {
        let stripe = stripe_columns(width);
        let mut lanes: [Lane; LANES] = std::array::from_fn(|lane| {
            let first = lane * stripe;
            Lane { first, columns: width.saturating_sub(first).min(stripe), ..Lane::default() }
        });
        for y in 0..rows {
            for (n, lane) in lanes.iter_mut().enumerate() {
                // The first pixel is predicted from the one above: left and corner get the same value.
                let above = self.row[n * (stripe + 1)];
                (lane.left, lane.corner, lane.left_run) = (above, above, Run::Coded as u8);
            }
            for start in (0..lanes[0].columns).step_by(RUN) {
                for (n, lane) in lanes.iter_mut().enumerate() {
                    if start < lane.columns {
                        let columns = RUN.min(lane.columns - start);
                        let at = n * (stripe + 1) + start;
                        lane.row[..=columns].copy_from_slice(&self.row[at..=at + columns]);
                        end.know(y * width + lane.first + start, &mut lane.samples[..columns]);
                        let above = &mut self.runs[(n * stripe + start) / RUN];
                        let run = self.run_kinds[usize::from(lane.left_run * 4 + *above) % 16..]
                            .first_mut();
                        if let Some(kinds) = run {
                            *above = begin_run::<E, BITS, MEAN>(
                                &mut end,
                                n,
                                lane,
                                columns,
                                kinds,
                                &mut self.masks,
                            ) as u8;
                        }
                        lane.left_run = *above;
                    } else {
                        (lane.valid, lane.coded) = (0, 0);
                    }
                }
                let any_coded = lanes.iter().fold(0, |all, lane| all | lane.coded) != 0;
                for column in 0..RUN {
                    for (n, lane) in lanes.iter_mut().enumerate() {
                        if any_coded {
                            pixel::<E, BITS, MEAN>(
                                end.coder(),
                                n,
                                lane,
                                column,
                                &mut self.residuals,
                            );
                        } else {
                            predicted_pixel::<BITS, MEAN>(lane, column);
                        }
                    }
                }
                for (n, lane) in lanes.iter().enumerate() {
                    if start < lane.columns {
                        let columns = RUN.min(lane.columns - start);
                        let at = n * (stripe + 1) + start;
                        self.row[at..at + columns].copy_from_slice(&lane.row[..columns]);
                        end.put(y * width + lane.first + start, &lane.samples[..columns]);
                    }
                }
            }
            for (n, lane) in lanes.iter().enumerate() {
                if lane.columns > 0 {
                    let last = n * (stripe + 1) + lane.columns;
                    self.row[last] = self.row[last - 1];
                }
            }
        }
    }
}

/// Codes the kind of the run, and its mask.
#[inline(always)]
fn begin_run<E: End, const BITS: u32, const MEAN: bool>(
    end: &mut E,
    n: usize,
    lane: &mut Lane,
    columns: usize,
    kinds: &mut Cdf,
    masks: &mut [Cdf; 16],
) -> Run {
    let all = u16::MAX >> (RUN - columns);
    let (mut run, mut valid) = (Run::Coded, all);
    if E::KNOWS {
        if BITS == 16 {
            valid = 0;
            for (column, &sample) in lane.samples.iter().enumerate() {
                valid |= u16::from(sample != 0) << column;
            }
            valid &= all;
        }
        run = if valid == all {
            let (mut left, mut corner) = (lane.left, lane.corner);
            let flat = lane.row[..columns].iter().zip(&lane.samples).all(|(&up, &sample)| {
                let predicted = predict::<MEAN>(left, up, corner);
                (left, corner) = (sample, up);
                predicted == sample
            });
            if flat { Run::Flat } else { Run::Coded }
        } else if valid == 0 {
            Run::Invalid
        } else {
            Run::Mixed
        };
    }
    // A decoder may get any of 16 symbols from damaged bytes.
    run = match end.coder().symbol(n, kinds, run as usize) {
        0 => Run::Flat,
        2 if BITS == 16 => Run::Invalid,
        3 if BITS == 16 => Run::Mixed,
        _ => Run::Coded,
    };
    (lane.valid, lane.coded) = match run {
        Run::Flat => (all, 0),
        Run::Coded => (all, all),
        Run::Invalid => (0, 0),
        Run::Mixed => {
            let (mut mask, mut before) = (0, 0);
            for quarter in 0..4 {
                let bits = usize::from(valid >> (4 * quarter) & 15);
                // Context: the quarter, and whether the previous pixel was valid.
                let context = &mut masks[(before >> 3 & 1) << 2 | quarter];
                before = end.coder().symbol(n, context, bits);
                mask |= (before as u16 & 15) << (4 * quarter);
            }
            (mask & all, mask & all)
        }
    };
    run
}

/// Codes a pixel.
#[inline(always)]
fn pixel<E: End, const BITS: u32, const MEAN: bool>(
    coder: &mut E::Coder,
    n: usize,
    lane: &mut Lane,
    column: usize,
    residuals: &mut [Cdf; ROUGHNESSES],
) {
    if lane.coded >> column & 1 == 0 {
        return predicted_pixel::<BITS, MEAN>(lane, column);
    }
    let (up, upper_right) = (lane.row[column % RUN], lane.row[column % RUN + 1]);
    let predicted = predict::<MEAN>(lane.left, up, lane.corner);
    let rough = u32::from(lane.left.abs_diff(lane.corner))
        + u32::from(up.abs_diff(lane.corner))
        + u32::from(up.abs_diff(upper_right));
    let context = &mut residuals[roughness(rough)];
    let known = lane.samples[column % RUN];
    let residual = if E::KNOWS { known.wrapping_sub(predicted) } else { 0 };
    let wanted = u32::from(zigzag(residual << (16 - BITS)) >> (16 - BITS));
    let code = code_number(coder, n, context, wanted);
    let sample = predicted.wrapping_add(unzigzag(code as u16)) & (u16::MAX >> (16 - BITS));
    lane.samples[column % RUN] = sample;
    lane.row[column % RUN] = sample;
    (lane.corner, lane.left) = (up, sample);
}

/// Processes a pixel that is as predicted, or invalid.
#[inline(always)]
fn predicted_pixel<const BITS: u32, const MEAN: bool>(lane: &mut Lane, column: usize) {
    let up = lane.row[column % RUN];
    let predicted = predict::<MEAN>(lane.left, up, lane.corner) & (u16::MAX >> (16 - BITS));
    let valid = lane.valid >> column & 1 == 1;
    lane.samples[column % RUN] = if valid { predicted } else { 0 };
    lane.row[column % RUN] = predicted;
    (lane.corner, lane.left) = (up, predicted);
}

/// Codes a zig-zagged residual.
#[inline(always)]
fn code_number(coder: &mut impl Coder, lane: usize, context: &mut Cdf, wanted: u32) -> u32 {
    let length = u32::BITS - wanted.leading_zeros();
    let symbol = if wanted < 8 { wanted } else { (length + 4).min(LONG) };
    let symbol = coder.symbol(lane, context, symbol as usize) % SYMBOLS;
    if symbol == LONG as usize {
        return code_long_number(coder, wanted);
    }
    // Without a branch, because half the residuals of a rough image take either direction.
    let (first, bits) = NUMBERS[symbol];
    first + coder.raw(wanted.wrapping_sub(first) & ((1 << bits) - 1), bits)
}

/// Codes a number with at least 11 bits.
#[cold]
fn code_long_number(coder: &mut impl Coder, wanted: u32) -> u32 {
    let length = u32::BITS - wanted.leading_zeros();
    // Lengths above 16 occur only in damaged bytes; reading their bits is harmless.
    let length = (11 + coder.raw(length.wrapping_sub(11) & 7, 3)).min(16);
    let low = length - 1;
    1 << low | coder.raw(wanted & ((1 << low) - 1), low)
}

/// Symbol of numbers with at least 11 bits.
const LONG: u32 = 15;
/// First number of each symbol, and its number of raw bits: single numbers from 0 to 7, then by bit length.
const NUMBERS: [(u32, u32); SYMBOLS] = {
    let mut numbers = [(0, 0); SYMBOLS];
    let mut symbol = 0;
    while symbol < SYMBOLS {
        numbers[symbol] =
            if symbol < 8 { (symbol as u32, 0) } else { (1 << (symbol - 5), symbol as u32 - 5) };
        symbol += 1;
    }
    numbers
};

/// Returns the prediction of a pixel.
#[inline(always)]
fn predict<const MEAN: bool>(left: u16, up: u16, corner: u16) -> u16 {
    if MEAN {
        // The samples have at most 16 bits.
        u32::midpoint(u32::from(left), u32::from(up)) as u16
    } else {
        med(left, up, corner)
    }
}

/// Returns the context of a roughness, in half octaves.
#[inline(always)]
fn roughness(rough: u32) -> usize {
    let length = u32::BITS - rough.leading_zeros();
    let context = if length > 3 { 2 * length - 3 + (rough >> (length - 2) & 1) } else { length };
    (context as usize).min(ROUGHNESSES - 1)
}

/// Returns whether the mean of left and above predicts this plane better than the median edge detector. Compares the
/// bit lengths of the residuals in every eighth row.
fn mean_is_better(samples: &[u16], width: usize, kind: Samples) -> bool {
    let (mut med_bits, mut mean_bits) = (0u32, 0u32);
    let length = |sample: u16, predicted: u16| {
        let residual = sample.wrapping_sub(predicted);
        let shift = if kind == Samples::Bytes { 8 } else { 0 };
        u16::BITS - (zigzag(residual << shift) >> shift).leading_zeros()
    };
    for y in (1..samples.len() / width).step_by(8) {
        let (above, row) = samples[(y - 1) * width..(y + 1) * width].split_at(width);
        for (row, above) in row.windows(2).zip(above.windows(2)) {
            if kind == Samples::Masked && [row[0], row[1], above[0], above[1]].contains(&0) {
                continue;
            }
            med_bits += length(row[1], predict::<false>(row[0], above[1], above[0]));
            mean_bits += length(row[1], predict::<true>(row[0], above[1], above[0]));
        }
    }
    mean_bits < med_bits
}

fn stripe_columns(width: usize) -> usize {
    width.div_ceil(LANES).next_multiple_of(RUN)
}

/// Number of pixels in a run.
const RUN: usize = 16;
/// Number of contexts of residuals.
const ROUGHNESSES: usize = 24;

#[cfg(test)]
mod tests;
