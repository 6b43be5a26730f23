//! Covariance of the error state: symmetric, in blocks of 3 x 3, of which the upper triangle is stored. Each
//! operation is written out for the few blocks that it touches: the filter spends most of its time here.

use glam::{DMat3, DVec3};

use super::motion::Decay;

/// Blocks of the error state, in order.
pub(super) const P: usize = 0;
pub(super) const V: usize = 1;
pub(super) const A: usize = 2;
pub(super) const R: usize = 3;
pub(super) const W: usize = 4;
pub(super) const GYRO_BIAS: usize = 5;
pub(super) const ACCEL_BIAS: usize = 6;
pub(super) const BLOCKS: usize = 7;
/// Number of blocks in the upper triangle, diagonal included.
const KEPT_BLOCKS: usize = BLOCKS * (BLOCKS + 1) / 2;

/// Covariance matrix of all parts of the state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Covariance([DMat3; KEPT_BLOCKS]);

/// Derivative of a reading with respect to one block of the error.
#[derive(Clone, Copy, Debug)]
pub(super) enum Slope {
    /// Identity.
    One,
    /// Matrix.
    Matrix(DMat3),
}

/// A reading in the form of the filter: linear in `N` blocks of the error.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reading<const N: usize> {
    /// Reading minus expected value.
    pub residual: DVec3,
    /// Blocks on which it depends, with derivatives.
    pub slopes: [(usize, Slope); N],
    /// Variance of the reading's own noise.
    pub variance: DMat3,
}

impl Covariance {
    /// Returns the covariance of a state with independent parts and these standard deviations.
    pub(super) fn of(sigmas: [DVec3; BLOCKS]) -> Self {
        let mut made = Self([DMat3::ZERO; KEPT_BLOCKS]);
        for (block, sigma) in sigmas.into_iter().enumerate() {
            *made.at(block, block) = squares(sigma);
        }
        made
    }

    /// Returns the block of row `i`, column `j`.
    pub(super) fn block(&self, i: usize, j: usize) -> DMat3 {
        if i <= j { self.0[place(i, j)] } else { self.0[place(j, i)].transpose() }
    }

    /// Returns the block of row `i`, column `j`, on or above the diagonal.
    pub(super) fn at(&mut self, i: usize, j: usize) -> &mut DMat3 {
        &mut self.0[place(i, j)]
    }

    /// Returns the standard deviations of a block's parts.
    pub(super) fn sigma(&self, block: usize) -> DVec3 {
        let m = &self.0[place(block, block)];
        DVec3::new(m.x_axis.x, m.y_axis.y, m.z_axis.z).max(DVec3::ZERO).map(f64::sqrt)
    }

    pub(super) fn is_finite(&self) -> bool {
        self.0.iter().all(DMat3::is_finite)
    }

    /// Predicts with the state: `F C F^T` of the motion model, where `F` is the identity except for
    /// `P += dt V + twice A`, `V += once A`, `A *= share`, `R = back R + dt W`.
    pub(super) fn advance(&mut self, dt_s: f64, decay: &Decay, back: &DMat3) {
        let Decay { share, once_s, twice_s2 } = *decay;
        let forth = back.transpose();
        // Each line first as a row; its diagonal then adds the column's part, from the new row.
        self.add_block(P, P, self.block(V, P) * dt_s + self.block(A, P) * twice_s2);
        for j in V..BLOCKS {
            self.add_block(P, j, self.block(V, j) * dt_s + self.block(A, j) * twice_s2);
        }
        self.add_block(P, P, self.block(P, V) * dt_s + self.block(P, A) * twice_s2);

        self.add_block(V, V, self.block(A, V) * once_s);
        self.add_block(P, V, self.block(P, A) * once_s);
        for j in A..BLOCKS {
            self.add_block(V, j, self.block(A, j) * once_s);
        }
        self.add_block(V, V, self.block(V, A) * once_s);

        for (i, j) in [(P, A), (V, A), (A, R), (A, W), (A, GYRO_BIAS), (A, ACCEL_BIAS)] {
            *self.at(i, j) *= share;
        }
        *self.at(A, A) *= share * share;

        for i in P..R {
            *self.at(i, R) = self.block(i, R) * forth + self.block(i, W) * dt_s;
        }
        let row = *back * self.block(R, R) + self.block(W, R) * dt_s;
        for j in W..BLOCKS {
            *self.at(R, j) = *back * self.block(R, j) + self.block(W, j) * dt_s;
        }
        *self.at(R, R) = row * forth + self.block(R, W) * dt_s;
        for block in [P, V, R] {
            self.make_symmetric(block);
        }
    }

