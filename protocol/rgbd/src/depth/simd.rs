//! SIMD kernels: bit lengths of a block's residuals, and inversion of the prediction.
//!
//! The prediction is inverted in all stripes at once: lane `s` of a vector is a pixel of stripe `s`.
//!
//! Residuals are stored in rows. So 8 columns of 8 stripes are transposed, predicted column by column, and transposed
//! back. This takes about one cycle per pixel; a single stripe would wait four cycles for each pixel's left neighbour.
//! SSE2 and NEON are always available on their machines, so they need no detection at run time. Other machines use the
//! plain version.

#![allow(
    unsafe_code,
    reason = "calls of functions compiled for more instructions, after detection"
)]

use super::blocks::{Block, Lanes, Shape};
use super::layout::{BLOCK_COLUMNS, Layout, STRIPES};
use super::{DepthDecoder, DepthEncoder, Parts};

/// Operations with an implementation per instruction set.
pub(super) trait Kernel {
    /// Returns [`Shape::cheapest`] of a block, and the mask of residuals with high bits.
    fn cheapest(block: &Block) -> (Shape, u64);

    /// Inverts the prediction in 8 columns of 8 stripes: residuals in, pixels out. `above` is the row above the
    /// columns; `left` and `corner` are the neighbours of the first column. All three are updated.
    fn columns(
        square: &mut Square,
        above: &mut [[u16; STRIPES]; STRIPES],
        left: &mut [u16; STRIPES],
        corner: &mut [u16; STRIPES],
    );
}

/// Writes the image of zig-zagged residuals. `above` is the row above the image, one vector per column of a stripe.
#[inline(always)]
fn undo_prediction_by<K: Kernel>(
    residuals: &[u16],
    layout: &Layout,
    above: &mut [[u16; STRIPES]],
    depth: &mut [u16],
) {
    let &Layout { width, height, stride, stripe_columns, .. } = layout;
    assert!(residuals.len() >= height * stride && above.len() == stripe_columns);
    assert!(depth.len() == width * height && stride == STRIPES * stripe_columns);
    for (residuals, depth) in residuals.chunks_exact(stride).zip(depth.chunks_exact_mut(width)) {
        // The first pixel of a stripe is predicted from the one above: left and corner get the same value.
        let mut left = above[0];
        let mut corner = above[0];
        for (group, above) in above.as_chunks_mut::<STRIPES>().0.iter_mut().enumerate() {
            let mut square: Square = std::array::from_fn(|stripe| {
                let at = stripe * stripe_columns + group * STRIPES;
                let mut eight = [0; STRIPES];
                eight.copy_from_slice(&residuals[at..at + STRIPES]);
                eight
            });
            K::columns(&mut square, above, &mut left, &mut corner);
            for (stripe, pixels) in square.iter().enumerate() {
                let x = stripe * stripe_columns + group * STRIPES;
                if x + STRIPES <= width {
                    depth[x..x + STRIPES].copy_from_slice(pixels);
                } else if x < width {
                    depth[x..].copy_from_slice(&pixels[..width - x]);
                }
            }
        }
    }
}

/// Runs one of the loops below with AVX2 if available, otherwise with the base instruction set: the same code, compiled
/// twice.
macro_rules! widest {
    ($name:ident($($argument:ident: $kind:ty),*), $wide:expr, $plain:expr) => {
        pub(super) fn $name($($argument: $kind),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,bmi1,bmi2,lzcnt,popcnt")]
                fn wide($($argument: $kind),*) {
                    $wide($($argument),*);
                }
                if is_x86_feature_detected!("avx2")
                    && is_x86_feature_detected!("bmi1")
                    && is_x86_feature_detected!("bmi2")
                    && is_x86_feature_detected!("lzcnt")
                    && is_x86_feature_detected!("popcnt")
                {
                    // SAFETY: the machine supports the features for which the function is compiled.
                    return unsafe { wide($($argument),*) };
                }
            }
            $plain($($argument),*);
        }
    };
}

