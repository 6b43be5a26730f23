//! Where Gaussians are needed: those that died go where others live, and their number grows to a
//! budget (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo").
//!
//! A Gaussian that becomes `n` keeps its picture: equation 9 there gives the opacity and the scale of
//! the parts. Faint ones wander by noise shaped as they are (equation 8), so that they find work.

use glam::{Mat3, Quat, Vec3};

use crate::adam::Moments;
use crate::gaussians::{Gaussians, column, logit, sigmoid};
use crate::random::Random;

/// Fainter is dead.
pub(crate) const DEAD_OPACITY: f32 = 0.005;
/// No Gaussian becomes more at once.
const MAX_PARTS: usize = 51;

/// Moves the dead to the living and adds up to `grow` more; returns how many were dead.
pub(crate) fn relocate(
    gaussians: &mut Gaussians,
    moments: &mut Moments,
    grow: usize,
    random: &mut Random,
) -> usize {
    let count = gaussians.len();
    let opacities: Vec<f32> =
        (0..count).map(|i| sigmoid(gaussians.row(i)[column::LOGIT])).collect();
    let is_dead = |&i: &usize| !(opacities[i] > DEAD_OPACITY);
    let dead: Vec<usize> = (0..count).filter(is_dead).collect();
    // Running sums, to draw the living by their opacity.
    let mut sum = 0.0;
    let sums: Vec<f64> = (0..count)
        .map(|i| {
            sum += if is_dead(&i) { 0.0 } else { f64::from(opacities[i]) };
            sum
        })
        .collect();
    if !(sum > 0.0) {
        return dead.len();
    }
    let mut parts = vec![1usize; count];
    let mut moves = Vec::with_capacity(dead.len() + grow);
    let to = dead.iter().copied().map(Some).chain(std::iter::repeat_n(None, grow));
    for to in to {
        let at = f64::from(random.unit()) * sum;
        let from = sums.partition_point(|&s| s <= at).min(count - 1);
        parts[from] += 1;
        moves.push((from, to));
    }
    for (from, &n) in parts.iter().enumerate().filter(|(_, n)| **n > 1) {
        split(gaussians.row_mut(from), n.min(MAX_PARTS));
        moments.first.row_mut(from).fill(0.0);
        moments.second.row_mut(from).fill(0.0);
    }
    let stride = gaussians.stride();
    for (from, to) in moves {
        let from = from * stride..(from + 1) * stride;
        match to {
            Some(to) => {
                gaussians.values.copy_within(from, to * stride);
                moments.first.row_mut(to).fill(0.0);
                moments.second.row_mut(to).fill(0.0);
            }
            None => gaussians.values.extend_from_within(from),
        }
    }
    let len = gaussians.values.len();
    moments.first.values.resize(len, 0.0);
    moments.second.values.resize(len, 0.0);
    dead.len()
}

/// Makes a row one of `n` in the same place that look like it together.
fn split(row: &mut [f32], n: usize) {
    let opacity = f64::from(sigmoid(row[column::LOGIT])).min(0.9999);
    let part = 1.0 - (1.0 - opacity).powf(1.0 / n as f64);
    // sum_(i = 1..n) sum_(k = 0..i - 1) C(i - 1, k) (-1)^k part^(k + 1) / sqrt(k + 1)
    let mut sum = 0.0;
    for i in 1..=n {
        let mut choose = 1.0;
        for k in 0..i {
            let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
            sum += sign * choose * part.powi(k as i32 + 1) / ((k + 1) as f64).sqrt();
            choose *= (i - 1 - k) as f64 / (k + 1) as f64;
        }
    }
    let factor = opacity / sum;
    if factor.is_finite() && factor > 0.0 {
        for log in &mut row[column::LOG_SCALE..column::ROTATION] {
            *log += factor.ln() as f32;
        }
    }
    row[column::LOGIT] = logit((part as f32).max(DEAD_OPACITY * 1.01));
}

