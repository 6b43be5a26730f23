//! Reduces the number of splats, the least important first.

use rayon::prelude::*;

use crate::Splats;

/// Marks the `count` most important splats. Of equally important splats, the first are preferred.
///
/// Importance is the covered area: opacity times the product of the two largest standard
/// deviations. Small splats are usually where many overlap, large ones where they cover an area
/// without others.
pub(super) fn most_important(splats: &Splats, count: usize) -> Vec<bool> {
    if count >= splats.len() {
        return vec![true; splats.len()];
    }
    let mut ranked: Vec<(f32, u32)> = splats
        .scales_m
        .par_iter()
        .zip(&splats.opacities)
        .enumerate()
        .map(|(index, (scales, opacity))| {
            let [a, b, c] = scales.to_array();
            (opacity * (a * b).max(b * c).max(c * a), index as u32)
        })
        .collect();
    let first = |a: &(f32, u32), b: &(f32, u32)| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1));
    if let Some(last) = count.checked_sub(1) {
        ranked.select_nth_unstable_by(last, first);
    }
    let mut keep = vec![false; splats.len()];
    for (_, index) in &ranked[..count] {
        keep[*index as usize] = true;
    }
    keep
}
