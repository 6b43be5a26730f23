//! Losses that outliers hardly pull.

/// Returns Cauchy's loss of what is off by so much. [sigma^2]
pub(super) fn loss(off: f64, sigma: f64) -> f64 {
    let c2 = LOSS_SIGMAS * LOSS_SIGMAS;
    c2 * ((off / sigma).powi(2) / c2).ln_1p()
}

/// Returns the weight that it gives to a square: its slope, over the sigma's square.
pub(super) fn weight(off: f64, sigma: f64) -> f64 {
    let share = (off / (LOSS_SIGMAS * sigma)).powi(2);
    1.0 / (sigma * sigma * (1.0 + share))
}

/// Returns the median; `None` of nothing.
pub(super) fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut sorted: Vec<f64> = values.collect();
    let middle = sorted.len() / 2;
    (!sorted.is_empty()).then(|| *sorted.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// How far inside corners of tags are found, before they are looked at: one sigma, from images of our own detector. [px]
pub(super) const INSET_PX: f64 = 0.15;
/// Where Cauchy's loss bends: of sigmas.
const LOSS_SIGMAS: f64 = 3.0;
