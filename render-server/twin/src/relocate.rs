//! Relocation and growth: dead Gaussians move to where the image is wrong, and the number grows up to a maximum.
//!
//! As in Kheradmand et al. 2024 ("3D Gaussian Splatting as Markov Chain Monte Carlo"), no thresholds clone or prune
//! Gaussians. Dead ones move to living ones, and faint ones move by noise of their own shape (equation 8 there) until
//! they become useful.
//!
//! Two differences:
//! - Targets are drawn by the error seen through each Gaussian (Rota Bulo et al. 2024, "Revising Densification"), not
//!   by opacity: a floor without corners begins with few, large Gaussians.
//! - Gaussians are halved across their longest axis instead of stacked in one place: a surface remains one opaque
//!   layer, as baking into obstacles requires.

use glam::{Mat3, Quat, Vec3};

use crate::adam::Moments;
use crate::gaussians::{Gaussians, column, logit, sigmoid};
use crate::random::Random;

/// Maximum opacity of a dead Gaussian.
const DEAD_OPACITY: f32 = 0.005;

/// Moves dead Gaussians to where `errors` (one per row) are large, and adds up to `grow` more. Returns the number of
/// dead ones.
pub(crate) fn relocate(
    gaussians: &mut Gaussians,
    moments: &mut Moments,
    errors: &mut Vec<f32>,
    grow: usize,
    random: &mut Random,
) -> usize {
    let count = gaussians.len();
    let is_dead = |i: usize| !(sigmoid(gaussians.row(i)[column::LOGIT]) > DEAD_OPACITY);
    let dead: Vec<bool> = (0..count).map(is_dead).collect();
    // Cumulative sums, to draw living Gaussians by their error.
    let mut sum = 0.0;
    let sums: Vec<f64> = (0..count)
        .map(|i| {
            sum += if dead[i] { 0.0 } else { f64::from(errors[i].max(0.0)) };
            sum
        })
        .collect();
    let died = dead.iter().filter(|dead| **dead).count();
    if sum > 0.0 {
        let to = (0..count).filter(|&i| dead[i]).map(Some);
        for to in to.chain(std::iter::repeat_n(None, grow)) {
            let at = f64::from(random.unit()) * sum;
            let from = sums.partition_point(|&s| s <= at).min(count - 1);
            let half = halve(gaussians.row_mut(from));
            moments.first.row_mut(from).fill(0.0);
            moments.second.row_mut(from).fill(0.0);
            if let Some(to) = to {
                gaussians.row_mut(to).copy_from_slice(&half);
                moments.first.row_mut(to).fill(0.0);
                moments.second.row_mut(to).fill(0.0);
            } else {
                gaussians.values.extend_from_slice(&half);
            }
        }
    }
    let len = gaussians.values.len();
    moments.first.values.resize(len, 0.0);
    moments.second.values.resize(len, 0.0);
    errors.clear();
    errors.resize(gaussians.len(), 0.0);
    died
}

/// Replaces a row by one half of it across its longest axis, and returns the other half.
fn halve(row: &mut [f32]) -> Vec<f32> {
    let logs = &row[column::LOG_SCALE..column::ROTATION];
    let longest = (0..3).max_by(|&a, &b| logs[a].total_cmp(&logs[b])).unwrap_or(0);
    let rotation = Mat3::from_quat(Quat::from_slice(&row[column::ROTATION..]).normalize());
    let offset = rotation.col(longest) * (logs[longest].exp() * OFFSET);
    for (k, log) in row[column::LOG_SCALE..column::ROTATION].iter_mut().enumerate() {
        *log += if k == longest { LENGTH.ln() } else { WIDTH.ln() };
    }
    let opacity = sigmoid(row[column::LOGIT]);
    row[column::LOGIT] = logit((OPACITY * opacity).clamp(1.01 * DEAD_OPACITY, 0.99));
    let mut half = row.to_vec();
    for (k, step) in offset.to_array().into_iter().enumerate() {
        row[column::MEAN + k] -= step;
        half[column::MEAN + k] += step;
    }
    half
}

