//! `exp(-x)` of few vectorisable instructions, with the same bits on every machine because no
//! library is called.

/// Returns `exp(-x)` with an error below 4e-7, for non-negative `x`; 0 above 80, NaN for NaN.
#[inline(always)]
pub(super) fn exp_neg(x: f32) -> f32 {
    // 2^(whole + rest), with |rest| <= 1/2. The lowest bits of the sum are the whole number.
    let power =
        if x > 80.0 { -80.0 * std::f32::consts::LOG2_E } else { x * -std::f32::consts::LOG2_E };
    let rounded = power + ROUND;
    let rest = power - (rounded - ROUND);
    let whole = f32::from_bits((rounded.to_bits().wrapping_add(127)) << 23);
    // Taylor series of 2^rest; the next term is at most 2e-8.
    let series = TERMS.iter().rev().fold(0.0, |sum, term| sum * rest + term);
    if x > 80.0 { 0.0 } else { whole * series }
}

/// Powers of ln 2 over factorials.
const TERMS: [f32; 7] = [
    1.0,
    std::f32::consts::LN_2,
    0.240_226_5,
    0.055_504_11,
    0.009_618_129,
    0.001_333_355_8,
    0.000_154_035_3,
];
/// 1.5 * 2^23: adding it to a number rounds off the fraction.
const ROUND: f32 = 12_582_912.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn is_the_exponential() {
        for k in 0..80_000_u32 {
            let x = k as f32 * 1e-3;
            let (found, truth) = (f64::from(exp_neg(x)), (-f64::from(x)).exp());
            assert!(
                (found - truth).abs() <= 4e-7 * truth.max(1e-30) + 1e-9,
                "{x}: {found} {truth}"
            );
        }
        assert_eq!([exp_neg(0.0), exp_neg(81.0), exp_neg(f32::INFINITY)], [1.0, 0.0, 0.0]);
        assert!(exp_neg(f32::NAN).is_nan());
    }
}
