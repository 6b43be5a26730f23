//! AVX2 with FMA and F16C: every x86 server and laptop since 2013 (Intel) and 2017 (AMD).

#![allow(unsafe_code, reason = "SIMD intrinsics, after detection of the instruction set")]

#[allow(clippy::wildcard_imports, reason = "two dozen intrinsics, each named once below")]
use std::arch::x86_64::*;
use std::ops::{Add, BitAnd, Div, Mul, Sub};

use super::{EXP2, Kernel, Simd};

/// Proof that the processor has AVX2, FMA and F16C (and BMI, POPCNT and LZCNT, which came with them).
#[derive(Clone, Copy, Debug)]
pub struct Avx2(());

impl Avx2 {
    /// Returns the proof if the processor and the operating system support the set.
    pub fn detect() -> Option<Self> {
        let found = is_x86_feature_detected!("avx2")
            && is_x86_feature_detected!("fma")
            && is_x86_feature_detected!("f16c")
            && is_x86_feature_detected!("bmi1")
            && is_x86_feature_detected!("bmi2")
            && is_x86_feature_detected!("popcnt")
            && is_x86_feature_detected!("lzcnt");
        found.then_some(Self(()))
    }
}

const LANES: usize = 8;

/// Vector of 8 lanes. Created only by methods of [`Avx2`], so it also proves support.
#[derive(Clone, Copy)]
pub struct F32x8(__m256);

/// Mask: all bits of a lane are set or none. Created only by methods of [`Avx2`].
#[derive(Clone, Copy)]
pub struct Mask8(__m256);

macro_rules! operators {
    ($($name:ident $method:ident $intrinsic:ident;)*) => {$(
        impl $name for F32x8 {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                // SAFETY: a vector exists only if AVX2 was detected.
                Self(unsafe { $intrinsic(self.0, other.0) })
            }
        }
    )*};
}
operators! {
    Add add _mm256_add_ps;
    Sub sub _mm256_sub_ps;
    Mul mul _mm256_mul_ps;
    Div div _mm256_div_ps;
}

impl BitAnd for Mask8 {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        // SAFETY: a mask exists only if AVX2 was detected.
        Self(unsafe { _mm256_and_ps(self.0, other.0) })
    }
}

/// Calls an intrinsic that needs only the features that `self` proves.
macro_rules! proven {
    ($call:expr) => {
        // SAFETY: `self` exists only if AVX2, FMA and F16C were detected; no memory is touched.
        unsafe { $call }
    };
}

impl Simd for Avx2 {
    type F = F32x8;
    type M = Mask8;

