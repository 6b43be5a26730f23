//! Quantised numbers of few bits, as several formats pack them.

use std::f32::consts::SQRT_2;

/// Returns the lowest `bits` of a word, scaled to 0 to 1.
#[inline]
pub(super) fn unorm(word: u32, bits: u32) -> f32 {
    let mask = (1 << bits) - 1;
    (word & mask) as f32 / mask as f32
}

/// Quantises a value of 0 to 1 to `bits`. Values outside are clamped.
pub(super) fn to_unorm(value: f32, bits: u32) -> u32 {
    let top = ((1u32 << bits) - 1) as f32;
    (value * top).round().clamp(0.0, top) as u32
}

/// Returns a unit quaternion from the index of its largest component and the three others, in
/// order, -1 to 1 for -1/sqrt(2) to 1/sqrt(2). Input and output have the same order of components.
#[inline]
pub(super) fn wxyz_of_smallest_three(largest: u32, others: [f32; 3]) -> [f32; 4] {
    let others = others.map(|v| v / SQRT_2);
    let squares: f32 = others.iter().map(|v| v * v).sum();
    let rest = (1.0 - squares).max(0.0).sqrt();
    let [a, b, c] = others;
    match largest & 3 {
        0 => [rest, a, b, c],
        1 => [a, rest, b, c],
        2 => [a, b, rest, c],
        _ => [a, b, c, rest],
    }
}

/// Returns the index of the largest component and the three others: the inverse of
/// [`wxyz_of_smallest_three`].
pub(super) fn smallest_three(q: [f32; 4]) -> (u32, [f32; 3]) {
    let mut largest = 0;
    for i in 1..4 {
        if q[i].abs() > q[largest].abs() {
            largest = i;
        }
    }
    // A quaternion and its negative are the same rotation: the largest component is stored as
    // positive.
    let scale = if q[largest] < 0.0 { -SQRT_2 } else { SQRT_2 };
    let mut others = [0.0; 3];
    let rest = (0..4).filter(|&i| i != largest);
    for (out, i) in others.iter_mut().zip(rest) {
        *out = q[i] * scale;
    }
    (largest as u32, others)
}
