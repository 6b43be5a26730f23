//! Conversion of coefficients to pixels: dequantisation, inverse DCT, upsampling, colour conversion.
//!
//! Along rows, the inverse DCT is the sum of basis functions of the nonzero coefficients. Most coefficients are zero,
//! and an addition runs in parallel to the look-up of the next code. Along columns, it is the fast algorithm, for eight
//! columns at once.
//!
//! Products and sums are rounded separately on every machine, so pixels are identical everywhere.

use super::super::jpeg::ZIGZAG;

/// A row of eight values.
#[derive(Clone, Copy, Debug)]
#[repr(align(32))]
pub(super) struct Lanes(pub(super) [f32; 8]);

/// Basis functions by coefficient in zigzag order: values of one quantisation step along a row, scaled for [`samples`].
#[derive(Debug)]
pub(super) struct Basis([Lanes; 64]);

impl Basis {
    /// Makes the basis for these quantisation steps, in zigzag order.
    pub(super) fn new(steps: &[u8; 64]) -> Self {
        let mut basis = [Lanes([0.0; 8]); 64];
        for ((lanes, &step), &at) in basis.iter_mut().zip(steps).zip(&ZIGZAG) {
            let (v, u) = (usize::from(at / 8), usize::from(at % 8));
            let scale = f64::from(step) * weight(u) * weight(v) / 8.0;
            for (x, lane) in lanes.0.iter_mut().enumerate() {
                *lane = (scale * cosine((2 * x + 1) * u)) as f32;
            }
            // The column algorithm expects its input multiplied by the cosine of its frequency.
            if v > 0 {
                lanes.0 = lanes.0.map(|lane| (f64::from(lane) * cosine(v)) as f32);
            }
        }
        Self(basis)
    }

    /// Returns the rows of a block with only a DC coefficient.
    #[inline(always)]
    pub(super) fn start(&self, dc: i32) -> [Lanes; 8] {
        let mut rows = [Lanes([0.0; 8]); 8];
        // Samples are shifted by half their range (T.81, A.3.1).
        rows[0] = Lanes([dc as f32 * self.0[0].0[0] + 128.0; 8]);
        rows
    }

    /// Adds a coefficient to the rows of its block.
    #[inline(always)]
    pub(super) fn add(&self, rows: &mut [Lanes; 8], zigzag: usize, number: i32) {
        let number = number as f32;
        let row = &mut rows[usize::from(ZIGZAG[zigzag] / 8)];
        for (lane, basis) in row.0.iter_mut().zip(&self.0[zigzag].0) {
            *lane += number * basis;
        }
    }
}

/// Returns the weight of a frequency (T.81, A.3.3), multiplied by the square root of 2.
fn weight(frequency: usize) -> f64 {
    if frequency == 0 { 1.0 } else { core::f64::consts::SQRT_2 }
}

/// Returns the cosine of a number of sixteenths of pi.
fn cosine(sixteenths: usize) -> f64 {
    match sixteenths % 32 {
        n @ 0..=8 => COSINES[n],
        n @ 9..=16 => -COSINES[16 - n],
        n @ 17..=24 => -COSINES[n - 16],
        n => COSINES[32 - n],
    }
}

/// Cosines by sixteenths of pi. Constants, because cosine functions round differently on different machines.
const COSINES: [f64; 9] = [
    1.0,
    0.9807852804032304,
    0.9238795325112867,
    0.8314696123025452,
    core::f64::consts::FRAC_1_SQRT_2,
    0.5555702330196022,
    0.3826834323650898,
    0.19509032201612828,
    0.0,
];

/// Samples from 0 to 255, in sixteenths. Rounding them to integers would cause colour errors of two and more.
pub(super) type Sample = u16;

