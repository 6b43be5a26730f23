//! Plain arrays, which the compiler vectorises with the target's baseline instructions.

use std::array;
use std::ops::{Add, BitAnd, Div, Mul, Sub};

use super::{EXP2, Kernel, Simd};

/// Portable instruction set; needs no processor features.
#[derive(Clone, Copy, Debug)]
pub struct Portable;

const LANES: usize = 8;

#[derive(Clone, Copy)]
pub struct F32x8([f32; LANES]);

/// Mask: all bits of a lane are set or none, like the result of vector comparisons.
#[derive(Clone, Copy)]
pub struct Mask8([u32; LANES]);

#[inline(always)]
fn map2(a: F32x8, b: F32x8, f: impl Fn(f32, f32) -> f32) -> F32x8 {
    F32x8(array::from_fn(|i| f(a.0[i], b.0[i])))
}

macro_rules! operators {
    ($($name:ident $method:ident $op:tt;)*) => {$(
        impl $name for F32x8 {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                map2(self, other, |a, b| a $op b)
            }
        }
    )*};
}
operators! { Add add +; Sub sub -; Mul mul *; Div div /; }

impl BitAnd for Mask8 {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        Self(array::from_fn(|i| self.0[i] & other.0[i]))
    }
}

/// Fused if that is one instruction; on other targets it would be a function call.
#[inline(always)]
fn mul_add(a: f32, b: f32, c: f32) -> f32 {
    if cfg!(any(target_arch = "aarch64", target_feature = "fma")) {
        a.mul_add(b, c)
    } else {
        a * b + c
    }
}

/// Converts half to single precision without branches; exact except for infinities and NaN, which never occur.
#[inline(always)]
fn from_f16(half: u16) -> f32 {
    /// 2^112: difference of the exponent biases.
    const REBIAS: f32 = f32::from_bits((127 + 112) << 23);
    let magnitude = f32::from_bits(u32::from(half & 0x7fff) << 13) * REBIAS;
    f32::from_bits(magnitude.to_bits() | (u32::from(half & 0x8000) << 16))
}

impl Simd for Portable {
    type F = F32x8;
    type M = Mask8;

    const LANES: usize = LANES;

    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) -> K::Output {
        kernel.run(self)
    }

    #[inline(always)]
    fn splat(self, value: f32) -> F32x8 {
        F32x8([value; LANES])
    }

    #[inline(always)]
    fn load(self, values: &[f32]) -> F32x8 {
        let values = &values[..LANES];
        F32x8(array::from_fn(|i| values[i]))
    }

    #[inline(always)]
    fn load_f16(self, values: &[u16]) -> F32x8 {
        let values = &values[..LANES];
        F32x8(array::from_fn(|i| from_f16(values[i])))
    }

    #[inline(always)]
    fn store(self, v: F32x8, out: &mut [f32]) {
        out[..LANES].copy_from_slice(&v.0);
    }

    #[inline(always)]
    fn mul_add(self, a: F32x8, b: F32x8, c: F32x8) -> F32x8 {
        F32x8(array::from_fn(|i| mul_add(a.0[i], b.0[i], c.0[i])))
    }

    #[inline(always)]
    fn neg_mul_add(self, a: F32x8, b: F32x8, c: F32x8) -> F32x8 {
        F32x8(array::from_fn(|i| mul_add(-a.0[i], b.0[i], c.0[i])))
    }

    #[inline(always)]
    fn min(self, a: F32x8, b: F32x8) -> F32x8 {
        map2(a, b, |a, b| if a < b { a } else { b })
    }

    #[inline(always)]
    fn max(self, a: F32x8, b: F32x8) -> F32x8 {
        map2(a, b, |a, b| if a > b { a } else { b })
    }

    #[inline(always)]
    fn sqrt(self, a: F32x8) -> F32x8 {
        F32x8(a.0.map(f32::sqrt))
    }

    #[inline(always)]
    fn floor(self, a: F32x8) -> F32x8 {
        F32x8(a.0.map(f32::floor))
    }

    #[inline(always)]
    fn exp2(self, a: F32x8) -> F32x8 {
        /// 1.5 * 2^23: adding it rounds to a whole number, which is in the low bits.
        const ROUND: f32 = 12_582_912.0;
        F32x8(a.0.map(|x| {
            let rounded = x + ROUND;
            let f = x - (rounded - ROUND);
            let p = mul_add(EXP2[4], f, EXP2[3]);
            let p = mul_add(p, f, EXP2[2]);
            let p = mul_add(p, f, EXP2[1]);
            let p = mul_add(p, f, EXP2[0]);
            f32::from_bits(p.to_bits().wrapping_add(rounded.to_bits() << 23))
        }))
    }

    #[inline(always)]
    fn negative(self, a: F32x8) -> F32x8 {
        F32x8(a.0.map(|x| -x.abs()))
    }

    #[inline(always)]
    fn sum(self, a: F32x8) -> f32 {
        let [a, b, c, d, e, f, g, h] = a.0;
        ((a + e) + (c + g)) + ((b + f) + (d + h))
    }

    #[inline(always)]
    fn lt(self, a: F32x8, b: F32x8) -> Mask8 {
        Mask8(array::from_fn(|i| if a.0[i] < b.0[i] { u32::MAX } else { 0 }))
    }

    #[inline(always)]
    fn select(self, m: Mask8, a: F32x8, b: F32x8) -> F32x8 {
        F32x8(array::from_fn(|i| {
            f32::from_bits(a.0[i].to_bits() & m.0[i] | b.0[i].to_bits() & !m.0[i])
        }))
    }

    #[inline(always)]
    fn keep(self, m: Mask8, a: F32x8) -> F32x8 {
        F32x8(array::from_fn(|i| f32::from_bits(a.0[i].to_bits() & m.0[i])))
    }

    #[inline(always)]
    fn bits(self, m: Mask8) -> u32 {
        (0..LANES).fold(0, |bits, i| bits | m.0[i] & 1 << i)
    }

    #[inline(always)]
    fn any(self, m: Mask8) -> bool {
        m.0.iter().fold(0, |any, &flag| any | flag) != 0
    }

    #[inline(always)]
    fn prefetch<T>(self, _value: &T) {}
}