/// Offset, length and width of a half, in standard deviations of the whole, and its opacity relative to the whole. The
/// halves together differ from the whole by less than a quarter of its peak everywhere.
const OFFSET: f32 = 0.65;
const LENGTH: f32 = 0.6;
const WIDTH: f32 = 0.95;
const OPACITY: f32 = 0.95;

/// Moves the faint rows among `seen` (in ascending order) by noise of their own shape, `strength` times their
/// covariance.
pub(crate) fn wander(gaussians: &mut Gaussians, seen: &[u32], strength: f32, seed: u64) {
    gaussians.change(seen, |row, values| {
        let opacity = sigmoid(values[column::LOGIT]);
        // A smooth step at 0.005: visible Gaussians stay.
        let faint = sigmoid(-100.0 * (opacity - DEAD_OPACITY));
        if faint < 1e-4 {
            return;
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
    });
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
    fn moves_dead_gaussians_to_errors_and_adds_new_ones() {
        let mut gaussians = some();
        let mut moments = Moments::of(&gaussians);
        moments.first.values.fill(1.0);
        let mut errors = vec![9.0, 0.0, 9.0, 0.1];
        let dead = relocate(&mut gaussians, &mut moments, &mut errors, 5, &mut Random::new(1));
        assert_eq!((dead, gaussians.len(), moments.second.len()), (2, 9, 9));
        assert_eq!(errors, [0.0; 9]);
        for i in 0..9 {
            let row = gaussians.row(i);
            // The only living Gaussian with a large error, or its halves.
            assert!(row[0] == 1.0 || (row[0] - 3.0).abs() < 0.3, "{}", row[0]);
            assert!(sigmoid(row[column::LOGIT]) > DEAD_OPACITY);
        }
    }

    #[test]
    fn halves_together_look_like_the_whole() {
        for opacity in [0.3f32, 0.6, 0.95] {
            let mut gaussians = Gaussians::new(0);
            gaussians.push(Vec3::ZERO, Vec3::new(0.2, 1.0, 0.1), Quat::IDENTITY, opacity, [0.5; 3]);
            let other = halve(gaussians.row_mut(0));
            let alpha = |row: &[f32], p: [f32; 2]| {
                let part =
                    |k: usize| ((p[k] - row[k]) / row[column::LOG_SCALE + k].exp()).powi(2) / 2.0;
                sigmoid(row[column::LOGIT]) * (-part(0) - part(1)).exp()
            };
            for (x, y) in (0..400).map(|n| ((n % 20) as f32 / 40.0, (n / 20) as f32 / 8.0)) {
                let whole = opacity * (-(x / 0.2).powi(2) / 2.0 - y * y / 2.0).exp();
                let [a, b] = [gaussians.row(0), &other].map(|row| alpha(row, [x, y]));
                let together = 1.0 - (1.0 - a) * (1.0 - b);
                assert!(
                    (together - whole).abs() < 0.25 * opacity,
                    "{together} for {whole} at {x}, {y}"
                );
            }
        }
    }

    #[test]
    fn does_not_panic_if_all_gaussians_are_dead() {
        let mut gaussians = some();
        for i in 0..4 {
            gaussians.row_mut(i)[column::LOGIT] = f32::NAN;
        }
        let mut moments = Moments::of(&gaussians);
        let mut errors = vec![1.0; 4];
        assert_eq!(relocate(&mut gaussians, &mut moments, &mut errors, 5, &mut Random::new(1)), 4);
        assert_eq!(gaussians.len(), 4);
    }

    #[test]
    fn moves_only_faint_gaussians() {
        let mut gaussians = some();
        wander(&mut gaussians, &[0, 1, 3], 1.0, 9);
        let x = |i: usize| gaussians.row(i)[0];
        assert!(x(0) != 0.0 && x(1) == 1.0 && x(2) == 2.0 && x(3) == 3.0);
    }
}