    const LANES: usize = LANES;

    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) -> K::Output {
        #[target_feature(enable = "avx2,fma,f16c,bmi1,bmi2,popcnt,lzcnt")]
        fn with_avx2<K: Kernel>(kernel: K, simd: Avx2) -> K::Output {
            kernel.run(simd)
        }
        // SAFETY: `self` proves every feature that is named.
        unsafe { with_avx2(kernel, self) }
    }

    #[inline(always)]
    fn splat(self, value: f32) -> F32x8 {
        F32x8(proven!(_mm256_set1_ps(value)))
    }

    #[inline(always)]
    fn load(self, values: &[f32]) -> F32x8 {
        let values = &values[..LANES];
        // SAFETY: the slice has eight floats; the load needs no alignment. `self` proves AVX.
        F32x8(unsafe { _mm256_loadu_ps(values.as_ptr()) })
    }

    #[inline(always)]
    fn load_f16(self, values: &[u16]) -> F32x8 {
        let values = &values[..LANES];
        // SAFETY: the slice has eight 16-bit numbers; the load needs no alignment. `self` proves F16C.
        F32x8(unsafe { _mm256_cvtph_ps(_mm_loadu_si128(values.as_ptr().cast())) })
    }

    #[inline(always)]
    fn store(self, v: F32x8, out: &mut [f32]) {
        let out = &mut out[..LANES];
        // SAFETY: there is room for eight floats; the store needs no alignment.
        unsafe { _mm256_storeu_ps(out.as_mut_ptr(), v.0) }
    }

    #[inline(always)]
    fn mul_add(self, a: F32x8, b: F32x8, c: F32x8) -> F32x8 {
        F32x8(proven!(_mm256_fmadd_ps(a.0, b.0, c.0)))
    }

    #[inline(always)]
    fn neg_mul_add(self, a: F32x8, b: F32x8, c: F32x8) -> F32x8 {
        F32x8(proven!(_mm256_fnmadd_ps(a.0, b.0, c.0)))
    }

    #[inline(always)]
    fn min(self, a: F32x8, b: F32x8) -> F32x8 {
        F32x8(proven!(_mm256_min_ps(a.0, b.0)))
    }

    #[inline(always)]
    fn max(self, a: F32x8, b: F32x8) -> F32x8 {
        F32x8(proven!(_mm256_max_ps(a.0, b.0)))
    }

    #[inline(always)]
    fn sqrt(self, a: F32x8) -> F32x8 {
        F32x8(proven!(_mm256_sqrt_ps(a.0)))
    }

    #[inline(always)]
    fn floor(self, a: F32x8) -> F32x8 {
        F32x8(proven!(_mm256_floor_ps(a.0)))
    }

    #[inline(always)]
    fn exp2(self, a: F32x8) -> F32x8 {
        /// 1.5 * 2^23: adding it rounds to a whole number, which is in the low bits.
        const ROUND: f32 = 12_582_912.0;
        let rounded = a + self.splat(ROUND);
        let f = a - (rounded - self.splat(ROUND));
        let p = self.mul_add(self.splat(EXP2[4]), f, self.splat(EXP2[3]));
        let p = self.mul_add(p, f, self.splat(EXP2[2]));
        let p = self.mul_add(p, f, self.splat(EXP2[1]));
        let p = self.mul_add(p, f, self.splat(EXP2[0]));
        F32x8(proven!(_mm256_castsi256_ps(_mm256_add_epi32(
            _mm256_castps_si256(p.0),
            _mm256_slli_epi32::<23>(_mm256_castps_si256(rounded.0)),
        ))))
    }

    #[inline(always)]
    fn negative(self, a: F32x8) -> F32x8 {
        F32x8(proven!(_mm256_or_ps(a.0, _mm256_set1_ps(-0.0))))
    }

    #[inline(always)]
    fn sum(self, a: F32x8) -> f32 {
        let halves =
            proven!(_mm_add_ps(_mm256_castps256_ps128(a.0), _mm256_extractf128_ps::<1>(a.0)));
        let pairs = proven!(_mm_add_ps(halves, _mm_movehl_ps(halves, halves)));
        proven!(_mm_cvtss_f32(_mm_add_ss(pairs, _mm_shuffle_ps::<1>(pairs, pairs))))
    }

    #[inline(always)]
    fn lt(self, a: F32x8, b: F32x8) -> Mask8 {
        Mask8(proven!(_mm256_cmp_ps::<_CMP_LT_OQ>(a.0, b.0)))
    }

    #[inline(always)]
    fn select(self, m: Mask8, a: F32x8, b: F32x8) -> F32x8 {
        F32x8(proven!(_mm256_blendv_ps(b.0, a.0, m.0)))
    }

    #[inline(always)]
    fn keep(self, m: Mask8, a: F32x8) -> F32x8 {
        F32x8(proven!(_mm256_and_ps(a.0, m.0)))
    }

    #[inline(always)]
    fn bits(self, m: Mask8) -> u32 {
        proven!(_mm256_movemask_ps(m.0)) as u32
    }

    #[inline(always)]
    fn any(self, m: Mask8) -> bool {
        self.bits(m) != 0
    }

    #[inline(always)]
    fn bit_planes(self, bytes: &[u8; 64]) -> [u64; 8] {
        let at = bytes.as_ptr();
        // SAFETY: the array has 64 bytes; the loads need no alignment. `self` proves AVX.
        let mut halves =
            unsafe { [_mm256_loadu_si256(at.cast()), _mm256_loadu_si256(at.add(32).cast())] };
        let mut planes = [0; 8];
        // The instruction collects the uppermost bits; adding a byte to itself moves the next bit up.
        for plane in planes.iter_mut().rev() {
            let [low, high] = halves.map(|half| proven!(_mm256_movemask_epi8(half)) as u32);
            *plane = u64::from(high) << 32 | u64::from(low);
            halves = halves.map(|half| proven!(_mm256_add_epi8(half, half)));
        }
        planes
    }

    #[inline(always)]
    fn prefetch<T>(self, value: &T) {
        // SAFETY: a prefetch is a hint without effect on memory, and the address is that of a live reference.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(value).cast()) }
    }
}