    fn add_block(&mut self, i: usize, j: usize, block: DMat3) {
        *self.at(i, j) += block;
    }

    /// Adds a variance to all three axes of a block; the opposite block follows by symmetry.
    pub(super) fn add(&mut self, i: usize, j: usize, variance: f64) {
        *self.at(i, j) += DMat3::from_diagonal(DVec3::splat(variance));
    }

    /// Returns the variance of a reading's residual.
    pub(super) fn spread<const N: usize>(&self, reading: &Reading<N>) -> DMat3 {
        reading.slopes.iter().fold(reading.variance, |sum, (i, slope)| {
            sum + slope.times(&self.with(*i, &reading.slopes))
        })
    }

    /// Updates the covariance with a reading whose residual has the inverse variance `inverse`; returns the
    /// error of each block.
    pub(super) fn read<const N: usize>(
        &mut self,
        reading: &Reading<N>,
        inverse: &DMat3,
    ) -> [DVec3; BLOCKS] {
        let to_reading: [DMat3; BLOCKS] = std::array::from_fn(|i| self.with(i, &reading.slopes));
        let from_reading = to_reading.map(|block| block.transpose());
        let weighted = *inverse * reading.residual;
        let error = to_reading.map(|block| block * weighted);
        for (i, block) in to_reading.iter().enumerate() {
            let gain = *block * *inverse;
            for (j, back) in from_reading.iter().enumerate().skip(i) {
                *self.at(i, j) -= gain * *back;
            }
            self.make_symmetric(i);
        }
        error
    }

    /// Returns the covariance of block `i` with a reading: a row of `C H^T`.
    fn with(&self, i: usize, slopes: &[(usize, Slope)]) -> DMat3 {
        slopes.iter().fold(DMat3::ZERO, |sum, (j, slope)| {
            let block = self.block(i, *j);
            sum + match slope {
                Slope::One => block,
                Slope::Matrix(matrix) => block * matrix.transpose(),
            }
        })
    }

    /// Makes a diagonal block exactly symmetric after rounding.
    fn make_symmetric(&mut self, block: usize) {
        let block = self.at(block, block);
        *block = (*block + block.transpose()) * 0.5;
    }
}

impl Slope {
    fn times(&self, block: &DMat3) -> DMat3 {
        match self {
            Self::One => *block,
            Self::Matrix(matrix) => *matrix * *block,
        }
    }
}

/// Returns the index of the block of row `i`, column `j`, `i <= j`.
const fn place(i: usize, j: usize) -> usize {
    i * (2 * BLOCKS - 1 - i) / 2 + j
}

