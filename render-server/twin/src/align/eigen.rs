//! Eigenvalues and eigenvectors of small symmetric matrices, by Jacobi rotations (Golub and Van Loan, Matrix
//! Computations, 8.5).

/// Returns the eigenvalues in ascending order, each with its unit eigenvector.
pub(super) fn symmetric<const N: usize>(mut a: [[f64; N]; N]) -> [(f64, [f64; N]); N] {
    let mut vectors = [[0.0; N]; N];
    for (index, row) in vectors.iter_mut().enumerate() {
        row[index] = 1.0;
    }
    for _ in 0..SWEEPS {
        for p in 0..N {
            for q in p + 1..N {
                if a[p][q] == 0.0 {
                    continue;
                }
                let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
                let t = theta.signum() / (theta.abs() + theta.hypot(1.0));
                let (c, s) = (1.0 / t.hypot(1.0), t / t.hypot(1.0));
                for row in &mut a {
                    (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
                }
                for column in 0..N {
                    let (up, down) = (a[p][column], a[q][column]);
                    (a[p][column], a[q][column]) = (c * up - s * down, s * up + c * down);
                }
                for row in &mut vectors {
                    (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
                }
            }
        }
    }
    let mut pairs =
        std::array::from_fn(|index| (a[index][index], std::array::from_fn(|k| vectors[k][index])));
    pairs.sort_by(|(x, _), (y, _)| x.total_cmp(y));
    pairs
}

/// Jacobi sweeps. Convergence is quadratic: 4 x 4 matrices need five.
const SWEEPS: usize = 12;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn eigenvectors_satisfy_the_definition(
            values in prop::array::uniform10(-10.0..10.0f64)
        ) {
            let mut matrix = [[0.0; 4]; 4];
            let mut next = values.iter();
            for row in 0..4 {
                for column in row..4 {
                    let value = *next.next().unwrap();
                    (matrix[row][column], matrix[column][row]) = (value, value);
                }
            }
            let pairs = symmetric(matrix);
            for (value, vector) in pairs {
                let length: f64 = vector.iter().map(|x| x * x).sum();
                prop_assert!((length - 1.0).abs() < 1e-12);
                for row in 0..4 {
                    let image: f64 = (0..4).map(|k| matrix[row][k] * vector[k]).sum();
                    prop_assert!((image - value * vector[row]).abs() < 1e-10);
                }
            }
            prop_assert!(pairs.is_sorted_by(|a, b| a.0 <= b.0));
        }
    }
}
