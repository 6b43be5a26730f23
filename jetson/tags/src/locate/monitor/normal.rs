//! Least squares of the lasting parameters. The pose of each set of images is eliminated.

use super::{EACH, LATE, Linear, PLACE, READOUT};
use crate::bundle::matrix::Symmetric;
use crate::solve::{CornerRow, invert6};

/// Normal equations of the lasting parameters, without the poses.
#[derive(Clone, Debug)]
pub(super) struct Normal {
    pub(super) matrix: Symmetric,
    pub(super) right: Vec<f64>,
    pub(super) square: f64,
    pub(super) count: f64,
}

impl Normal {
    /// Returns empty normal equations of `size` parameters.
    pub(super) fn empty(size: usize) -> Self {
        Self { matrix: Symmetric::zero(size), right: vec![0.0; size], square: 0.0, count: 0.0 }
    }

    pub(super) fn keep(&mut self, share: f64) {
        self.matrix.scale(share);
        self.right.iter_mut().for_each(|x| *x *= share);
        self.square *= share;
        self.count *= share;
    }

    pub(super) fn add(&mut self, other: &Self) {
        self.matrix.add_all(&other.matrix);
        self.right.iter_mut().zip(&other.right).for_each(|(x, y)| *x += y);
        self.square += other.square;
        self.count += other.count;
    }

    /// Adds a set of images with its pose eliminated. Returns `false` if the pose is not determined.
    pub(super) fn add_set(&mut self, set: &Linear, wrong: &[f64]) -> bool {
        let size = wrong.len();
        let cameras = size / EACH;
        // Sets with large residuals get less weight. The median of residuals is 1.18 sigma.
        let mut off: Vec<f64> =
            set.rows.iter().map(|(_, sigma_px, row)| row.off_px.length() / sigma_px).collect();
        if off.is_empty() {
            return false;
        }
        let middle = off.len() / 2;
        let (_, median, _) = off.select_nth_unstable_by(middle, f64::total_cmp);
        let noise = (*median / 1.18).max(1.0);
        let weigh = |sigma_px: f64, off_px: f64| {
            let sigma_px = noise * sigma_px;
            SHARED_IMAGES / (1.0 + (off_px / (4.0 * sigma_px)).powi(2)) / (sigma_px * sigma_px)
        };
        let Some((inverse, across)) = eliminate(set, size, weigh) else { return false };
        let mut pose_right = [0.0; 6];
        for (camera, sigma_px, row) in &set.rows {
            let weight = weigh(*sigma_px, row.off_px.length());
            let unknowns = unknowns(*camera, row, cameras);
            for axis in 0..2 {
                let value = unknowns.iter().map(|(at, by)| by[axis] * wrong[*at]).sum::<f64>()
                    - row.off_px[axis];
                for (sum, by) in pose_right.iter_mut().zip(row.by_pose[axis]) {
                    *sum += weight * by * value;
                }
                for (i, (at, by_row)) in unknowns.iter().enumerate() {
                    self.right[*at] += weight * by_row[axis] * value;
                    for (column, by_column) in &unknowns[..=i] {
                        self.matrix.add(*at, *column, weight * by_row[axis] * by_column[axis]);
                    }
                }
                self.square += weight * value * value;
            }
            self.count += 2.0 * SHARED_IMAGES;
        }
        let solved = times(&inverse, &pose_right);
        self.square -= dot(&solved, &pose_right);
        for (i, column) in across.iter().enumerate() {
            if column.iter().all(|x| *x == 0.0) {
                continue;
            }
            self.right[i] -= dot(column, &solved);
            let through = times(&inverse, column);
            for (j, other) in across[..=i].iter().enumerate() {
                self.matrix.add(i, j, -dot(&through, other));
            }
        }
        true
    }

    /// Returns the estimated errors under a prior, and their covariance.
    pub(super) fn solve(&self, prior: &[f64], on_time: usize) -> Option<(Vec<f64>, Symmetric)> {
        let mut matrix = self.matrix.clone();
        for (i, variance) in prior.iter().enumerate() {
            matrix.add(i, i, 1.0 / variance);
        }
        let at = EACH * on_time + LATE;
        matrix.add(at, at, RIGHT_S.powi(-2));
        matrix.invert().then(|| {
            let product = (0..prior.len())
                .map(|i| {
                    (0..prior.len()).map(|j| matrix.at(i.max(j), i.min(j)) * self.right[j]).sum()
                })
                .collect();
            (product, matrix)
        })
    }

    /// Returns the remaining sum of squares.
    pub(super) fn cost(&self, wrong: &[f64]) -> f64 {
        let mut cost = self.square;
        for (i, x) in wrong.iter().enumerate() {
            let by_row: f64 =
                (0..wrong.len()).map(|j| self.matrix.at(i.max(j), i.min(j)) * wrong[j]).sum();
            cost += x * (by_row - 2.0 * self.right[i]);
        }
        cost
    }
}

/// Returns the parameters that a corner depends on, sorted, with its derivatives.
pub(super) fn unknowns(
    camera: usize,
    row: &CornerRow,
    cameras: usize,
) -> [(usize, glam::DVec2); EACH + 1] {
    let at = EACH * camera;
    std::array::from_fn(|i| match i {
        // An image with a late stamp was exposed earlier.
        LATE => (at + LATE, row.by_lag),
        READOUT => (at + READOUT, -row.by_lag * row.row_share),
        EACH => (EACH * cameras, row.by_scale),
        _ => (at + i, glam::DVec2::new(row.by_camera[0][i - PLACE], row.by_camera[1][i - PLACE])),
    })
}

/// Returns the inverse of the normal equations of a set's pose, and the block between the pose and the lasting
/// parameters.
#[allow(clippy::type_complexity, reason = "used only here")]
pub(super) fn eliminate(
    set: &Linear,
    size: usize,
    weigh: impl Fn(f64, f64) -> f64,
) -> Option<([[f64; 6]; 6], Vec<[f64; 6]>)> {
    let mut matrix = [[0.0; 6]; 6];
    let mut across = vec![[0.0; 6]; size];
    for (camera, sigma_px, row) in &set.rows {
        let weight = weigh(*sigma_px, row.off_px.length());
        for axis in 0..2 {
            let by_pose = row.by_pose[axis];
            for a in 0..6 {
                for b in 0..=a {
                    matrix[a][b] += weight * by_pose[a] * by_pose[b];
                }
            }
            for (at, by) in unknowns(*camera, row, size / EACH) {
                for (sum, by_pose) in across[at].iter_mut().zip(by_pose) {
                    *sum += weight * by[axis] * by_pose;
                }
            }
        }
    }
    Some((invert6(&matrix)?, across))
}

pub(super) fn times(matrix: &[[f64; 6]; 6], x: &[f64; 6]) -> [f64; 6] {
    std::array::from_fn(|i| dot(&matrix[i], x))
}

fn dot(a: &[f64; 6], b: &[f64; 6]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Sigma of the reference clock. [s]
const RIGHT_S: f64 = 1e-6;
/// Weight of a set. Each image is in its own set and in the next set of each other camera, and its errors persist over
/// several images.
const SHARED_IMAGES: f64 = 0.1;
