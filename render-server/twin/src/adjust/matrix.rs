//! Dense symmetric positive definite systems, and small orthonormal bases.

use glam::{DMat3, DVec2};
use rayon::prelude::*;

/// A symmetric matrix: its lower triangle, row by row.
#[derive(Clone, Debug)]
pub(super) struct Symmetric {
    size: usize,
    lower: Vec<f64>,
}

/// Cholesky factor: the lower triangular matrix whose product with its transpose is the given matrix.
#[derive(Clone, Debug)]
pub(super) struct Factor(Symmetric);

impl Symmetric {
    pub(super) fn zero(size: usize) -> Self {
        Self { size, lower: vec![0.0; size * (size + 1) / 2] }
    }

    pub(super) fn diagonal(&self, i: usize) -> f64 {
        self.lower[i * (i + 1) / 2 + i]
    }

    /// Adds to an element of the lower triangle.
    pub(super) fn add(&mut self, row: usize, column: usize, value: f64) {
        debug_assert!(column <= row);
        self.lower[row * (row + 1) / 2 + column] += value;
    }

    /// Adds a block whose first element is at (`row`, `column`). Only its part in the lower triangle is used.
    pub(super) fn add_block<const R: usize, const C: usize>(
        &mut self,
        row: usize,
        column: usize,
        block: &[[f64; C]; R],
    ) {
        for (i, values) in block.iter().enumerate() {
            let at = row + i;
            let start = at * (at + 1) / 2 + column;
            let count = C.min((at + 1).saturating_sub(column));
            let target = &mut self.lower[start..start + count];
            target.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
        }
    }

    /// Returns the sum of matrices of equal size, in a fixed order; zero for an empty list.
    pub(super) fn sum(size: usize, all: &[&Self]) -> Self {
        let mut sum = Self::zero(size);
        sum.lower.par_chunks_mut(PIECE).enumerate().for_each(|(piece, sum)| {
            for one in all {
                sum.iter_mut().zip(&one.lower[piece * PIECE..]).for_each(|(x, y)| *x += y);
            }
        });
        sum
    }

    /// Increases the diagonal by a fraction (Marquardt 1963).
    pub(super) fn damp(&mut self, share: f64) {
        for i in 0..self.size {
            self.lower[i * (i + 1) / 2 + i] *= 1.0 + share;
        }
    }

    /// Returns the factor; `None` if the matrix is not positive definite. Bit-identical for any number of threads.
    pub(super) fn factor(mut self) -> Option<Factor> {
        for begin in (0..self.size).step_by(PANEL) {
            let end = (begin + PANEL).min(self.size);
            let (before, after) = self.lower.split_at_mut(end * (end + 1) / 2);
            for i in begin..end {
                let (above, row) = before.split_at_mut(i * (i + 1) / 2);
                let greatest = row[i];
                factor_row(&mut row[..i], begin, above);
                let value = row[i] - dot(&row[..i], &row[..i]);
                // The remainder of the diagonal must be larger than rounding errors.
                if !(value > 1e-13 * greatest && value > 0.0) {
                    return None;
                }
                row[i] = value.sqrt();
            }
            // The same columns of the rows below, each independently.
            let mut rows = Vec::with_capacity(self.size - end);
            let mut rest = after;
            for i in end..self.size {
                let (row, next) = rest.split_at_mut(i + 1);
                rows.push(&mut row[..end]);
                rest = next;
            }
            let before = &*before;
            rows.into_par_iter().with_min_len(16).for_each(|row| factor_row(row, begin, before));
        }
        Some(Factor(self))
    }
}

/// Computes a row of the factor from a column on, given its preceding elements and the rows above up to the same
/// length.
fn factor_row(row: &mut [f64], from: usize, above: &[f64]) {
    for j in from..row.len() {
        let other = &above[j * (j + 1) / 2..][..=j];
        row[j] = (row[j] - dot(&row[..j], &other[..j])) / other[j];
    }
}

impl Factor {
    /// Solves for one right-hand side.
    pub(super) fn solve(&self, mut x: Vec<f64>) -> Vec<f64> {
        let Symmetric { size, lower } = &self.0;
        for i in 0..*size {
            let row = &lower[i * (i + 1) / 2..][..=i];
            x[i] = (x[i] - dot(&row[..i], &x[..i])) / row[i];
        }
        for i in (0..*size).rev() {
            let row = &lower[i * (i + 1) / 2..][..=i];
            x[i] /= row[i];
            let (before, value) = (&mut x[..=i], row);
            let known = before[i];
            before[..i].iter_mut().zip(value).for_each(|(sum, a)| *sum -= a * known);
        }
        x
    }
}

