//! Dense symmetric positive definite systems.

/// A symmetric matrix, stored as its lower triangle, row by row.
#[derive(Clone, Debug)]
pub(crate) struct Symmetric {
    size: usize,
    lower: Vec<f64>,
}

impl Symmetric {
    pub(crate) fn zero(size: usize) -> Self {
        Self { size, lower: vec![0.0; size * (size + 1) / 2] }
    }

    /// Returns an element of the lower triangle.
    pub(crate) fn at(&self, row: usize, column: usize) -> f64 {
        self.lower[row * (row + 1) / 2 + column]
    }

    /// Adds to an element of the lower triangle.
    pub(crate) fn add(&mut self, row: usize, column: usize, value: f64) {
        self.lower[row * (row + 1) / 2 + column] += value;
    }

    /// Increases the diagonal by this share (Marquardt 1963).
    pub(crate) fn damp(&mut self, share: f64) {
        for i in 0..self.size {
            self.lower[i * (i + 1) / 2 + i] *= 1.0 + share;
        }
    }

    pub(crate) fn scaled(mut self, by: f64) -> Self {
        self.scale(by);
        self
    }

    pub(crate) fn scale(&mut self, by: f64) {
        self.lower.iter_mut().for_each(|x| *x *= by);
    }

    pub(crate) fn add_all(&mut self, other: &Self) {
        self.lower.iter_mut().zip(&other.lower).for_each(|(x, y)| *x += y);
    }

    /// Replaces the matrix by its Cholesky factor; `false` if it is not positive definite.
    fn factor(&mut self) -> bool {
        for i in 0..self.size {
            let start = i * (i + 1) / 2;
            let greatest = self.lower[start + i];
            for j in 0..=i {
                let other = j * (j + 1) / 2;
                let (before, rest) = self.lower.split_at(start);
                let above = if i == j { &rest[..j] } else { &before[other..other + j] };
                let sum: f64 = rest[..j].iter().zip(above).map(|(a, b)| a * b).sum();
                let value = self.lower[start + j] - sum;
                if i == j {
                    // The rest of the diagonal after subtraction must be larger than rounding errors.
                    if !(value > 1e-13 * greatest && value > 0.0) {
                        return false;
                    }
                    self.lower[start + j] = value.sqrt();
                } else {
                    self.lower[start + j] = value / self.lower[other + j];
                }
            }
        }
        true
    }

    /// Solves for one right side and destroys the matrix; `None` if it is not positive definite.
    pub(crate) fn solve(&mut self, right: &[f64]) -> Option<Vec<f64>> {
        self.factor().then(|| self.back(right.to_vec()))
    }

    /// Solves with the Cholesky factor.
    fn back(&self, mut x: Vec<f64>) -> Vec<f64> {
        for i in 0..self.size {
            let row = &self.lower[i * (i + 1) / 2..][..=i];
            let sum: f64 = row[..i].iter().zip(&x).map(|(a, b)| a * b).sum();
            x[i] = (x[i] - sum) / row[i];
        }
        for i in (0..self.size).rev() {
            x[i] /= self.at(i, i);
            let value = x[i];
            for (j, x) in x[..i].iter_mut().enumerate() {
                *x -= self.at(i, j) * value;
            }
        }
        x
    }

    /// Replaces the matrix by its inverse; `false` if it is not positive definite.
    pub(crate) fn invert(&mut self) -> bool {
        if !self.factor() {
            return false;
        }
        let mut inverse = Self::zero(self.size);
        for column in 0..self.size {
            let mut unit = vec![0.0; self.size];
            unit[column] = 1.0;
            let x = self.back(unit);
            for (row, value) in x.iter().enumerate().skip(column) {
                inverse.add(row, column, *value);
            }
        }
        *self = inverse;
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn solve_and_invert_are_correct(
            rows in prop::collection::vec(prop::array::uniform5(-1.0..1.0f64), 7..12),
            right in prop::array::uniform5(-1.0..1.0f64),
        ) {
            let mut matrix = Symmetric::zero(5);
            for i in 0..5 {
                for j in 0..=i {
                    let product: f64 = rows.iter().map(|row| row[i] * row[j]).sum();
                    matrix.add(i, j, product + if i == j { 0.1 } else { 0.0 });
                }
            }
            let full = |m: &Symmetric, i: usize, j: usize| m.at(i.max(j), i.min(j));
            let x = matrix.clone().solve(&right).unwrap();
            let mut inverse = matrix.clone();
            prop_assert!(inverse.invert());
            for i in 0..5 {
                let back: f64 = (0..5).map(|j| full(&matrix, i, j) * x[j]).sum();
                prop_assert!((back - right[i]).abs() < 1e-9);
                let same: f64 = (0..5).map(|j| full(&inverse, i, j) * right[j]).sum();
                prop_assert!((same - x[i]).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn rejects_singular_systems() {
        let mut flat = Symmetric::zero(2);
        flat.add(0, 0, 1.0);
        flat.add(1, 0, 1.0);
        flat.add(1, 1, 1.0);
        assert!(flat.clone().solve(&[1.0, 1.0]).is_none());
        assert!(!flat.invert());
    }
}