widest!(
    encode_blocks(encoder: &mut DepthEncoder, depth: &[u16], layout: &Layout, table: &mut [u8]),
    DepthEncoder::encode_blocks::<wide::Wide>,
    DepthEncoder::encode_blocks::<kernel::Base>
);
widest!(
    undo_prediction(residuals: &[u16], layout: &Layout, above: &mut [[u16; STRIPES]], depth: &mut [u16]),
    undo_prediction_by::<wide::Wide>,
    undo_prediction_by::<kernel::Base>
);
widest!(
    unpack_blocks(decoder: &mut DepthDecoder, parts: &Parts<'_>, layout: &Layout),
    DepthDecoder::unpack_blocks,
    DepthDecoder::unpack_blocks
);

/// Returns the length of a block's longest residual. [bits]
#[inline(always)]
fn longest(block: &Block) -> u32 {
    let mut all: Lanes = [0; BLOCK_COLUMNS];
    for row in block {
        for (all, residual) in all.iter_mut().zip(row) {
            *all |= residual;
        }
    }
    16 - all.iter().fold(0, |all, lane| all | lane).leading_zeros()
}

/// 8 columns of 8 stripes: rows are stripes outside the kernel.
type Square = [[u16; STRIPES]; STRIPES];

/// The plain version, compiled on every machine, so that tests cover it.
#[cfg_attr(any(target_arch = "x86_64", target_arch = "aarch64"), allow(dead_code))]
mod plain {
    use super::super::blocks::{Block, Shape};
    use super::super::predict::{med, unzigzag};
    use super::super::scalar::longer_than;
    use super::{Kernel, STRIPES, Square, longest};

    pub(super) struct Base;

    impl Kernel for Base {
        #[inline(always)]
        fn cheapest(block: &Block) -> (Shape, u64) {
            Shape::cheapest(longest(block), |bits| longer_than(block.as_flattened(), bits))
        }

        #[inline(always)]
        fn columns(
            square: &mut Square,
            above: &mut [[u16; STRIPES]; STRIPES],
            left: &mut [u16; STRIPES],
            corner: &mut [u16; STRIPES],
        ) {
            for column in 0..STRIPES {
                for stripe in 0..STRIPES {
                    let up = above[column][stripe];
                    let residual = unzigzag(square[stripe][column]);
                    let pixel = med(left[stripe], up, corner[stripe]).wrapping_add(residual);
                    square[stripe][column] = pixel;
                    above[column][stripe] = pixel;
                    left[stripe] = pixel;
                    corner[stripe] = up;
                }
            }
        }
    }
}

#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
use plain as kernel;

#[cfg(target_arch = "x86_64")]
mod kernel {
    use core::arch::x86_64::{
        __m128i, _mm_add_epi16, _mm_and_si128, _mm_cvtsi32_si128, _mm_loadu_si128,
        _mm_movemask_epi8, _mm_or_si128, _mm_packus_epi16, _mm_set1_epi16, _mm_setzero_si128,
        _mm_sll_epi16, _mm_srli_epi16, _mm_storeu_si128, _mm_sub_epi16, _mm_subs_epu16,
        _mm_unpackhi_epi16, _mm_unpackhi_epi32, _mm_unpackhi_epi64, _mm_unpacklo_epi16,
        _mm_unpacklo_epi32, _mm_unpacklo_epi64, _mm_xor_si128,
    };

    use super::super::blocks::{Block, Lanes, Shape};
    use super::super::layout::BLOCK_ROWS;
    use super::{Kernel, STRIPES, Square, longest};

    #[inline(always)]
    pub(super) fn load(from: &[u16; STRIPES]) -> __m128i {
        // SAFETY: the array is 16 readable bytes; the load needs no alignment.
        unsafe { _mm_loadu_si128(from.as_ptr().cast()) }
    }

    #[inline(always)]
    pub(super) fn store(to: &mut [u16; STRIPES], vector: __m128i) {
        // SAFETY: the array is 16 writable bytes; the store needs no alignment.
        unsafe { _mm_storeu_si128(to.as_mut_ptr().cast(), vector) }
    }

    #[inline(always)]
    pub(super) fn transpose(r: [__m128i; STRIPES]) -> [__m128i; STRIPES] {
        // SAFETY: SSE2 is part of x86_64; these intrinsics work on values only.
        unsafe {
            let a = [
                _mm_unpacklo_epi16(r[0], r[1]),
                _mm_unpacklo_epi16(r[2], r[3]),
                _mm_unpacklo_epi16(r[4], r[5]),
                _mm_unpacklo_epi16(r[6], r[7]),
                _mm_unpackhi_epi16(r[0], r[1]),
                _mm_unpackhi_epi16(r[2], r[3]),
                _mm_unpackhi_epi16(r[4], r[5]),
                _mm_unpackhi_epi16(r[6], r[7]),
            ];
            let b = [
                _mm_unpacklo_epi32(a[0], a[1]),
                _mm_unpacklo_epi32(a[2], a[3]),
                _mm_unpackhi_epi32(a[0], a[1]),
                _mm_unpackhi_epi32(a[2], a[3]),
                _mm_unpacklo_epi32(a[4], a[5]),
                _mm_unpacklo_epi32(a[6], a[7]),
                _mm_unpackhi_epi32(a[4], a[5]),
                _mm_unpackhi_epi32(a[6], a[7]),
            ];
            [
                _mm_unpacklo_epi64(b[0], b[1]),
                _mm_unpackhi_epi64(b[0], b[1]),
                _mm_unpacklo_epi64(b[2], b[3]),
                _mm_unpackhi_epi64(b[2], b[3]),
                _mm_unpacklo_epi64(b[4], b[5]),
                _mm_unpackhi_epi64(b[4], b[5]),
                _mm_unpacklo_epi64(b[6], b[7]),
                _mm_unpackhi_epi64(b[6], b[7]),
            ]
        }
    }

    /// Base instruction set of x86_64: SSE2.
    pub(super) struct Base;

    impl Kernel for Base {
        /// A residual has more than n bits if any bit from n upwards is set. The bits are smeared downwards, so that
        /// bit n of the result shows this. The sign mask of bytes collects 16 residuals at a time.
        #[inline(always)]
        fn cheapest(block: &Block) -> (Shape, u64) {
            let top = longest(block);
            // SAFETY: SSE2 is part of x86_64; these intrinsics work on values only.
            unsafe {
                let low_byte = _mm_set1_epi16(255);
                let mut low = [_mm_setzero_si128(); BLOCK_ROWS];
                let mut high = low;
                for (row, values) in block.iter().enumerate() {
                    let [left, right] = halves(values).map(|half| {
                        let half = _mm_or_si128(half, _mm_srli_epi16::<1>(half));
                        let half = _mm_or_si128(half, _mm_srli_epi16::<2>(half));
                        let half = _mm_or_si128(half, _mm_srli_epi16::<4>(half));
                        _mm_or_si128(half, _mm_srli_epi16::<8>(half))
                    });
                    let lows = (_mm_and_si128(left, low_byte), _mm_and_si128(right, low_byte));
                    low[row] = _mm_packus_epi16(lows.0, lows.1);
                    let highs = (_mm_srli_epi16::<8>(left), _mm_srli_epi16::<8>(right));
                    high[row] = _mm_packus_epi16(highs.0, highs.1);
                }
                Shape::cheapest(top, |bits| {
                    // Shifts the bit to the top of its byte; bits that cross bytes stay below it.
                    let up = _mm_cvtsi32_si128(7 - (bits as i32 & 7));
                    let bytes = if bits < 8 { &low } else { &high };
                    let rows = bytes.map(|bytes| _mm_movemask_epi8(_mm_sll_epi16(bytes, up)));
                    rows.iter().rev().fold(0, |mask, &row| mask << 16 | row as u64)
                })
            }
        }

        #[inline(always)]
        fn columns(
            square: &mut Square,
            above: &mut [[u16; STRIPES]; STRIPES],
            left: &mut [u16; STRIPES],
            corner: &mut [u16; STRIPES],
        ) {
            let mut vectors = transpose(square.each_ref().map(load));
            let (mut l, mut c) = (load(left), load(corner));
            // SAFETY: SSE2 is part of x86_64; these intrinsics work on values only.
            unsafe {
                let one = _mm_set1_epi16(1);
                for (vector, above) in vectors.iter_mut().zip(above) {
                    let sign = _mm_and_si128(*vector, one);
                    let residual = _mm_xor_si128(
                        _mm_srli_epi16::<1>(*vector),
                        _mm_sub_epi16(_mm_setzero_si128(), sign),
                    );
                    let up = load(above);
                    // SSE2 has no unsigned minimum and maximum; saturating subtraction gives both.
                    let left_over = _mm_subs_epu16(l, up);
                    let (greater, lesser) =
                        (_mm_add_epi16(up, left_over), _mm_sub_epi16(l, left_over));
                    let low = _mm_sub_epi16(c, _mm_subs_epu16(c, greater));
                    let clamped = _mm_add_epi16(lesser, _mm_subs_epu16(low, lesser));
                    let sum = _mm_add_epi16(_mm_add_epi16(up, residual), l);
                    l = _mm_sub_epi16(sum, clamped);
                    c = up;
                    store(above, l);
                    *vector = l;
                }
            }
            store(left, l);
            store(corner, c);
            for (row, vector) in square.iter_mut().zip(transpose(vectors)) {
                store(row, vector);
            }
        }
    }

    #[inline(always)]
    fn halves(values: &Lanes) -> [__m128i; 2] {
        let (from, _) = values.as_chunks::<8>();
        [load(&from[0]), load(&from[1])]
    }
}

/// AVX2 implementation: two rows per vector.
#[cfg(target_arch = "x86_64")]
mod wide {
    use core::arch::x86_64::{
        __m256i, _mm_add_epi16, _mm_and_si128, _mm_cvtsi32_si128, _mm_max_epu16, _mm_min_epu16,
        _mm_set1_epi16, _mm_setzero_si128, _mm_srli_epi16, _mm_sub_epi16, _mm_xor_si128,
        _mm256_and_si256, _mm256_loadu_si256, _mm256_movemask_epi8, _mm256_or_si256,
        _mm256_packus_epi16, _mm256_permute4x64_epi64, _mm256_set1_epi16, _mm256_sll_epi16,
        _mm256_srli_epi16,
    };

    use super::super::blocks::{Block, Lanes, Shape};
    use super::kernel::{load as load_half, store, transpose};
    use super::{Kernel, STRIPES, Square, longest};

    pub(super) struct Wide;

    impl Kernel for Wide {
        #[inline(always)]
        fn cheapest(block: &Block) -> (Shape, u64) {
            let top = longest(block);
            // SAFETY: this type is used only by code that is compiled for AVX2 and runs where AVX2 was detected.
            let bytes = unsafe { smeared(block) };
            // SAFETY: as above.
            Shape::cheapest(top, |bits| unsafe { plane(&bytes, bits) })
        }

        #[inline(always)]
        fn columns(
            square: &mut Square,
            above: &mut [[u16; STRIPES]; STRIPES],
            left: &mut [u16; STRIPES],
            corner: &mut [u16; STRIPES],
        ) {
            let mut vectors = transpose(square.each_ref().map(load_half));
            let (mut l, mut c) = (load_half(left), load_half(corner));
            // SAFETY: AVX2 includes SSE4.1; as above; these intrinsics work on values only.
            unsafe {
                let one = _mm_set1_epi16(1);
                for (vector, above) in vectors.iter_mut().zip(above) {
                    let sign = _mm_and_si128(*vector, one);
                    let residual = _mm_xor_si128(
                        _mm_srli_epi16::<1>(*vector),
                        _mm_sub_epi16(_mm_setzero_si128(), sign),
                    );
                    let up = load_half(above);
                    let low = _mm_min_epu16(c, _mm_max_epu16(l, up));
                    let clamped = _mm_max_epu16(low, _mm_min_epu16(l, up));
                    let sum = _mm_add_epi16(_mm_add_epi16(up, residual), l);
                    l = _mm_sub_epi16(sum, clamped);
                    c = up;
                    store(above, l);
                    *vector = l;
                }
            }
            store(left, l);
            store(corner, c);
            for (row, vector) in square.iter_mut().zip(transpose(vectors)) {
                store(row, vector);
            }
        }
    }

    /// Returns the residuals as bytes, first the low then the high ones, with every bit below a set bit also set.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn smeared(block: &Block) -> [[__m256i; 2]; 2] {
        let low_byte = _mm256_set1_epi16(255);
        let mut bytes = [[low_byte; 2]; 2];
        for (at, rows) in block.as_chunks::<2>().0.iter().enumerate() {
            let (first, second) = (smear(load(&rows[0])), smear(load(&rows[1])));
            let lows = (_mm256_and_si256(first, low_byte), _mm256_and_si256(second, low_byte));
            let highs = (_mm256_srli_epi16::<8>(first), _mm256_srli_epi16::<8>(second));
            // The pack works within halves, which swaps the middle quarters.
            let low = _mm256_packus_epi16(lows.0, lows.1);
            bytes[0][at] = _mm256_permute4x64_epi64::<0b11_01_10_00>(low);
            let high = _mm256_packus_epi16(highs.0, highs.1);
            bytes[1][at] = _mm256_permute4x64_epi64::<0b11_01_10_00>(high);
        }
        bytes
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn smear(row: __m256i) -> __m256i {
        let row = _mm256_or_si256(row, _mm256_srli_epi16::<1>(row));
        let row = _mm256_or_si256(row, _mm256_srli_epi16::<2>(row));
        let row = _mm256_or_si256(row, _mm256_srli_epi16::<4>(row));
        _mm256_or_si256(row, _mm256_srli_epi16::<8>(row))
    }

    /// Returns the mask of residuals with more than `bits` bits.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn plane(bytes: &[[__m256i; 2]; 2], bits: u32) -> u64 {
        // Shifts the bit to the top of its byte; bits that cross bytes stay below it.
        let up = _mm_cvtsi32_si128(7 - (bits as i32 & 7));
        let [first, second] = bytes[usize::from(bits >= 8)];
        let first = _mm256_movemask_epi8(_mm256_sll_epi16(first, up)).cast_unsigned();
        let second = _mm256_movemask_epi8(_mm256_sll_epi16(second, up)).cast_unsigned();
        u64::from(first) | u64::from(second) << 32
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn load(row: &Lanes) -> __m256i {
        // SAFETY: the array is 32 readable bytes; the load needs no alignment.
        unsafe { _mm256_loadu_si256(row.as_ptr().cast()) }
    }
}

#[cfg(target_arch = "aarch64")]
mod kernel {
    use core::arch::aarch64::{
        uint16x8_t, vaddq_u16, vandq_u16, vdupq_n_u16, veorq_u16, vld1q_u16, vmaxq_u16, vminq_u16,
        vreinterpretq_u16_u32, vreinterpretq_u16_u64, vreinterpretq_u32_u16, vreinterpretq_u64_u16,
        vshrq_n_u16, vst1q_u16, vsubq_u16, vtrn1q_u16, vtrn1q_u32, vtrn1q_u64, vtrn2q_u16,
        vtrn2q_u32, vtrn2q_u64,
    };

    use super::super::blocks::{Block, Shape};
    use super::{Kernel, STRIPES, Square, plain};

    pub(super) struct Base;

    impl Kernel for Base {
        // Why: NEON has no movemask; the plain loop is used until it is measured on such a machine.
        #[inline(always)]
        fn cheapest(block: &Block) -> (Shape, u64) {
            plain::Base::cheapest(block)
        }

        #[inline(always)]
        fn columns(
            square: &mut Square,
            above: &mut [[u16; STRIPES]; STRIPES],
            left: &mut [u16; STRIPES],
            corner: &mut [u16; STRIPES],
        ) {
            let mut vectors = transpose(square.each_ref().map(load));
            let (mut l, mut c) = (load(left), load(corner));
            // SAFETY: NEON is part of aarch64; these intrinsics work on values only.
            unsafe {
                let (zero, one) = (vdupq_n_u16(0), vdupq_n_u16(1));
                for (vector, above) in vectors.iter_mut().zip(above) {
                    let sign = vsubq_u16(zero, vandq_u16(*vector, one));
                    let residual = veorq_u16(vshrq_n_u16::<1>(*vector), sign);
                    let up = load(above);
                    let clamped = vmaxq_u16(vminq_u16(c, vmaxq_u16(l, up)), vminq_u16(l, up));
                    let sum = vaddq_u16(vaddq_u16(up, residual), l);
                    l = vsubq_u16(sum, clamped);
                    c = up;
                    store(above, l);
                    *vector = l;
                }
            }
            store(left, l);
            store(corner, c);
            for (row, vector) in square.iter_mut().zip(transpose(vectors)) {
                store(row, vector);
            }
        }
    }

    #[inline(always)]
    fn load(from: &[u16; STRIPES]) -> uint16x8_t {
        // SAFETY: the array is 16 readable bytes; the load needs no alignment.
        unsafe { vld1q_u16(from.as_ptr()) }
    }

    #[inline(always)]
    fn store(to: &mut [u16; STRIPES], vector: uint16x8_t) {
        // SAFETY: the array is 16 writable bytes; the store needs no alignment.
        unsafe { vst1q_u16(to.as_mut_ptr(), vector) }
    }

    /// Swaps the off-diagonal quarters at three scales: elements, pairs, fours.
    #[inline(always)]
    fn transpose(mut r: [uint16x8_t; STRIPES]) -> [uint16x8_t; STRIPES] {
        // SAFETY: NEON is part of aarch64; these intrinsics work on values only.
        unsafe {
            for i in [0, 2, 4, 6] {
                (r[i], r[i + 1]) = (vtrn1q_u16(r[i], r[i + 1]), vtrn2q_u16(r[i], r[i + 1]));
            }
            for i in [0, 1, 4, 5] {
                let (a, b) = (vreinterpretq_u32_u16(r[i]), vreinterpretq_u32_u16(r[i + 2]));
                r[i] = vreinterpretq_u16_u32(vtrn1q_u32(a, b));
                r[i + 2] = vreinterpretq_u16_u32(vtrn2q_u32(a, b));
            }
            for i in [0, 1, 2, 3] {
                let (a, b) = (vreinterpretq_u64_u16(r[i]), vreinterpretq_u64_u16(r[i + 4]));
                r[i] = vreinterpretq_u16_u64(vtrn1q_u64(a, b));
                r[i + 4] = vreinterpretq_u16_u64(vtrn2q_u64(a, b));
            }
            r
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Residuals of every length.
        #[test]
        fn kernels_return_the_same_shapes(block: Block, shifts in prop::array::uniform32(0u32..17)) {
            let mut block = block;
            for (at, value) in block.as_flattened_mut().iter_mut().enumerate() {
                *value = value.checked_shr(shifts[at % 32]).unwrap_or(0);
            }
            let plain = plain::Base::cheapest(&block);
            prop_assert_eq!(kernel::Base::cheapest(&block), plain);
            #[cfg(target_arch = "x86_64")]
            if is_x86_feature_detected!("avx2") {
                prop_assert_eq!(wide::Wide::cheapest(&block), plain);
            }
            let (shape, mask) = plain;
            for (at, &value) in block.as_flattened().iter().enumerate() {
                let long = value >> shape.low != 0;
                prop_assert!(value.checked_shr(shape.low + shape.high).unwrap_or(0) == 0);
                let named = shape.high > 0 && mask >> at & 1 == 1;
                prop_assert_eq!(named, long, "{:?} {}", shape, value);
            }
        }

        /// The machine's kernel and the plain kernel agree for every input.
        #[test]
        fn kernels_invert_the_prediction_identically(
            square: Square, above: Square, left: [u16; STRIPES], corner: [u16; STRIPES],
        ) {
            let (mut s, mut a, mut l, mut c) = (square, above, left, corner);
            kernel::Base::columns(&mut s, &mut a, &mut l, &mut c);
            let (mut s2, mut a2, mut l2, mut c2) = (square, above, left, corner);
            plain::Base::columns(&mut s2, &mut a2, &mut l2, &mut c2);
            let plain = (s2, a2, l2, c2);
            prop_assert_eq!((s, a, l, c), plain);
            #[cfg(target_arch = "x86_64")]
            if is_x86_feature_detected!("avx2") {
                let (mut s, mut a, mut l, mut c) = (square, above, left, corner);
                wide::Wide::columns(&mut s, &mut a, &mut l, &mut c);
                prop_assert_eq!((s, a, l, c), plain);
            }
        }
    }
}
