//! Normal equations, and elimination of the views' poses.

use glam::DVec2;

use super::matrix::Symmetric;

pub(super) struct Normal {
    /// Number of shared parameters.
    pub(super) shared: usize,
    pub(super) matrix: Symmetric,
    pub(super) gradient: Vec<f64>,
    pub(super) views: Vec<ViewNormal>,
    pub(super) cost: f64,
}

/// Normal equations of one view.
#[derive(Clone, Default)]
pub(super) struct ViewNormal {
    pub(super) matrix: [[f64; 6]; 6],
    pub(super) gradient: [f64; 6],
    /// Nonzero rows of the block between shared parameters and the view, sorted.
    across: Vec<(usize, [f64; 6])>,
}

impl ViewNormal {
    fn row(&mut self, at: usize) -> &mut [f64; 6] {
        let place = match self.across.binary_search_by_key(&at, |(row, _)| *row) {
            Ok(place) => place,
            Err(place) => {
                self.across.insert(place, (at, [0.0; 6]));
                place
            }
        };
        &mut self.across[place].1
    }
}

impl Normal {
    pub(super) fn add(
        &mut self,
        shared: &[(usize, &[DVec2]); 3],
        view: Option<(usize, &[DVec2; 6])>,
        residual: DVec2,
        weight: f64,
    ) {
        let numbers = || {
            shared.iter().flat_map(|&(at, derivatives)| {
                derivatives.iter().enumerate().map(move |(i, d)| (at + i, *d * weight))
            })
        };
        for (row, by_row) in numbers() {
            self.gradient[row] += by_row.dot(residual);
            for &(at, derivatives) in shared {
                for (i, by_column) in derivatives.iter().enumerate() {
                    if at + i <= row {
                        self.matrix.add(row, at + i, by_row.dot(*by_column));
                    }
                }
            }
        }
        let Some((number, derivatives)) = view else { return };
        let view = &mut self.views[number];
        for (i, by_row) in derivatives.iter().enumerate() {
            view.gradient[i] += weight * by_row.dot(residual);
            for (j, by_column) in derivatives.iter().enumerate() {
                view.matrix[i][j] += weight * by_row.dot(*by_column);
            }
        }
        for (row, by_row) in numbers() {
            let across = view.row(row);
            for (sum, by_column) in across.iter_mut().zip(derivatives) {
                *sum += by_row.dot(*by_column);
            }
        }
    }

    /// Returns the reduced system of the shared parameters, and each view's inverse; `None` if a view is not
    /// determined.
    #[allow(clippy::type_complexity, reason = "used only here")]
    pub(super) fn reduced(
        &self,
        damping: f64,
    ) -> Option<(Symmetric, Vec<f64>, Vec<[[f64; 6]; 6]>)> {
        let mut matrix = self.matrix.clone();
        matrix.damp(damping);
        let mut gradient = self.gradient.clone();
        let mut inverses = Vec::with_capacity(self.views.len());
        for view in &self.views {
            let mut inverse = Symmetric::zero(6);
            for i in 0..6 {
                for j in 0..=i {
                    inverse.add(i, j, view.matrix[i][j]);
                }
            }
            inverse.damp(damping);
            if !inverse.invert() {
                return None;
            }
            let inverse: [[f64; 6]; 6] =
                std::array::from_fn(|i| std::array::from_fn(|j| inverse.at(i.max(j), i.min(j))));
            for (row, across) in &view.across {
                let product: [f64; 6] =
                    std::array::from_fn(|j| (0..6).map(|i| across[i] * inverse[i][j]).sum());
                gradient[*row] -= dot(&product, &view.gradient);
                for (column, other) in view.across.iter().take_while(|(column, _)| column <= row) {
                    matrix.add(*row, *column, -dot(&product, other));
                }
            }
            inverses.push(inverse);
        }
        Some((matrix, gradient, inverses))
    }

    /// Returns the step of all parameters; `None` if the equations do not determine it.
    pub(super) fn step(&self, damping: f64) -> Option<(Vec<f64>, Vec<[f64; 6]>)> {
        let (mut matrix, gradient, inverses) = self.reduced(damping)?;
        let shared: Vec<f64> = matrix.solve(&gradient)?.into_iter().map(|x| -x).collect();
        let views = self
            .views
            .iter()
            .zip(inverses)
            .map(|(view, inverse)| {
                let mut right = view.gradient;
                for (row, across) in &view.across {
                    for (sum, a) in right.iter_mut().zip(across) {
                        *sum += a * shared[*row];
                    }
                }
                std::array::from_fn(|i| -dot(&inverse[i], &right))
            })
            .collect();
        Some((shared, views))
    }
}

fn dot(a: &[f64; 6], b: &[f64; 6]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