/// Moves faint rows of `seen` by noise of their own shape, `strength` times their covariance.
pub(crate) fn wander(gaussians: &mut Gaussians, seen: &[u32], strength: f32, seed: u64) {
    for &row in seen {
        let values = gaussians.row_mut(row as usize);
        let opacity = sigmoid(values[column::LOGIT]);
        // A step at 0.005; what is well visible stays.
        let faint = sigmoid(-100.0 * (opacity - DEAD_OPACITY));
        if faint < 1e-4 {
            continue;
        }
        let mut random = Random::stream(seed, u64::from(row));
        let noise = Vec3::new(random.normal(), random.normal(), random.normal());
        let rotation = Mat3::from_quat(Quat::from_slice(&values[column::ROTATION..]).normalize());
        let scales = Vec3::from_slice(&values[column::LOG_SCALE..]).to_array().map(f32::exp);
        let scales = Vec3::from(scales);
        let moved = rotation * (scales * scales * (rotation.transpose() * noise));
        for (value, step) in values.iter_mut().zip((moved * (strength * faint)).to_array()) {
            *value += step;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn some() -> Gaussians {
        let mut gaussians = Gaussians::new(0);
        for (x, opacity) in [(0.0, 0.001), (1.0, 0.8), (2.0, 0.0001), (3.0, 0.6)] {
            gaussians.push(Vec3::X * x, Vec3::splat(0.1), Quat::IDENTITY, opacity, [0.5; 3]);
        }
        gaussians
    }

    #[test]
    fn the_dead_move_to_the_living_and_new_ones_come() {
        let mut gaussians = some();
        let mut moments = Moments::of(&gaussians);
        moments.first.values.fill(1.0);
        let dead = relocate(&mut gaussians, &mut moments, 5, &mut Random::new(1));
        assert_eq!((dead, gaussians.len(), moments.second.len()), (2, 9, 9));
        for i in 0..9 {
            let row = gaussians.row(i);
            assert!(row[0] == 1.0 || row[0] == 3.0);
            assert!(sigmoid(row[column::LOGIT]) > DEAD_OPACITY);
        }
    }

    #[test]
    fn parts_look_like_the_whole() {
        // Seen from afar, through its centre and beside it: transmittance of n parts and of the one.
        for (opacity, n) in [(0.8f32, 2), (0.5, 3), (0.95, 5)] {
            let mut gaussians = Gaussians::new(0);
            gaussians.push(Vec3::ZERO, Vec3::ONE, Quat::IDENTITY, opacity, [0.5; 3]);
            split(gaussians.row_mut(0), n);
            let row = gaussians.row(0);
            let (part, scale) = (sigmoid(row[column::LOGIT]), row[column::LOG_SCALE].exp());
            let alpha = |o: f32, s: f32, x: f32| o * (-x * x / (2.0 * s * s)).exp();
            let together = |x: f32| 1.0 - (1.0 - alpha(part, scale, x)).powi(n as i32);
            assert!((together(0.0) - opacity).abs() < 1e-3);
            // What it hides in all is the same along a line.
            let sum =
                |f: &dyn Fn(f32) -> f32| (-600..600).map(|i| f(i as f32 / 100.0)).sum::<f32>();
            let (one, many) = (sum(&|x| alpha(opacity, 1.0, x)), sum(&together));
            assert!((one / many - 1.0).abs() < 0.02, "{one} {many}");
        }
    }

    #[test]
    fn nothing_alive_is_no_panic() {
        let mut gaussians = some();
        for i in 0..4 {
            gaussians.row_mut(i)[column::LOGIT] = f32::NAN;
        }
        let mut moments = Moments::of(&gaussians);
        assert_eq!(relocate(&mut gaussians, &mut moments, 5, &mut Random::new(1)), 4);
        assert_eq!(gaussians.len(), 4);
    }

    #[test]
    fn the_faint_wander_and_the_visible_stay() {
        let mut gaussians = some();
        wander(&mut gaussians, &[0, 1, 3], 1.0, 9);
        let x = |i: usize| gaussians.row(i)[0];
        assert!(x(0) != 0.0 && x(1) == 1.0 && x(2) == 2.0 && x(3) == 3.0);
    }
}
