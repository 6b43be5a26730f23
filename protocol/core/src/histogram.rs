//! Durations counted by their logarithm: quantiles to within 1.6 %, in 3 KB however many.
//!
//! Both ends of the wire count with it, so that their percentiles mean the same. Adding one costs
//! some nanoseconds: the bucket is the upper bits of the number itself.

use crate::messages::StageTimes;

/// Counts of durations from 1 us to 16 s; shorter and longer ones count as those.
#[derive(Clone, Debug)]
pub struct Histogram {
    counts: [u32; BUCKETS],
    count: u64,
    max_ms: f32,
}

/// Buckets of an octave: the upper 5 bits of the mantissa.
const OCTAVE_BITS: u32 = 5;
/// 24 octaves above a microsecond are 16.8 s.
const BUCKETS: usize = 24 << OCTAVE_BITS;
const SHIFT: u32 = f32::MANTISSA_DIGITS - 1 - OCTAVE_BITS;
/// What `1.0` has above the kept bits: the exponent's bias.
const BIAS: u32 = 127 << OCTAVE_BITS;
const US_PER_MS: f32 = 1e3;

impl Default for Histogram {
    fn default() -> Self {
        Self { counts: [0; BUCKETS], count: 0, max_ms: 0.0 }
    }
}

impl Histogram {
    /// Takes one duration; one that is negative or no number counts as 0. [ms]
    pub fn add(&mut self, ms: f64) {
        let ms = if ms > 0.0 { ms as f32 } else { 0.0 };
        let counted = &mut self.counts[bucket(ms)];
        *counted = counted.saturating_add(1);
        self.count += 1;
        self.max_ms = self.max_ms.max(ms);
    }

    /// Adds everything that `other` counted.
    pub fn merge(&mut self, other: &Self) {
        for (mine, theirs) in self.counts.iter_mut().zip(&other.counts) {
            *mine = mine.saturating_add(*theirs);
        }
        self.count += other.count;
        self.max_ms = self.max_ms.max(other.max_ms);
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// Returns how many were counted.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Returns the longest; 0 if there is none. [ms]
    pub fn max_ms(&self) -> f64 {
        f64::from(self.max_ms)
    }

    /// Returns the duration that a share `q` of all do not exceed; 0 if there is none. [ms]
    pub fn quantile_ms(&self, q: f64) -> f64 {
        let rank = libm::ceil(q * self.count as f64).max(1.0) as u64;
        let mut seen = 0;
        for (index, &count) in self.counts.iter().enumerate() {
            seen += u64::from(count);
            if seen >= rank {
                return f64::from(middle_ms(index).min(self.max_ms));
            }
        }
        f64::from(self.max_ms)
    }

    /// Returns the percentiles that are reported. [ms]
    pub fn times(&self) -> StageTimes {
        StageTimes {
            p50: self.quantile_ms(0.5) as f32,
            p90: self.quantile_ms(0.9) as f32,
            p99: self.quantile_ms(0.99) as f32,
            max: self.max_ms,
        }
    }
}

fn bucket(ms: f32) -> usize {
    let us = (ms * US_PER_MS).max(1.0);
    (((us.to_bits() >> SHIFT) - BIAS) as usize).min(BUCKETS - 1)
}

fn middle_ms(index: usize) -> f32 {
    let half = 1 << (SHIFT - 1);
    f32::from_bits(((index as u32 + BIAS) << SHIFT) | half) / US_PER_MS
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec;

    #[test]
    fn an_empty_histogram_has_no_percentiles() {
        let histogram = Histogram::default();
        assert_eq!(histogram.times(), StageTimes::default());
        assert_eq!((histogram.count(), histogram.max_ms()), (0, 0.0));
    }

    #[test]
    fn extremes_land_in_the_end_buckets() {
        let mut histogram = Histogram::default();
        for ms in [-1.0, 0.0, f64::NAN, f64::NEG_INFINITY] {
            histogram.add(ms);
        }
        assert_eq!(histogram.times(), StageTimes::default());
        histogram.add(f64::INFINITY);
        histogram.add(1e300);
        assert_eq!(histogram.count(), 6);
        assert!(histogram.quantile_ms(0.99) > 16_000.0);
    }

    proptest! {
        /// Against the sorted durations themselves.
        #[test]
        fn quantiles_are_those_of_the_durations(
            mut durations in prop::collection::vec(0.001f64..16_000.0, 1..500),
            split in 0usize..500,
            q in 0.0f64..1.0,
        ) {
            let (mut one, mut two) = (Histogram::default(), Histogram::default());
            for (index, &ms) in durations.iter().enumerate() {
                if index < split { one.add(ms) } else { two.add(ms) }
            }
            one.merge(&two);
            durations.sort_by(f64::total_cmp);
            let rank = ((q * durations.len() as f64).ceil() as usize).max(1);
            let expected = durations[rank - 1];
            let found = one.quantile_ms(q);
            prop_assert!((found / expected - 1.0).abs() < 0.017, "{found} for {expected}");
            let max = *durations.last().unwrap();
            prop_assert!((one.max_ms() / max - 1.0).abs() < 1e-6);
            prop_assert_eq!(one.count(), durations.len() as u64);
        }

        #[test]
        fn buckets_hold_their_middle(index in 0..BUCKETS) {
            prop_assert_eq!(bucket(middle_ms(index)), index);
        }
    }

    #[test]
    fn buckets_rise() {
        let middles: Vec<_> = (0..BUCKETS).map(middle_ms).collect();
        assert!(middles.is_sorted_by(|a, b| a < b));
    }
}