/// Returns the diagonal matrix of the squares.
pub(super) fn squares(sigma: DVec3) -> DMat3 {
    DMat3::from_diagonal(sigma * sigma)
}

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use proptest::prelude::*;

    use super::*;

    const SIZE: usize = 3 * BLOCKS;
    type Plain = [[f64; SIZE]; SIZE];

    /// Returns the whole matrix, row by row.
    fn plain(c: &Covariance) -> Plain {
        std::array::from_fn(|row| {
            std::array::from_fn(|col| c.block(row / 3, col / 3).col(col % 3)[row % 3])
        })
    }

    fn product(a: &Plain, b: &Plain) -> Plain {
        std::array::from_fn(|i| std::array::from_fn(|j| (0..SIZE).map(|k| a[i][k] * b[k][j]).sum()))
    }

    fn transposed(a: &Plain) -> Plain {
        std::array::from_fn(|i| std::array::from_fn(|j| a[j][i]))
    }

    fn assert_close(a: &Plain, b: &Plain) {
        for (row_a, row_b) in a.iter().zip(b) {
            for (x, y) in row_a.iter().zip(row_b) {
                assert!((x - y).abs() < 1e-9 * (1.0 + x.abs()), "{x} is not {y}");
            }
        }
    }

    /// A covariance with all blocks non-zero.
    fn any_covariance() -> impl Strategy<Value = Covariance> {
        prop::collection::vec(-1.0..1.0f64, SIZE * SIZE).prop_map(|numbers| {
            let half: Plain =
                std::array::from_fn(|i| std::array::from_fn(|j| numbers[SIZE * i + j]));
            let whole = product(&half, &transposed(&half));
            let mut made = Covariance::of([DVec3::ZERO; BLOCKS]);
            for i in 0..BLOCKS {
                for j in i..BLOCKS {
                    let column = |c: usize| {
                        DVec3::from_array(std::array::from_fn(|r| whole[3 * i + r][3 * j + c]))
                    };
                    *made.at(i, j) = DMat3::from_cols(column(0), column(1), column(2));
                }
            }
            made
        })
    }

    fn set(m: &mut Plain, i: usize, j: usize, block: DMat3) {
        for r in 0..3 {
            for c in 0..3 {
                m[3 * i + r][3 * j + c] = block.col(c)[r];
            }
        }
    }

    proptest! {
        #[test]
        fn prediction_equals_the_product_of_whole_matrices(
            c in any_covariance(), w in prop::array::uniform3(-0.3..0.3f64), dt_s in 1e-4..0.05f64
        ) {
            let decay = Decay::after(dt_s);
            let back = DMat3::from_quat(DQuat::from_scaled_axis(DVec3::from(w)));
            let mut f: Plain = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
            let scaled = |factor: f64| DMat3::IDENTITY * factor;
            set(&mut f, P, V, scaled(dt_s));
            set(&mut f, P, A, scaled(decay.twice_s2));
            set(&mut f, V, A, scaled(decay.once_s));
            set(&mut f, A, A, scaled(decay.share));
            set(&mut f, R, R, back);
            set(&mut f, R, W, scaled(dt_s));
            let expected = product(&product(&f, &plain(&c)), &transposed(&f));
            let mut moved = c;
            moved.advance(dt_s, &decay, &back);
            assert_close(&plain(&moved), &expected);
        }

        #[test]
        fn update_equals_that_of_whole_matrices(
            c in any_covariance(), w in prop::array::uniform3(-3.0..3.0f64), residual in prop::array::uniform3(-1.0..1.0f64)
        ) {
            let turn = DMat3::from_quat(DQuat::from_scaled_axis(DVec3::from(w)));
            let slopes = [(A, Slope::Matrix(turn)), (R, Slope::Matrix(turn * 2.0)), (ACCEL_BIAS, Slope::One)];
            let variance = squares(DVec3::new(1.0, 2.0, 3.0));
            let reading = Reading { residual: DVec3::from(residual), slopes, variance };
            // H fills the first three rows; there, S is H C H^T + R.
            let mut h = [[0.0; SIZE]; SIZE];
            set(&mut h, 0, A, turn);
            set(&mut h, 0, R, turn * 2.0);
            set(&mut h, 0, ACCEL_BIAS, DMat3::IDENTITY);
            let hc = product(&h, &plain(&c));
            let s = product(&hc, &transposed(&h));
            let column = |j: usize| DVec3::new(s[0][j], s[1][j], s[2][j]);
            let s = DMat3::from_cols(column(0), column(1), column(2)) + variance;
            let inverse = s.inverse();
            let mut weight = [[0.0; SIZE]; SIZE];
            set(&mut weight, 0, 0, inverse);
            let off = product(&product(&transposed(&hc), &weight), &hc);
            let before = plain(&c);
            let expected: Plain = std::array::from_fn(|i| std::array::from_fn(|j| before[i][j] - off[i][j]));
            let mut after = c;
            prop_assert!((after.spread(&reading).x_axis - s.x_axis).length() < 1e-9 * s.x_axis.length());
            let error = after.read(&reading, &inverse);
            assert_close(&plain(&after), &expected);
            let by_hand = product(&transposed(&hc), &weight);
            for (block, error) in error.iter().enumerate() {
                for r in 0..3 {
                    let sum: f64 = (0..3).map(|k| by_hand[3 * block + r][k] * residual[k]).sum();
                    prop_assert!((error[r] - sum).abs() < 1e-9 * (1.0 + sum.abs()));
                }
            }
        }
    }
}
