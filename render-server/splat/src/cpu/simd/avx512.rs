//! AVX-512: 16 lanes and mask registers.

#![allow(unsafe_code, reason = "SIMD intrinsics, after detection of the instruction set")]

#[allow(clippy::wildcard_imports, reason = "two dozen intrinsics, each named once below")]
use std::arch::x86_64::*;
use std::ops::{Add, BitAnd, Div, Mul, Sub};

use super::{Kernel, Simd};

/// Proof that the processor has AVX-512 F, VL, BW and DQ, and all features of [`super::Avx2`].
#[derive(Clone, Copy, Debug)]
pub struct Avx512(());

impl Avx512 {
    /// Returns the proof if the processor and the operating system support the set.
    pub fn detect() -> Option<Self> {
        let found = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512vl")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512dq");
        (found && super::Avx2::detect().is_some()).then_some(Self(()))
    }
}

const LANES: usize = 16;

/// Coefficients as in [`super::EXP2`], but on [0, 1], because rounding down is free here: 2.7e-6.
const EXP2: [f32; 5] = [1.000_002_6, 0.693_003_83, 0.241_442_74, 0.052_011_49, 0.013_534_154];

/// Vector of 16 lanes. Created only by methods of [`Avx512`], so it also proves support.
#[derive(Clone, Copy)]
pub struct F32x16(__m512);

/// One bit per lane.
#[derive(Clone, Copy)]
pub struct Mask16(__mmask16);

macro_rules! operators {
    ($($name:ident $method:ident $intrinsic:ident;)*) => {$(
        impl $name for F32x16 {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                // SAFETY: a vector exists only if AVX-512 was detected.
                Self(unsafe { $intrinsic(self.0, other.0) })
            }
        }
    )*};
}
operators! {
    Add add _mm512_add_ps;
    Sub sub _mm512_sub_ps;
    Mul mul _mm512_mul_ps;
    Div div _mm512_div_ps;
}

impl BitAnd for Mask16 {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }
}

/// Calls an intrinsic that needs only the features that `self` proves.
macro_rules! proven {
    ($call:expr) => {
        // SAFETY: `self` exists only if AVX-512 F, VL, BW, DQ were detected; no memory is touched.
        unsafe { $call }
    };
}

impl Simd for Avx512 {
    type F = F32x16;
    type M = Mask16;

    const LANES: usize = LANES;

    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) -> K::Output {
        #[target_feature(
            enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma,f16c,bmi1,bmi2,popcnt,lzcnt"
        )]
        fn with_avx512<K: Kernel>(kernel: K, simd: Avx512) -> K::Output {
            kernel.run(simd)
        }
        // SAFETY: `self` proves every feature that is named.
        unsafe { with_avx512(kernel, self) }
    }

    #[inline(always)]
    fn splat(self, value: f32) -> F32x16 {
        F32x16(proven!(_mm512_set1_ps(value)))
    }

    #[inline(always)]
    fn load(self, values: &[f32]) -> F32x16 {
        let values = &values[..LANES];
        // SAFETY: the slice has sixteen floats; the load needs no alignment. `self` proves AVX-512.
        F32x16(unsafe { _mm512_loadu_ps(values.as_ptr()) })
    }

    #[inline(always)]
    fn load_f16(self, values: &[u16]) -> F32x16 {
        let values = &values[..LANES];
        // SAFETY: the slice has sixteen 16-bit numbers; the load needs no alignment. `self` proves AVX-512.
        F32x16(unsafe { _mm512_cvtph_ps(_mm256_loadu_si256(values.as_ptr().cast())) })
    }

    #[inline(always)]
    fn store(self, v: F32x16, out: &mut [f32]) {
        let out = &mut out[..LANES];
        // SAFETY: there is room for sixteen floats; the store needs no alignment.
        unsafe { _mm512_storeu_ps(out.as_mut_ptr(), v.0) }
    }

    #[inline(always)]
    fn mul_add(self, a: F32x16, b: F32x16, c: F32x16) -> F32x16 {
        F32x16(proven!(_mm512_fmadd_ps(a.0, b.0, c.0)))
    }

    #[inline(always)]
    fn neg_mul_add(self, a: F32x16, b: F32x16, c: F32x16) -> F32x16 {
        F32x16(proven!(_mm512_fnmadd_ps(a.0, b.0, c.0)))
    }

    #[inline(always)]
    fn min(self, a: F32x16, b: F32x16) -> F32x16 {
        F32x16(proven!(_mm512_min_ps(a.0, b.0)))
    }

    #[inline(always)]
    fn max(self, a: F32x16, b: F32x16) -> F32x16 {
        F32x16(proven!(_mm512_max_ps(a.0, b.0)))
    }

    #[inline(always)]
    fn sqrt(self, a: F32x16) -> F32x16 {
        F32x16(proven!(_mm512_sqrt_ps(a.0)))
    }

    #[inline(always)]
    fn floor(self, a: F32x16) -> F32x16 {
        const DOWN: i32 = _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC;
        F32x16(proven!(_mm512_roundscale_ps::<DOWN>(a.0)))
    }

    #[inline(always)]
    fn exp2(self, a: F32x16) -> F32x16 {
        // Fraction above the value rounded down; the scaling rounds down in the same way.
        const DOWN: i32 = _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC;
        let f = F32x16(proven!(_mm512_reduce_ps::<DOWN>(a.0)));
        let p = self.mul_add(self.splat(EXP2[4]), f, self.splat(EXP2[3]));
        let p = self.mul_add(p, f, self.splat(EXP2[2]));
        let p = self.mul_add(p, f, self.splat(EXP2[1]));
        let p = self.mul_add(p, f, self.splat(EXP2[0]));
        F32x16(proven!(_mm512_scalef_ps(p.0, a.0)))
    }

    #[inline(always)]
    fn negative(self, a: F32x16) -> F32x16 {
        F32x16(proven!(_mm512_or_ps(a.0, _mm512_set1_ps(-0.0))))
    }

    #[inline(always)]
    fn sum(self, a: F32x16) -> f32 {
        proven!(_mm512_reduce_add_ps(a.0))
    }

    #[inline(always)]
    fn lt(self, a: F32x16, b: F32x16) -> Mask16 {
        Mask16(proven!(_mm512_cmp_ps_mask::<_CMP_LT_OQ>(a.0, b.0)))
    }

    #[inline(always)]
    fn select(self, m: Mask16, a: F32x16, b: F32x16) -> F32x16 {
        F32x16(proven!(_mm512_mask_blend_ps(m.0, b.0, a.0)))
    }

    #[inline(always)]
    fn keep(self, m: Mask16, a: F32x16) -> F32x16 {
        F32x16(proven!(_mm512_maskz_mov_ps(m.0, a.0)))
    }

    #[inline(always)]
    fn bits(self, m: Mask16) -> u32 {
        u32::from(m.0)
    }

    #[inline(always)]
    fn any(self, m: Mask16) -> bool {
        m.0 != 0
    }

    #[inline(always)]
    fn bit_planes(self, bytes: &[u8; 64]) -> [u64; 8] {
        // SAFETY: the array has 64 bytes; the load needs no alignment. `self` proves AVX-512.
        let bytes = unsafe { _mm512_loadu_si512(bytes.as_ptr().cast()) };
        std::array::from_fn(|bit| {
            proven!(_mm512_test_epi8_mask(bytes, _mm512_set1_epi8((1u8 << bit) as i8)))
        })
    }

    #[inline(always)]
    fn prefetch<T>(self, value: &T) {
        // SAFETY: a prefetch is a hint without effect on memory, and the address is that of a live reference.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(value).cast()) }
    }
}