/// Transforms the columns (Arai, Agui and Nakajima, Trans. IEICE E71, 1988) and returns the samples, row by row.
#[inline(always)]
pub(super) fn samples(rows: &[Lanes; 8]) -> [[Sample; 8]; 8] {
    const C4: f32 = core::f32::consts::SQRT_2;
    const C2: f32 = (2.0 * COSINES[2]) as f32;
    const C2_LESS_C6: f32 = (2.0 * (COSINES[2] - COSINES[6])) as f32;
    const C2_AND_C6: f32 = (2.0 * (COSINES[2] + COSINES[6])) as f32;
    // Adding this to a float makes its low bits count sixteenths.
    const ROUND: f32 = 786_432.0;
    let mut out = [[0; 8]; 8];
    for x in 0..8 {
        let [s0, s1, s2, s3, s4, s5, s6, s7] = rows.each_ref().map(|row| row.0[x]);
        let (sum, difference) = (s0 + s4, s0 - s4);
        let inner = s2 + s6;
        let outer = (s2 - s6) * C4 - inner;
        let even = [sum + inner, difference + outer, difference - outer, sum - inner];

        let (a, b) = (s5 + s3, s5 - s3);
        let (c, d) = (s1 + s7, s1 - s7);
        let both = (b + d) * C2;
        let odd0 = c + a;
        let odd1 = both - b * C2_AND_C6 - odd0;
        let odd2 = (c - a) * C4 - odd1;
        let odd3 = both - d * C2_LESS_C6 - odd2;
        let odd = [odd0, odd1, odd2, odd3];
        for y in 0..4 {
            for (y, value) in [(y, even[y] + odd[y]), (7 - y, even[y] - odd[y])] {
                // Not `clamp`, which also handles NaN.
                let value = if value > 0.0 { value } else { 0.0 };
                let value = if value < 255.0 { value } else { 255.0 };
                out[y][x] = (value + ROUND).to_bits() as Sample;
            }
        }
    }
    out
}

/// Doubles a row of chroma in both directions. A pixel is the weighted mean of the sample at its place (weight 9), the
/// nearest horizontal and vertical neighbours (3 each) and the diagonal one (1). `far` is the nearest row above or below;
/// `sums` has space for the length of a row plus two.
#[inline(always)]
pub(super) fn double_row(near: &[Sample], far: &[Sample], sums: &mut [u16], out: &mut [Sample]) {
    let sums = &mut sums[..near.len() + 2];
    for ((sum, &near), &far) in sums[1..].iter_mut().zip(near).zip(far) {
        *sum = 3 * near + far;
    }
    sums[0] = sums[1];
    sums[near.len() + 1] = sums[near.len()];
    let (before, own, after) = (&sums[..near.len()], &sums[1..], &sums[2..]);
    let pairs = out.as_chunks_mut::<2>().0;
    for (((pair, before), own), after) in pairs.iter_mut().zip(before).zip(own).zip(after) {
        *pair = [(3 * own + before + 8) >> 4, (3 * own + after + 7) >> 4];
    }
}

/// Number of pixels whose colours are computed together and then interleaved.
pub(super) const GROUP: usize = 32;

/// Converts a row to RGB (ITU-T T.871, 7). The sample rows are padded to whole groups.
#[inline(always)]
pub(super) fn color_row(luma: &[Sample], cb: &[Sample], cr: &[Sample], rgb_out: &mut [u8]) {
    let samples = [luma, cb, cr].map(|row| row.as_chunks::<GROUP>().0);
    let (groups, rest) = rgb_out.as_chunks_mut::<{ 3 * GROUP }>();
    let (last, rest) = (groups.len(), rest);
    for (at, out) in groups.iter_mut().enumerate() {
        color_group(samples.map(|row| &row[at]), out);
    }
    if !rest.is_empty() {
        let mut out = [0; 3 * GROUP];
        color_group(samples.map(|row| &row[last]), &mut out);
        rest.copy_from_slice(&out[..rest.len()]);
    }
}

#[inline(always)]
fn color_group([luma, cb, cr]: [&[Sample; GROUP]; 3], out: &mut [u8; 3 * GROUP]) {
    let (mut red, mut green, mut blue) = ([0; GROUP], [0; GROUP], [0; GROUP]);
    for x in 0..GROUP {
        let (y, cb, cr) = (luma[x] as i16 + 8, cb[x] as i16 - 16 * 128, cr[x] as i16 - 16 * 128);
        // 1.402, 1.772, -0.344136 and -0.714136, without their integer parts, so that the factors have 16 bits.
        let part = |c: i16, factor: i32| ((i32::from(c) * factor) >> 16) as i16;
        let byte = |value: i16| (value >> 4).clamp(0, 255) as u8;
        red[x] = byte(y + cr + part(cr, 26_345));
        green[x] = byte(y - cr + part(cr, 18_734) - part(cb, 22_554));
        blue[x] = byte(y + 2 * cb - part(cb, 14_942));
    }
    for (x, pixel) in out.as_chunks_mut::<3>().0.iter_mut().enumerate() {
        *pixel = [red[x], green[x], blue[x]];
    }
}