/// Number of columns per panel: with as many rows, they fit into a core's cache.
const PANEL: usize = 32;
/// Number of elements that one thread adds.
const PIECE: usize = 1 << 15;

/// Dot product with eight partial sums: a single sum would wait for itself.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 8];
    let (a_eights, a_rest) = a.as_chunks::<8>();
    let (b_eights, b_rest) = b.as_chunks::<8>();
    for (x, y) in a_eights.iter().zip(b_eights) {
        for k in 0..8 {
            sums[k] += x[k] * y[k];
        }
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(x, y)| x * y).sum();
    sums.iter().sum::<f64>() + rest
}

/// Orthonormalises three columns (Gram-Schmidt, twice). Returns the upper triangular matrix that computes the original
/// columns from the new ones; `None` if the columns are numerically dependent.
pub(super) fn orthonormal(columns: &mut [Vec<DVec2>; 3]) -> Option<DMat3> {
    let product = |a: &[DVec2], b: &[DVec2]| a.iter().zip(b).map(|(a, b)| a.dot(*b)).sum::<f64>();
    let mut upper = DMat3::ZERO;
    let mut left = 1.0;
    for k in 0..3 {
        let (before, column) = columns.split_at_mut(k);
        let column = &mut column[0];
        let length2 = product(column, column);
        // The second pass removes what rounding left of the other columns in the first.
        for _ in 0..2 {
            for (j, other) in before.iter().enumerate() {
                let along = product(other, column);
                column.iter_mut().zip(other).for_each(|(x, y)| *x -= *y * along);
                upper.col_mut(k)[j] += along;
            }
        }
        let left2 = product(column, column);
        left *= left2 / length2;
        let length = left2.sqrt();
        for x in column.iter_mut() {
            *x /= length;
        }
        upper.col_mut(k)[k] = length;
    }
    (left > 1e-9).then_some(upper)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn solutions_satisfy_the_system(
            rows in prop::collection::vec(prop::collection::vec(-1.0..1.0f64, 70), 73),
            right in prop::collection::vec(-1.0..1.0f64, 70),
        ) {
            let full = |i: usize, j: usize| {
                let product: f64 = rows.iter().map(|row| row[i] * row[j]).sum();
                product + if i == j { 0.1 } else { 0.0 }
            };
            let mut matrix = Symmetric::zero(70);
            for i in 0..70 {
                for j in 0..=i {
                    matrix.add(i, j, full(i, j));
                }
            }
            let x = matrix.factor().unwrap().solve(right.clone());
            for i in 0..70 {
                let back: f64 = (0..70).map(|j| full(i, j) * x[j]).sum();
                prop_assert!((back - right[i]).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn blocks_fill_only_the_lower_triangle_and_singular_systems_fail() {
        let mut matrix = Symmetric::zero(3);
        matrix.add_block(1, 1, &[[1.0, 9.0], [1.0, 1.0]]);
        matrix.add_block(0, 0, &[[2.0]]);
        assert_eq!(matrix.lower, [2.0, 0.0, 1.0, 0.0, 1.0, 1.0]);
        assert!(matrix.factor().is_none());
    }

    #[test]
    fn orthonormalises_columns_unless_they_are_dependent() {
        // Nearly parallel, like those of a point very close to a camera.
        let columns =
            [1e-4, 2e-4, 3e-4].map(|off| vec![DVec2::new(1.0, off), DVec2::new(off * off, 1.0)]);
        let mut basis = columns.clone();
        let upper = orthonormal(&mut basis);
        assert!(upper.is_none(), "{upper:?}");
        let columns = [0.0, 0.3, 0.7].map(|off| {
            vec![DVec2::new(1.0, off), DVec2::new(off * off, 1.0), DVec2::new(0.0, off.sin())]
        });
        let mut basis = columns.clone();
        let upper = orthonormal(&mut basis).unwrap();
        for i in 0..3 {
            for j in 0..3 {
                let product: f64 = basis[i].iter().zip(&basis[j]).map(|(a, b)| a.dot(*b)).sum();
                assert!((product - f64::from(u8::from(i == j))).abs() < 1e-14, "{i} {j} {product}");
            }
            for row in 0..3 {
                let back: DVec2 = (0..3).map(|k| basis[k][row] * upper.col(i)[k]).sum();
                assert!((back - columns[i][row]).length() < 1e-14);
            }
        }
    }
}
