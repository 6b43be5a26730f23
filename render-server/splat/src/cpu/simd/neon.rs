//! NEON: every 64-bit Arm processor. Two registers of four lanes make a vector of eight.

#![allow(unsafe_code, reason = "SIMD intrinsics, after detection of the instruction set")]

use std::arch::aarch64::{
    float32x4_t, uint32x4_t, vaddq_f32, vaddq_u32, vaddvq_f32, vaddvq_u32, vandq_u32, vbslq_f32,
    vcltq_f32, vdivq_f32, vdupq_n_f32, vdupq_n_u32, vfmaq_f32, vfmsq_f32, vget_high_u16,
    vget_low_u16, vld1q_f32, vld1q_u16, vld1q_u32, vmaxnmq_f32, vmaxvq_u32, vminnmq_f32, vmovl_u16,
    vmulq_f32, vorrq_u32, vreinterpretq_f32_u32, vreinterpretq_u32_f32, vrndmq_f32, vshlq_n_u32,
    vsqrtq_f32, vst1q_f32, vsubq_f32,
};
use std::ops::{Add, BitAnd, Div, Mul, Sub};

use super::{EXP2, Kernel, Simd};

/// NEON instruction set. Needs no detection, because it is part of the architecture.
#[derive(Clone, Copy, Debug)]
pub struct Neon;

const LANES: usize = 8;

#[derive(Clone, Copy)]
pub struct F32x8([float32x4_t; 2]);

/// Mask: all bits of a lane are set or none.
#[derive(Clone, Copy)]
pub struct Mask8([uint32x4_t; 2]);

/// Calls an intrinsic.
macro_rules! neon {
    ($call:expr) => {
        // SAFETY: every aarch64 processor for which this is compiled has NEON; no memory is touched.
        unsafe { $call }
    };
}

macro_rules! operators {
    ($($name:ident $method:ident $intrinsic:ident;)*) => {$(
        impl $name for F32x8 {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                let ([a, b], [c, d]) = (self.0, other.0);
                Self(neon!([$intrinsic(a, c), $intrinsic(b, d)]))
            }
        }
    )*};
}
operators! {
    Add add vaddq_f32;
    Sub sub vsubq_f32;
    Mul mul vmulq_f32;
    Div div vdivq_f32;
}

impl BitAnd for Mask8 {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        let ([a, b], [c, d]) = (self.0, other.0);
        Self(neon!([vandq_u32(a, c), vandq_u32(b, d)]))
    }
}

/// Converts four half to single precision; exact except for infinities and NaN, which never occur. Uses integers,
/// because the instruction needs a type that is not stable yet.
#[inline(always)]
fn from_f16(halves: uint32x4_t) -> float32x4_t {
    /// 2^112: difference of the exponent biases.
    const REBIAS: f32 = f32::from_bits((127 + 112) << 23);
    neon!({
        let magnitude = vshlq_n_u32::<13>(vandq_u32(halves, vdupq_n_u32(0x7fff)));
        let magnitude = vmulq_f32(vreinterpretq_f32_u32(magnitude), vdupq_n_f32(REBIAS));
        let sign = vshlq_n_u32::<16>(vandq_u32(halves, vdupq_n_u32(0x8000)));
        vreinterpretq_f32_u32(vorrq_u32(vreinterpretq_u32_f32(magnitude), sign))
    })
}

/// Returns `2^a`, as [`Simd::exp2`] specifies.
#[inline(always)]
fn exp2(a: float32x4_t) -> float32x4_t {
    /// 1.5 * 2^23: adding it rounds to a whole number, which is in the low bits.
    const ROUND: f32 = 12_582_912.0;
    neon!({
        let round = vdupq_n_f32(ROUND);
        let rounded = vaddq_f32(a, round);
        let f = vsubq_f32(a, vsubq_f32(rounded, round));
        let p = vfmaq_f32(vdupq_n_f32(EXP2[3]), vdupq_n_f32(EXP2[4]), f);
        let p = vfmaq_f32(vdupq_n_f32(EXP2[2]), p, f);
        let p = vfmaq_f32(vdupq_n_f32(EXP2[1]), p, f);
        let p = vfmaq_f32(vdupq_n_f32(EXP2[0]), p, f);
        let exponent = vshlq_n_u32::<23>(vreinterpretq_u32_f32(rounded));
        vreinterpretq_f32_u32(vaddq_u32(vreinterpretq_u32_f32(p), exponent))
    })
}

impl Simd for Neon {
    type F = F32x8;
    type M = Mask8;

