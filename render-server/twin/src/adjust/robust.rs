//! Robust losses, which limit the influence of outliers.

/// Returns Cauchy's loss. [sigma^2]
pub(super) fn loss(off: f64, sigma: f64) -> f64 {
    let c2 = LOSS_SIGMAS * LOSS_SIGMAS;
    c2 * ((off / sigma).powi(2) / c2).ln_1p()
}

/// Returns the weight of a squared residual by that loss: its slope divided by sigma^2.
pub(super) fn weight(off: f64, sigma: f64) -> f64 {
    let share = (off / (LOSS_SIGMAS * sigma)).powi(2);
    1.0 / (sigma * sigma * (1.0 + share))
}

/// Returns the median; `None` if there are no values.
pub(super) fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut sorted: Vec<f64> = values.collect();
    let middle = sorted.len() / 2;
    (!sorted.is_empty()).then(|| *sorted.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Prior standard deviation of the inset of tag corners, from images of our own detector. [px]
pub(super) const INSET_PX: f64 = 0.15;
/// Scale of Cauchy's loss. [sigma]
const LOSS_SIGMAS: f64 = 3.0;
