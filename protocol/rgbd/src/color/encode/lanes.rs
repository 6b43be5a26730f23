//! Vectors of 16-bit integers: the same operations, and so the same results, on every machine.
//!
//! A row of a block has 8 lanes; a vector contains one row of one, two or four blocks.

#![allow(unsafe_code, reason = "intrinsics, named only by code that is compiled for them")]

/// A vector of [`Lanes::BLOCKS`] times 8 lanes. Sums wrap.
pub(super) trait Lanes: Copy {
    /// Number of blocks side by side.
    const BLOCKS: usize;

    /// Loads the first lanes of `from`, which must be long enough.
    fn load(from: &[i16]) -> Self;
    /// Stores the lanes at the start of `to`, which must be long enough.
    fn store(self, to: &mut [i16]);
    /// Returns the same value in every lane.
    fn all(value: i16) -> Self;
    /// Returns the same row in every block.
    fn every_block(row: &[i16; 8]) -> Self;
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn or(self, other: Self) -> Self;
    fn xor(self, other: Self) -> Self;
    fn and(self, other: Self) -> Self;
    /// Returns the magnitudes, unsigned.
    fn abs(self) -> Self;
    fn up<const BITS: i32>(self) -> Self;
    /// Shifts right, filling with zeros.
    fn down<const BITS: i32>(self) -> Self;
    /// Shifts right, filling with the sign.
    fn down_signed<const BITS: i32>(self) -> Self;
    /// Returns products divided by 2^15, rounded to the nearest, halves up.
    fn times(self, other: Self) -> Self;
    /// Returns unsigned products divided by 2^16, rounded down.
    fn times_unsigned(self, other: Self) -> Self;
    /// Interleaves the lanes of `self` and `other`, block by block: the first halves, and the second halves.
    fn zip(self, other: Self) -> (Self, Self);
    /// Returns a mask of the lanes above zero, one byte per block, the first lane lowest.
    fn positive(self) -> [u8; 4];
}

/// Plain code, compiled on every machine, so that tests cover it.
#[cfg_attr(target_arch = "aarch64", allow(dead_code))]
#[derive(Clone, Copy)]
pub(super) struct Plain([i16; 8]);

#[cfg_attr(target_arch = "aarch64", allow(dead_code))]
impl Plain {
    #[inline(always)]
    fn map2(self, other: Self, f: impl Fn(i16, i16) -> i16) -> Self {
        Self(std::array::from_fn(|lane| f(self.0[lane], other.0[lane])))
    }
}

impl Lanes for Plain {
    const BLOCKS: usize = 1;

    #[inline(always)]
    fn load(from: &[i16]) -> Self {
        let mut lanes = [0; 8];
        lanes.copy_from_slice(&from[..8]);
        Self(lanes)
    }
    #[inline(always)]
    fn store(self, to: &mut [i16]) {
        to[..8].copy_from_slice(&self.0);
    }
    #[inline(always)]
    fn all(value: i16) -> Self {
        Self([value; 8])
    }
    #[inline(always)]
    fn every_block(row: &[i16; 8]) -> Self {
        Self(*row)
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.map2(other, i16::wrapping_add)
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.map2(other, i16::wrapping_sub)
    }
    #[inline(always)]
    fn or(self, other: Self) -> Self {
        self.map2(other, |a, b| a | b)
    }
    #[inline(always)]
    fn xor(self, other: Self) -> Self {
        self.map2(other, |a, b| a ^ b)
    }
    #[inline(always)]
    fn and(self, other: Self) -> Self {
        self.map2(other, |a, b| a & b)
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(self.0.map(i16::wrapping_abs))
    }
    #[inline(always)]
    fn up<const BITS: i32>(self) -> Self {
        Self(self.0.map(|lane| lane << BITS))
    }
    #[inline(always)]
    fn down<const BITS: i32>(self) -> Self {
        Self(self.0.map(|lane| (lane.cast_unsigned() >> BITS).cast_signed()))
    }
    #[inline(always)]
    fn down_signed<const BITS: i32>(self) -> Self {
        Self(self.0.map(|lane| lane >> BITS))
    }
    #[inline(always)]
    fn times(self, other: Self) -> Self {
        self.map2(other, |a, b| ((i32::from(a) * i32::from(b) + (1 << 14)) >> 15) as i16)
    }
    #[inline(always)]
    fn times_unsigned(self, other: Self) -> Self {
        self.map2(other, |a, b| {
            let product = u32::from(a.cast_unsigned()) * u32::from(b.cast_unsigned());
            (product >> 16) as i16
        })
    }
    #[inline(always)]
    fn zip(self, other: Self) -> (Self, Self) {
        let turns = |half: usize| {
            let lane =
                |at| if at % 2 == 0 { self.0[half + at / 2] } else { other.0[half + at / 2] };
            Self(std::array::from_fn(lane))
        };
        (turns(0), turns(4))
    }
    #[inline(always)]
    fn positive(self) -> [u8; 4] {
        let mut bits = 0;
        for (lane, &value) in self.0.iter().enumerate() {
            bits |= u8::from(value > 0) << lane;
        }
        [bits, 0, 0, 0]
    }
}

