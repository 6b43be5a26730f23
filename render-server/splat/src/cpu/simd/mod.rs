//! Vectors of f32 for the passes: a trait, one file per instruction set, and runtime selection.
//!
//! A pass is written once, generic over [`Simd`], as a [`Kernel`]. A value of an instruction set's type exists only
//! if the processor supports it, so its methods are safe to call. [`Simd::run`] compiles the kernel for that set. All
//! unsafe code of the renderer is in this folder.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "aarch64")]
mod neon;
mod portable;
#[cfg(test)]
mod tests;

use std::f32::consts::FRAC_1_SQRT_2;
use std::ops::{Add, BitAnd, Div, Mul, Sub};

#[cfg(target_arch = "x86_64")]
pub use avx2::Avx2;
#[cfg(target_arch = "x86_64")]
pub use avx512::Avx512;
#[cfg(target_arch = "aarch64")]
pub use neon::Neon;
pub use portable::Portable;

/// Operations on one vector of f32. Comparisons with NaN are false.
pub trait Simd: Copy + Send + Sync + 'static {
    /// Vector of [`Self::LANES`] numbers.
    type F: Copy
        + Add<Output = Self::F>
        + Sub<Output = Self::F>
        + Mul<Output = Self::F>
        + Div<Output = Self::F>;
    /// One flag per lane.
    type M: Copy + BitAnd<Output = Self::M>;

    /// Number of lanes of a vector: 8 or 16.
    const LANES: usize;

    /// Runs a kernel, compiled for this instruction set.
    fn run<K: Kernel>(self, kernel: K) -> K::Output;

    /// Returns a vector of one value.
    fn splat(self, value: f32) -> Self::F;
    /// Loads the first `LANES` values.
    fn load(self, values: &[f32]) -> Self::F;
    /// Loads the first `LANES` half-precision values.
    fn load_f16(self, values: &[u16]) -> Self::F;
    /// Stores to the first `LANES` elements of `out`.
    fn store(self, v: Self::F, out: &mut [f32]);

    /// Returns `a * b + c`.
    fn mul_add(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// Returns `c - a * b`.
    fn neg_mul_add(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// Returns the lesser; `b` where `a` is NaN.
    fn min(self, a: Self::F, b: Self::F) -> Self::F;
    /// Returns the greater; `b` where `a` is NaN.
    fn max(self, a: Self::F, b: Self::F) -> Self::F;
    /// Returns the square root.
    fn sqrt(self, a: Self::F) -> Self::F;
    /// Returns the value rounded down to a whole number.
    fn floor(self, a: Self::F) -> Self::F;
    /// Returns `2^a` within 3e-6 relative for `a` in -126 to 127; unspecified outside, but without a trap.
    fn exp2(self, a: Self::F) -> Self::F;
    /// Returns the binary logarithm within 1e-6 for positive `a`, and -127 for 0. Plain code that compiles to the
    /// set's instructions when inlined.
    #[inline(always)]
    fn log2(self, a: Self::F) -> Self::F {
        let mut lanes = [1.0; 16];
        self.store(a, &mut lanes);
        self.load(&lanes.map(log2))
    }
    /// Returns `-|a|`.
    fn negative(self, a: Self::F) -> Self::F;

    /// Returns the sum of all lanes.
    fn sum(self, a: Self::F) -> f32;

    /// Returns the mask of lanes with `a < b`.
    fn lt(self, a: Self::F, b: Self::F) -> Self::M;
    /// Returns `a` where the flag is set, else `b`.
    fn select(self, m: Self::M, a: Self::F, b: Self::F) -> Self::F;
    /// Returns `a` where the flag is set, else 0.
    fn keep(self, m: Self::M, a: Self::F) -> Self::F;
    /// Returns the flags as bits, lane 0 in the lowest bit.
    fn bits(self, m: Self::M) -> u32;
    /// Returns whether any flag is set.
    fn any(self, m: Self::M) -> bool;

    /// Returns, for each bit position from the lowest, which of the bytes have that bit set; the first byte is the
    /// lowest bit. Plain code, like [`Self::log2`].
    #[inline(always)]
    fn bit_planes(self, bytes: &[u8; 64]) -> [u64; 8] {
        let mut planes = [0; 8];
        for (i, eight) in bytes.as_chunks().0.iter().enumerate() {
            let bits = transpose(u64::from_le_bytes(*eight)).to_le_bytes();
            for (plane, bits) in planes.iter_mut().zip(bits) {
                *plane |= u64::from(bits) << (8 * i);
            }
        }
        planes
    }

    /// Prefetches the cache line at `value`.
    fn prefetch<T>(self, value: &T);
}

/// Piece of a pass that is compiled for each instruction set. `run` and all functions that it calls are marked
/// `#[inline(always)]`, because only inlined code is compiled with the set's instructions.
pub trait Kernel {
    /// Result of the kernel.
    type Output;
    /// Runs the kernel.
    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

/// Coefficients of `2^f` on [-1/2, 1/2], minimax in relative error: 2.6e-6 (fitted by reweighted least squares). An
/// alpha with this relative error changes an image at 110 dB. One term less saves a cycle in the innermost loop.
const EXP2: [f32; 5] = [0.999_999_3, 0.693_121_8, 0.240_247_45, 0.055_917_86, 0.009_570_1];

/// Returns the binary logarithm of a non-negative number, without branches.
#[inline(always)]
fn log2(a: f32) -> f32 {
    // Exponent for which the mantissa is within sqrt(1/2) to sqrt(2).
    let exponent = (a.to_bits().wrapping_sub(FRAC_1_SQRT_2.to_bits()) as i32) >> 23;
    let rest = f32::from_bits(a.to_bits().wrapping_sub((exponent << 23) as u32));
    // log2 r = 2 / ln 2 atanh s, with s below 0.172: the series' next term is below 5e-8.
    let s = (rest - 1.0) / (rest + 1.0);
    let ss = s * s;
    let series = ((ss * (1.0 / 7.0) + 1.0 / 5.0) * ss + 1.0 / 3.0) * ss + 1.0;
    exponent as f32 + 2.0 * std::f32::consts::LOG2_E * s * series
}

/// Transposes 8x8 bits, one byte per row: by halves, quarters and eighths (Warren 2012, "Hacker's Delight", 7-3).
#[inline(always)]
fn transpose(rows: u64) -> u64 {
    let mut bits = rows;
    for (shift, upper_right) in
        [(7, 0x00aa_00aa_00aa_00aa), (14, 0x0000_cccc_0000_cccc), (28, 0x0000_0000_f0f0_f0f0)]
    {
        let swapped = (bits ^ (bits >> shift)) & upper_right;
        bits ^= swapped ^ (swapped << shift);
    }
    bits
}

/// Instruction sets that this build supports.
#[derive(Clone, Copy, Debug)]
pub enum InstructionSet {
    /// AVX-512, 16 lanes.
    #[cfg(target_arch = "x86_64")]
    Avx512(Avx512),
    /// AVX2, 8 lanes.
    #[cfg(target_arch = "x86_64")]
    Avx2(Avx2),
    /// NEON, two registers of 4 lanes.
    #[cfg(target_arch = "aarch64")]
    Neon(Neon),
    /// Plain arrays of 8 lanes.
    Portable(Portable),
}

impl InstructionSet {
    /// Returns the sets that this processor supports, fastest first; never empty.
    pub fn available() -> Vec<Self> {
        #[cfg(target_arch = "x86_64")]
        let wide = [Avx512::detect().map(Self::Avx512), Avx2::detect().map(Self::Avx2)];
        #[cfg(target_arch = "aarch64")]
        let wide = [Some(Self::Neon(Neon))];
        #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
        let wide: [Option<Self>; 0] = [];
        wide.into_iter().flatten().chain([Self::Portable(Portable)]).collect()
    }

    /// Returns the number of lanes of its vectors: 8 or 16.
    pub fn lanes(self) -> usize {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(_) => Avx512::LANES,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(_) => Avx2::LANES,
            #[cfg(target_arch = "aarch64")]
            Self::Neon(_) => Neon::LANES,
            Self::Portable(_) => Portable::LANES,
        }
    }

    /// Runs a kernel, compiled for this set.
    pub fn run<K: Kernel>(self, kernel: K) -> K::Output {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(simd) => simd.run(kernel),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(simd) => simd.run(kernel),
            #[cfg(target_arch = "aarch64")]
            Self::Neon(simd) => simd.run(kernel),
            Self::Portable(simd) => simd.run(kernel),
        }
    }

    /// Returns the name for reports: `cpu avx2`.
    pub fn name(self) -> &'static str {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(_) => "cpu avx512",
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(_) => "cpu avx2",
            #[cfg(target_arch = "aarch64")]
            Self::Neon(_) => "cpu neon",
            Self::Portable(_) => "cpu portable",
        }
    }
}
