//! Histogram of durations with logarithmic bins: quantiles to within 1.6 % in 3 KB, for any number of samples.
//!
//! Both ends of the wire use it, so that their percentiles are comparable. Adding a sample takes a few nanoseconds: the
//! bin number is the upper bits of the floating-point number.

use crate::messages::StageTimes;

/// Histogram of durations from 1 us to 16 s. Shorter and longer durations count in the first and last bin.
#[derive(Clone, Debug)]
pub struct Histogram {
    counts: [u32; BUCKETS],
    count: u64,
    max_ms: f32,
}

/// Bits of the mantissa that select one of the bins of an octave.
const OCTAVE_BITS: u32 = 5;
/// Number of bins: 24 octaves above 1 us reach 16.8 s.
const BUCKETS: usize = 24 << OCTAVE_BITS;
const SHIFT: u32 = f32::MANTISSA_DIGITS - 1 - OCTAVE_BITS;
/// Bits of `1.0` above the dropped ones: the exponent's bias.
const BIAS: u32 = 127 << OCTAVE_BITS;
const US_PER_MS: f32 = 1e3;

impl Default for Histogram {
    fn default() -> Self {
        Self { counts: [0; BUCKETS], count: 0, max_ms: 0.0 }
    }
}

impl Histogram {
    /// Adds one duration. A negative duration or NaN counts as 0. [ms]
    pub fn add(&mut self, ms: f64) {
        let ms = if ms > 0.0 { ms as f32 } else { 0.0 };
        let counted = &mut self.counts[bucket(ms)];
        *counted = counted.saturating_add(1);
        self.count += 1;
        self.max_ms = self.max_ms.max(ms);
    }

    /// Adds all samples of `other`.
    pub fn merge(&mut self, other: &Self) {
        for (mine, theirs) in self.counts.iter_mut().zip(&other.counts) {
            *mine = mine.saturating_add(*theirs);
        }
        self.count += other.count;
        self.max_ms = self.max_ms.max(other.max_ms);
    }

    /// Removes all samples.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// Returns the number of samples.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Returns the longest duration, or 0 without samples. [ms]
    pub fn max_ms(&self) -> f64 {
        f64::from(self.max_ms)
    }

    /// Returns the quantile `q` (0 to 1), or 0 without samples. [ms]
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

    /// Returns the percentiles for reports. [ms]
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
        /// Compares quantiles with those of the sorted durations.
        #[test]
        fn quantiles_match_the_sorted_durations(
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
