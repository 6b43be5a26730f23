//! Conversion of pixels to quantised coefficients, 32 pixels of 8 rows at a time.
//!
//! All values have 16 bits. Samples have 3 fractional bits and coefficients 5, which limits losses before quantisation.
//! The error of the transform is below 0.04 rms (checked by a test); a colour conversion to integers would already
//! cause 0.29.

use super::lanes::Lanes;

/// Number of pixels side by side.
pub(super) const ACROSS: usize = 32;
/// Number of blocks side by side.
pub(super) const BLOCKS: usize = ACROSS / 8;
/// Samples of blocks side by side, row by row. [1/8]
pub(super) type Samples = [[i16; ACROSS]; 8];

/// Converts a number below 1 to units of 2^-15.
const fn fixed(value: f64) -> i16 {
    (value * 32768.0 + 0.5) as i16
}

/// Converts 32 pixels to `YCbCr` (ITU-T T.871), shifted to be centred on 0. [1/8]
#[inline(always)]
pub(super) fn convert<V: Lanes>(
    rgb: &[u8; 3 * ACROSS],
    y_out: &mut [i16; ACROSS],
    cb_out: &mut [i16; ACROSS],
    cr_out: &mut [i16; ACROSS],
) {
    // In units of 1/128, so that 255 fits below the sign bit.
    let mut planes = [[0i16; ACROSS]; 3];
    let [r, g, b] = &mut planes;
    for (((pixel, r), g), b) in rgb.as_chunks::<3>().0.iter().zip(r).zip(g).zip(b) {
        *r = i16::from(pixel[0]) << 7;
        *g = i16::from(pixel[1]) << 7;
        *b = i16::from(pixel[2]) << 7;
    }
    let half = V::all(8);
    for at in (0..ACROSS).step_by(8 * V::BLOCKS) {
        let [r, g, b] = planes.each_ref().map(|plane| V::load(&plane[at..]));
        let y = r.times(V::all(fixed(0.299)));
        let y = y.add(g.times(V::all(fixed(0.587)))).add(b.times(V::all(fixed(0.114))));
        let cb = b.sub(y).times(V::all(fixed(0.5 / (1.0 - 0.114))));
        let cr = r.sub(y).times(V::all(fixed(0.5 / (1.0 - 0.299))));
        y.add(V::all(8 - (128 << 7))).down_signed::<4>().store(&mut y_out[at..]);
        cb.add(half).down_signed::<4>().store(&mut cb_out[at..]);
        cr.add(half).down_signed::<4>().store(&mut cr_out[at..]);
    }
}

/// Two successive factors for the magnitudes of coefficients, row by row of their horizontal frequency, as the
/// transform returns them.
#[derive(Clone, Debug)]
pub(super) struct Quantiser([[[i16; 8]; 8]; 2]);

impl Quantiser {
    /// Makes a quantiser from divisors, row by row of their vertical frequency.
    pub(super) fn new(divisors: &[u8; 64]) -> Self {
        let mut tables = [[[0; 8]; 8]; 2];
        for (at, &divisor) in divisors.iter().enumerate() {
            let (first, second) = factors(divisor);
            tables[0][at % 8][at / 8] = first.cast_signed();
            tables[1][at % 8][at / 8] = second;
        }
        Self(tables)
    }
}

/// Returns x and y such that floor(n x / 2^16) y / 2^15 equals n / 32 d for n up to 2^15, with both rounded to the
/// nearest, halves up.
///
/// With 2^s as the greatest power of two below 32 d, y is 2^(15 - s), so the second product is a rounding shift by s. x
/// is 2^(16 + s) / 32 d rounded up, so it is too large by less than 1. This adds less than n / 2^(16 + s) to the
/// quotient, at most 1 / 32 d, which does not change the rounding of a multiple of 1 / 32 d.
pub(super) fn factors(divisor: u8) -> (u16, i16) {
    let divisor = 32 * u32::from(divisor);
    let s = (divisor - 1).ilog2();
    ((1u32 << (16 + s)).div_ceil(divisor) as u16, 1 << (15 - s))
}

/// Quantised coefficients of blocks side by side. Rows are horizontal frequencies; the 8 lanes of a block are vertical
/// frequencies.
pub(super) struct Coefficients {
    /// Magnitudes, with 24 extra lanes, so that the window of every block is complete.
    pub(super) magnitudes: [i16; 8 * ACROSS + 24],
    /// Bits that distinguish a number from others of its category (T.81, F.1.2.1.1), multiplied by 32.
    pub(super) bits: [i16; 8 * ACROSS + 24],
    /// Masks of nonzero coefficients: one byte per horizontal frequency and block.
    pub(super) nonzero: [[u8; BLOCKS]; 8],
}

impl Coefficients {
    pub(super) const fn new() -> Self {
        let lanes = [0; 8 * ACROSS + 24];
        Self { magnitudes: lanes, bits: lanes, nonzero: [[0; BLOCKS]; 8] }
    }