#[cfg(target_arch = "aarch64")]
pub(super) use arm::Neon;
#[cfg(target_arch = "x86_64")]
pub(super) use x86::{Avx2, Avx512};

/// Defines a vector type. Only functions that are compiled for its instructions, and run where these are available, may
/// have values of it.
macro_rules! vectors {
    (
        $(#[$docs:meta])* $name:ident($vector:ty), $blocks:literal, $load:ident, $store:ident,
        $all:ident, $abs:ident, zip: $low:ident $high:ident, every_block: $every_block:expr,
        up: $up:expr, down: $down:expr, down_signed: $down_signed:expr, positive: $positive:expr,
        $($pair:ident: $intrinsic:expr),*
    ) => {
        $(#[$docs])*
        #[derive(Clone, Copy)]
        pub(in super::super) struct $name($vector);

        impl Lanes for $name {
            const BLOCKS: usize = $blocks;

            #[inline(always)]
            fn load(from: &[i16]) -> Self {
                let from = &from[..8 * $blocks];
                // SAFETY: the machine has the instruction, as everywhere below; these lanes are readable, and the load
                // needs no alignment.
                Self(unsafe { $load(from.as_ptr().cast()) })
            }
            #[inline(always)]
            fn store(self, to: &mut [i16]) {
                let to = &mut to[..8 * $blocks];
                // SAFETY: these lanes are writable; the store needs no alignment.
                unsafe { $store(to.as_mut_ptr().cast(), self.0) }
            }
            #[inline(always)]
            fn all(value: i16) -> Self {
                // SAFETY: works on values only.
                Self(unsafe { $all(value) })
            }
            #[inline(always)]
            fn every_block(row: &[i16; 8]) -> Self {
                // SAFETY: 16 bytes are readable; the load needs no alignment.
                Self(unsafe { $every_block(row.as_ptr()) })
            }
            #[inline(always)]
            fn abs(self) -> Self {
                // SAFETY: works on values only.
                Self(unsafe { $abs(self.0) })
            }
            #[inline(always)]
            fn up<const BITS: i32>(self) -> Self {
                // SAFETY: works on values only.
                Self(unsafe { $up(self.0, BITS) })
            }
            #[inline(always)]
            fn down<const BITS: i32>(self) -> Self {
                // SAFETY: works on values only.
                Self(unsafe { $down(self.0, BITS) })
            }
            #[inline(always)]
            fn down_signed<const BITS: i32>(self) -> Self {
                // SAFETY: works on values only.
                Self(unsafe { $down_signed(self.0, BITS) })
            }
            #[inline(always)]
            fn zip(self, other: Self) -> (Self, Self) {
                // SAFETY: works on values only.
                unsafe { (Self($low(self.0, other.0)), Self($high(self.0, other.0))) }
            }
            #[inline(always)]
            fn positive(self) -> [u8; 4] {
                // SAFETY: works on values only.
                let bits: u32 = unsafe { $positive(self.0) };
                bits.to_le_bytes()
            }
            $(
                #[inline(always)]
                fn $pair(self, other: Self) -> Self {
                    // SAFETY: works on values only.
                    Self(unsafe { $intrinsic(self.0, other.0) })
                }
            )*
        }
    };
}

/// Two blocks with AVX2, four with AVX-512BW.
#[cfg(target_arch = "x86_64")]
mod x86 {
    use core::arch::x86_64::{
        __m256i, __m512i, _mm_cvtsi32_si128, _mm_loadu_si128, _mm256_abs_epi16, _mm256_add_epi16,
        _mm256_and_si256, _mm256_broadcastsi128_si256, _mm256_cmpgt_epi16, _mm256_loadu_si256,
        _mm256_movemask_epi8, _mm256_mulhi_epu16, _mm256_mulhrs_epi16, _mm256_or_si256,
        _mm256_packs_epi16, _mm256_set1_epi16, _mm256_setzero_si256, _mm256_sll_epi16,
        _mm256_sra_epi16, _mm256_srl_epi16, _mm256_storeu_si256, _mm256_sub_epi16,
        _mm256_unpackhi_epi16, _mm256_unpacklo_epi16, _mm256_xor_si256, _mm512_abs_epi16,
        _mm512_add_epi16, _mm512_and_si512, _mm512_broadcast_i32x4, _mm512_cmpgt_epi16_mask,
        _mm512_loadu_si512, _mm512_mulhi_epu16, _mm512_mulhrs_epi16, _mm512_or_si512,
        _mm512_set1_epi16, _mm512_setzero_si512, _mm512_sll_epi16, _mm512_sra_epi16,
        _mm512_srl_epi16, _mm512_storeu_si512, _mm512_sub_epi16, _mm512_unpackhi_epi16,
        _mm512_unpacklo_epi16, _mm512_xor_si512,
    };

    use super::Lanes;

    vectors!(
        /// Two blocks, with AVX2.
        Avx2(__m256i), 2, _mm256_loadu_si256, _mm256_storeu_si256, _mm256_set1_epi16,
        _mm256_abs_epi16, zip: _mm256_unpacklo_epi16 _mm256_unpackhi_epi16,
        every_block: |row: *const i16| _mm256_broadcastsi128_si256(_mm_loadu_si128(row.cast())),
        up: |lanes, bits| _mm256_sll_epi16(lanes, _mm_cvtsi32_si128(bits)),
        down: |lanes, bits| _mm256_srl_epi16(lanes, _mm_cvtsi32_si128(bits)),
        down_signed: |lanes, bits| _mm256_sra_epi16(lanes, _mm_cvtsi32_si128(bits)),
        // The pack leaves each half's 8 lanes in that half, twice.
        positive: |lanes| {
            let above = _mm256_cmpgt_epi16(lanes, _mm256_setzero_si256());
            let bits = _mm256_movemask_epi8(_mm256_packs_epi16(above, above)).cast_unsigned();
            bits & 0xff | bits >> 8 & 0xff00
        },
        add: _mm256_add_epi16, sub: _mm256_sub_epi16, or: _mm256_or_si256, xor: _mm256_xor_si256,
        and: _mm256_and_si256, times: _mm256_mulhrs_epi16, times_unsigned: _mm256_mulhi_epu16
    );

    vectors!(
        /// Four blocks, with AVX-512BW.
        Avx512(__m512i), 4, _mm512_loadu_si512, _mm512_storeu_si512, _mm512_set1_epi16,
        _mm512_abs_epi16, zip: _mm512_unpacklo_epi16 _mm512_unpackhi_epi16,
        every_block: |row: *const i16| _mm512_broadcast_i32x4(_mm_loadu_si128(row.cast())),
        up: |lanes, bits| _mm512_sll_epi16(lanes, _mm_cvtsi32_si128(bits)),
        down: |lanes, bits| _mm512_srl_epi16(lanes, _mm_cvtsi32_si128(bits)),
        down_signed: |lanes, bits| _mm512_sra_epi16(lanes, _mm_cvtsi32_si128(bits)),
        positive: |lanes| _mm512_cmpgt_epi16_mask(lanes, _mm512_setzero_si512()),
        add: _mm512_add_epi16, sub: _mm512_sub_epi16, or: _mm512_or_si512, xor: _mm512_xor_si512,
        and: _mm512_and_si512, times: _mm512_mulhrs_epi16, times_unsigned: _mm512_mulhi_epu16
    );
}

/// One block with NEON, which is available on every ARM64.
#[cfg(target_arch = "aarch64")]
mod arm {
    use core::arch::aarch64::{
        int16x8_t, vabsq_s16, vaddq_s16, vaddvq_u16, vandq_s16, vandq_u16, vcgtzq_s16, vdupq_n_s16,
        veorq_s16, vget_low_u16, vld1q_s16, vld1q_u16, vmull_high_u16, vmull_u16, vorrq_s16,
        vqrdmulhq_s16, vreinterpretq_s16_u16, vreinterpretq_u16_s16, vreinterpretq_u16_u32,
        vshlq_s16, vshlq_u16, vst1q_s16, vsubq_s16, vuzp2q_u16, vzip1q_s16, vzip2q_s16,
    };

    use super::Lanes;

    vectors!(
        /// One block, with NEON.
        Neon(int16x8_t), 1, vld1q_s16, vst1q_s16, vdupq_n_s16, vabsq_s16,
        zip: vzip1q_s16 vzip2q_s16, every_block: |row| vld1q_s16(row),
        up: |lanes, bits: i32| vshlq_s16(lanes, vdupq_n_s16(bits as i16)),
        down: |lanes, bits: i32| {
            let shifted = vshlq_u16(vreinterpretq_u16_s16(lanes), vdupq_n_s16(-bits as i16));
            vreinterpretq_s16_u16(shifted)
        },
        down_signed: |lanes, bits: i32| vshlq_s16(lanes, vdupq_n_s16(-bits as i16)),
        positive: |lanes| {
            let each = vld1q_u16([1, 2, 4, 8, 16, 32, 64, 128].as_ptr());
            u32::from(vaddvq_u16(vandq_u16(vcgtzq_s16(lanes), each)))
        },
        add: vaddq_s16, sub: vsubq_s16, or: vorrq_s16, xor: veorq_s16, and: vandq_s16,
        times: vqrdmulhq_s16,
        times_unsigned: |a, b| {
            let (a, b) = (vreinterpretq_u16_s16(a), vreinterpretq_u16_s16(b));
            let low = vreinterpretq_u16_u32(vmull_u16(vget_low_u16(a), vget_low_u16(b)));
            let high = vreinterpretq_u16_u32(vmull_high_u16(a, b));
            vreinterpretq_s16_u16(vuzp2q_u16(low, high))
        }
    );
}
