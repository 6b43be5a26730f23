//! Statistics over flights, with confidence intervals.

use serde::{Deserialize, Serialize};
use vizflyt_protocol::random::{GOLDEN, SplitMix64};

/// A value and its 95 % interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Interval {
    pub value: f64,
    /// Lower end of the interval.
    pub low: f64,
    /// Upper end of the interval.
    pub high: f64,
}

/// Standard score of a two-sided 95 % interval.
const Z: f64 = 1.959_963_984_540_054;
/// Resamples of the bootstrap: the ends are accurate to about 1 % of the interval.
const RESAMPLES: usize = 10_000;

/// Returns the share `part` of `whole` with its interval by Wilson (1927), which is valid for few
/// flights and for shares of 0 and 1.
pub(crate) fn share_interval(part: usize, whole: usize) -> Interval {
    if whole == 0 {
        return Interval { value: 0.0, low: 0.0, high: 1.0 };
    }
    let (n, p) = (whole as f64, part as f64 / whole as f64);
    let center = (p + Z * Z / (2.0 * n)) / (1.0 + Z * Z / n);
    let half = Z / (1.0 + Z * Z / n) * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
    Interval { value: p, low: (center - half).max(0.0), high: (center + half).min(1.0) }
}

/// Returns the mean with its interval by the percentile bootstrap (Efron 1979), with a fixed seed.
pub(crate) fn mean_interval(values: &[f64]) -> Interval {
    if values.is_empty() {
        return Interval { value: 0.0, low: 0.0, high: 0.0 };
    }
    let mean = |sum: f64| sum / values.len() as f64;
    let mut random = SplitMix64::new(GOLDEN);
    let mut means: Vec<f64> = (0..RESAMPLES)
        .map(|_| {
            let picks =
                (0..values.len()).map(|_| values[(random.bits() % values.len() as u64) as usize]);
            mean(picks.sum())
        })
        .collect();
    means.sort_by(f64::total_cmp);
    Interval {
        value: mean(values.iter().sum()),
        low: means[RESAMPLES / 40],
        high: means[RESAMPLES - 1 - RESAMPLES / 40],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matches_published_wilson_intervals() {
        // Newcombe (1998), table I: 81 of 263 and 0 of 20.
        let found = share_interval(81, 263);
        assert!((found.low - 0.2553).abs() < 1e-4 && (found.high - 0.3662).abs() < 1e-4);
        let none = share_interval(0, 20);
        assert!(none.low == 0.0 && (none.high - 0.1611).abs() < 1e-4, "{none:?}");
        assert_eq!(share_interval(20, 20).high, 1.0);
        assert_eq!(share_interval(0, 0).high, 1.0);
    }

    #[test]
    fn bootstrap_is_reproducible_and_close_to_the_normal_interval() {
        let values: Vec<f64> = (0..100).map(|i| f64::from(i % 10)).collect();
        let found = mean_interval(&values);
        // Standard error of the mean: 2.872 / 10.
        assert!((found.value - 4.5).abs() < 1e-12);
        assert!((found.low - (4.5 - Z * 0.2872)).abs() < 0.05, "{found:?}");
        assert!((found.high - (4.5 + Z * 0.2872)).abs() < 0.05, "{found:?}");
        assert_eq!(mean_interval(&values), found);
        assert_eq!(mean_interval(&[3.0]), Interval { value: 3.0, low: 3.0, high: 3.0 });
        assert_eq!(mean_interval(&[]).value, 0.0);
    }
}