    const LANES: usize = LANES;

    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) -> K::Output {
        kernel.run(self)
    }

    #[inline(always)]
    fn splat(self, value: f32) -> F32x8 {
        F32x8([neon!(vdupq_n_f32(value)); 2])
    }

    #[inline(always)]
    fn load(self, values: &[f32]) -> F32x8 {
        let at = values[..LANES].as_ptr();
        // SAFETY: the slice has eight floats; the load needs only their alignment.
        F32x8(unsafe { [vld1q_f32(at), vld1q_f32(at.add(4))] })
    }

    #[inline(always)]
    fn load_f16(self, values: &[u16]) -> F32x8 {
        let at = values[..LANES].as_ptr();
        // SAFETY: the slice has eight 16-bit numbers; the load needs only their alignment.
        let halves = unsafe { vld1q_u16(at) };
        let [low, high] =
            neon!([vmovl_u16(vget_low_u16(halves)), vmovl_u16(vget_high_u16(halves))]);
        F32x8([from_f16(low), from_f16(high)])
    }

    #[inline(always)]
    fn store(self, v: F32x8, out: &mut [f32]) {
        let at = out[..LANES].as_mut_ptr();
        // SAFETY: the slice has room for eight floats; the store needs only their alignment.
        unsafe {
            vst1q_f32(at, v.0[0]);
            vst1q_f32(at.add(4), v.0[1]);
        }
    }

    #[inline(always)]
    fn mul_add(self, a: F32x8, b: F32x8, c: F32x8) -> F32x8 {
        F32x8(neon!([vfmaq_f32(c.0[0], a.0[0], b.0[0]), vfmaq_f32(c.0[1], a.0[1], b.0[1])]))
    }

    #[inline(always)]
    fn neg_mul_add(self, a: F32x8, b: F32x8, c: F32x8) -> F32x8 {
        F32x8(neon!([vfmsq_f32(c.0[0], a.0[0], b.0[0]), vfmsq_f32(c.0[1], a.0[1], b.0[1])]))
    }

    #[inline(always)]
    fn min(self, a: F32x8, b: F32x8) -> F32x8 {
        F32x8(neon!([vminnmq_f32(a.0[0], b.0[0]), vminnmq_f32(a.0[1], b.0[1])]))
    }

    #[inline(always)]
    fn max(self, a: F32x8, b: F32x8) -> F32x8 {
        F32x8(neon!([vmaxnmq_f32(a.0[0], b.0[0]), vmaxnmq_f32(a.0[1], b.0[1])]))
    }

    #[inline(always)]
    fn sqrt(self, a: F32x8) -> F32x8 {
        F32x8(neon!([vsqrtq_f32(a.0[0]), vsqrtq_f32(a.0[1])]))
    }

    #[inline(always)]
    fn floor(self, a: F32x8) -> F32x8 {
        F32x8(neon!([vrndmq_f32(a.0[0]), vrndmq_f32(a.0[1])]))
    }

    #[inline(always)]
    fn exp2(self, a: F32x8) -> F32x8 {
        F32x8([exp2(a.0[0]), exp2(a.0[1])])
    }

    #[inline(always)]
    fn negative(self, a: F32x8) -> F32x8 {
        F32x8(a.0.map(|a| {
            neon!(vreinterpretq_f32_u32(vorrq_u32(vreinterpretq_u32_f32(a), vdupq_n_u32(1 << 31))))
        }))
    }

    #[inline(always)]
    fn sum(self, a: F32x8) -> f32 {
        neon!(vaddvq_f32(vaddq_f32(a.0[0], a.0[1])))
    }

    #[inline(always)]
    fn lt(self, a: F32x8, b: F32x8) -> Mask8 {
        Mask8(neon!([vcltq_f32(a.0[0], b.0[0]), vcltq_f32(a.0[1], b.0[1])]))
    }

    #[inline(always)]
    fn select(self, m: Mask8, a: F32x8, b: F32x8) -> F32x8 {
        F32x8(neon!([vbslq_f32(m.0[0], a.0[0], b.0[0]), vbslq_f32(m.0[1], a.0[1], b.0[1])]))
    }

    #[inline(always)]
    fn keep(self, m: Mask8, a: F32x8) -> F32x8 {
        let [low, high] = a.0;
        F32x8(neon!([
            vreinterpretq_f32_u32(vandq_u32(vreinterpretq_u32_f32(low), m.0[0])),
            vreinterpretq_f32_u32(vandq_u32(vreinterpretq_u32_f32(high), m.0[1])),
        ]))
    }

    #[inline(always)]
    fn bits(self, m: Mask8) -> u32 {
        /// Bit of each lane.
        const BITS: [u32; LANES] = [1, 2, 4, 8, 16, 32, 64, 128];
        // SAFETY: the array has eight numbers.
        let bits = unsafe { [vld1q_u32(BITS.as_ptr()), vld1q_u32(BITS.as_ptr().add(4))] };
        // The bits are disjoint, so the sum is the union.
        neon!(vaddvq_u32(vorrq_u32(vandq_u32(m.0[0], bits[0]), vandq_u32(m.0[1], bits[1]))))
    }

    #[inline(always)]
    fn any(self, m: Mask8) -> bool {
        neon!(vmaxvq_u32(vorrq_u32(m.0[0], m.0[1]))) != 0
    }

    #[inline(always)]
    fn prefetch<T>(self, value: &T) {
        // SAFETY: a prefetch is a hint without effect on memory, and the address is that of a live reference.
        unsafe {
            std::arch::asm!(
                "prfm pldl1keep, [{}]",
                in(reg) std::ptr::from_ref(value),
                options(nostack, preserves_flags, readonly),
            );
        }
    }
}
