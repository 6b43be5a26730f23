//! Codebook of 256 values that approximates many values.

/// Rounds of refinement. In each further round, the error would decrease by less than 1 %.
const ROUNDS: usize = 12;

/// Returns 256 values in ascending order that minimise the mean squared distance of `values` to the
/// nearest of them (Lloyd 1982, in one dimension, on sorted values).
pub(super) fn build(mut values: Vec<f32>) -> [f32; 256] {
    values.retain(|value| value.is_finite());
    values.sort_unstable_by(f32::total_cmp);
    let mut distinct = values.clone();
    distinct.dedup();
    let (Some(&first), Some(&last)) = (values.first(), values.last()) else { return [0.0; 256] };
    if distinct.len() <= 256 {
        distinct.resize(256, last);
        return std::array::from_fn(|i| distinct[i]);
    }
    // Half of the centres by rank, for dense values; half by value, for sparse values far away.
    let mut centres: [f32; 256] = std::array::from_fn(|i| {
        let share = (i / 2) as f32 / 127.0;
        match i % 2 {
            0 => values[((values.len() - 1) as f32 * share) as usize],
            _ => first * (1.0 - share) + last * share,
        }
    });
    centres.sort_unstable_by(f32::total_cmp);
    let mut sums = Vec::with_capacity(values.len() + 1);
    sums.push(0.0);
    let mut sum = 0.0;
    for &value in &values {
        sum += f64::from(value);
        sums.push(sum);
    }
    for _ in 0..ROUNDS {
        let mut start = 0;
        for i in 0..256 {
            let end = match centres.get(i + 1) {
                Some(next) => {
                    let middle = centres[i] * 0.5 + next * 0.5;
                    start + values[start..].partition_point(|&value| value <= middle)
                }
                None => values.len(),
            };
            if end > start {
                centres[i] = ((sums[end] - sums[start]) / (end - start) as f64) as f32;
            }
            start = end;
        }
        centres.sort_unstable_by(f32::total_cmp);
    }
    centres
}

/// Returns the index of the nearest value of an ascending codebook.
pub(super) fn nearest(codebook: &[f32; 256], value: f32) -> u8 {
    let above = codebook.partition_point(|&entry| entry < value).clamp(1, 255);
    let below = above - 1;
    (if value - codebook[below] <= codebook[above] - value { below } else { above }) as u8
}

#[cfg(test)]
mod tests {
    use super::{build, nearest};

    #[test]
    fn keeps_few_values_exactly() {
        let codebook = build(vec![3.0, -1.0, 3.0, 7.5]);
        for value in [3.0, -1.0, 7.5] {
            assert_eq!(codebook[usize::from(nearest(&codebook, value))], value);
        }
        assert_eq!(build(vec![f32::NAN]), [0.0; 256]);
    }

    #[test]
    fn has_a_smaller_error_than_even_steps() {
        // Most values are near zero, some are far away.
        let values: Vec<f32> = (0..20_000).map(|i| (i as f32 / 10_000.0 - 1.0).powi(5)).collect();
        let codebook = build(values.clone());
        let error = |of: &dyn Fn(f32) -> f32| -> f32 {
            values.iter().map(|&value| (of(value) - value).powi(2)).sum()
        };
        let ours = error(&|value| codebook[usize::from(nearest(&codebook, value))]);
        let even = error(&|value| ((value + 1.0) * 127.5).round() / 127.5 - 1.0);
        // The optimum for this distribution is 0.51 (Panter and Dite 1951).
        assert!(ours < even * 0.6, "{ours} against {even}");
    }
}