    /// Returns magnitudes and bits, starting with a block.
    #[inline(always)]
    pub(super) fn of_block(&self, block: usize) -> (&[i16; 8 * ACROSS], &[i16; 8 * ACROSS]) {
        let from = 8 * block;
        let (magnitudes, bits) = (&self.magnitudes[from..], &self.bits[from..]);
        (magnitudes.first_chunk().expect("whole"), bits.first_chunk().expect("whole"))
    }
}

/// Transforms and quantises blocks side by side.
#[inline(always)]
pub(super) fn transform<V: Lanes>(
    samples: &Samples,
    quantiser: &Quantiser,
    out: &mut Coefficients,
) {
    for block in (0..BLOCKS).step_by(V::BLOCKS) {
        let at = 8 * block;
        let rows = samples.each_ref().map(|row| V::load(&row[at..]));
        for (u, row) in frequencies(rows).into_iter().enumerate() {
            let [x, y] = quantiser.0.each_ref().map(|rows| V::every_block(&rows[u]));
            let magnitude = row.abs().times_unsigned(x).times(y);
            // Sets all bits below the highest one, for numbers of up to 11 bits.
            let ones = magnitude.or(magnitude.down::<1>());
            let ones = ones.or(ones.down::<2>());
            let ones = ones.or(ones.down::<4>());
            let ones = ones.or(ones.down::<8>());
            let bits = magnitude.xor(ones.and(row.down_signed::<15>()));
            magnitude.store(&mut out.magnitudes[ACROSS * u + at..]);
            bits.up::<5>().store(&mut out.bits[ACROSS * u + at..]);
            let nonzero = magnitude.positive();
            out.nonzero[u][block..block + V::BLOCKS].copy_from_slice(&nonzero[..V::BLOCKS]);
        }
    }
}

/// Returns the coefficients of blocks: rows of samples in, rows of horizontal frequencies out. [1/32]
#[inline(always)]
pub(super) fn frequencies<V: Lanes>(rows: [V; 8]) -> [V; 8] {
    columns::<V, true>(transpose(columns::<V, false>(rows)))
}

/// Discrete cosine transform of all columns, multiplied by the square root of 8, or half of that.
///
/// The even half is the usual one. In the odd half, a and b are the differences 0 and 3 rotated by 3 pi/16, e and g are
/// 1 and 2 rotated by pi/16. Then a + g and b + e give coefficients 1 and 7, a - g and b - e give 3 and 5 (Loeffler,
/// Ligtenberg, Moschytz, ICASSP 1989).
///
/// Samples are within 2^10 [1/8]. So results are within 2^13 after the first pass, and within 2^15 after the second,
/// halved one. -2^15 occurs only if all samples are -2^10.
#[inline(always)]
fn columns<V: Lanes, const HALVED: bool>(rows: [V; 8]) -> [V; 8] {
    let times = |row: V, factor: f64| row.times(V::all(fixed(factor)));
    let rotated = |a: V, b: V, cos: f64, sin: f64| {
        let (cos, sin) = if HALVED { (cos / 2.0, sin / 2.0) } else { (cos, sin) };
        (times(a, cos).sub(times(b, sin)), times(a, sin).add(times(b, cos)))
    };
    let [s0, s1, s2, s3] = [0, 1, 2, 3].map(|n| rows[n].add(rows[7 - n]));
    let [d0, d1, d2, d3] = [0, 1, 2, 3].map(|n| rows[n].sub(rows[7 - n]));

    let (mut outer, mut inner) = (s0.add(s3), s1.add(s2));
    let (outer_difference, inner_difference) = (s0.sub(s3), s1.sub(s2));
    let (y2, y6);
    if HALVED {
        (outer, inner) = (times(outer, 0.5), times(inner, 0.5));
        // sqrt(2) cos and sin of pi/8, halved.
        y2 = times(outer_difference, 0.653_281_482).add(times(inner_difference, 0.270_598_050));
        y6 = times(outer_difference, 0.270_598_050).sub(times(inner_difference, 0.653_281_482));
    } else {
        let beyond_one = |row: V| row.add(times(row, 0.306_562_965));
        y2 = beyond_one(outer_difference).add(times(inner_difference, 0.541_196_100));
        y6 = times(outer_difference, 0.541_196_100).sub(beyond_one(inner_difference));
    }

    let (a, b) = rotated(d0, d3, 0.831_469_612, 0.555_570_233);
    let (e, g) = rotated(d1, d2, 0.980_785_280, 0.195_090_322);
    let (first, last) = (a.add(g), b.add(e));
    let root_2 = |row: V| row.add(times(row, 0.414_213_562));
    [
        outer.add(inner),
        first.add(last),
        y2,
        root_2(a.sub(g)),
        outer.sub(inner),
        root_2(b.sub(e)),
        y6,
        first.sub(last),
    ]
}

/// Transposes each block: each of the three turns moves one bit of the row's number to the lane's.
#[inline(always)]
fn transpose<V: Lanes>(mut rows: [V; 8]) -> [V; 8] {
    for _ in 0..3 {
        let zipped = [0, 1, 2, 3].map(|n| rows[n].zip(rows[n + 4]));
        let [(a, b), (c, d), (e, f), (g, h)] = zipped;
        rows = [a, b, c, d, e, f, g, h];
    }
    rows
}
