//! Trained parameters: Gaussians in an unconstrained form for the optimiser, one row of numbers each.
//!
//! A row holds mean [3, units of the dataset], natural logarithms of the scales [3], rotation [4, xyzw, any length
//! except 0], logit of the opacity, and the harmonics (coefficient by coefficient, RGB within), as in Kerbl et al.
//! 2023. Uniform rows make the optimiser's moments, copies and checkpoints simple.

use std::ops::Range;

use glam::{Quat, Vec3};
use rayon::prelude::*;
use vizflyt_splat::Splats;

/// Column indices of a row.
pub mod column {
    /// Mean, 3.
    pub const MEAN: usize = 0;
    /// Logarithms of the scales, 3.
    pub const LOG_SCALE: usize = 3;
    /// Rotation, 4.
    pub const ROTATION: usize = 6;
    /// Logit of the opacity.
    pub const LOGIT: usize = 10;
    /// Harmonics, to the end.
    pub const SH: usize = 11;
}

/// Rows of parameters, or of other values with the same layout.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians {
    /// Degree of the harmonics, 0 to 3.
    pub degree: u8,
    /// Values, row by row, [`Self::stride`] each.
    pub values: Vec<f32>,
}

impl Gaussians {
    /// Returns an empty set with harmonics of a degree.
    pub fn new(degree: u8) -> Self {
        assert!(degree <= 3, "harmonics go to degree 3");
        Self { degree, values: Vec::new() }
    }

    /// Returns the number of values per row: 14, 23, 38 or 59.
    pub fn stride(&self) -> usize {
        column::SH + 3 * coefficients(self.degree)
    }

    /// Returns the number of rows.
    pub fn len(&self) -> usize {
        self.values.len() / self.stride()
    }

    /// Returns whether there are no rows.
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    pub fn row(&self, i: usize) -> &[f32] {
        let stride = self.stride();
        &self.values[i * stride..(i + 1) * stride]
    }

    /// Returns a mutable row.
    pub fn row_mut(&mut self, i: usize) -> &mut [f32] {
        let stride = self.stride();
        &mut self.values[i * stride..(i + 1) * stride]
    }

    /// Calls `change` for each of the given rows (in ascending order), in parallel.
    pub(crate) fn change(&mut self, rows: &[u32], change: impl Fn(u32, &mut [f32]) + Sync) {
        let stride = self.stride();
        self.values.par_chunks_mut(CHUNK * stride).enumerate().for_each(|(chunk, values)| {
            let first = chunk * CHUNK;
            for &row in &rows[within(rows, first)] {
                let at = (row as usize - first) * stride;
                change(row, &mut values[at..at + stride]);
            }
        });
    }

    /// Returns rows of zeros with the same layout.
    pub fn zeros(&self) -> Self {
        Self { degree: self.degree, values: vec![0.0; self.values.len()] }
    }

    /// Appends a Gaussian of uniform colour. [units of the dataset; sRGB, 0 to 1]
    pub fn push(&mut self, mean: Vec3, scales: Vec3, rotation: Quat, opacity: f32, rgb: [f32; 3]) {
        let start = self.values.len();
        self.values.extend(mean.to_array());
        self.values.extend(scales.to_array().map(f32::ln));
        self.values.extend(rotation.to_array());
        self.values.push((opacity / (1.0 - opacity)).ln());
        self.values.extend(rgb.map(|v| (v - 0.5) / vizflyt_splat::harmonics::C0 as f32));
        self.values.resize(start + self.stride(), 0.0);
    }

    /// Returns the parameters of activated splats.
    pub fn from_splats(splats: &Splats) -> Self {
        let mut gaussians = Self::new(splats.sh_degree);
        let numbers = 3 * splats.sh_coefficients();
        for i in 0..splats.len() {
            let opacity = splats.opacities[i].clamp(1e-6, 1.0 - 1e-6);
            gaussians.values.extend(splats.means_m[i].to_array());
            gaussians.values.extend(splats.scales_m[i].to_array().map(|s| s.max(1e-9).ln()));
            gaussians.values.extend(splats.rotations[i].to_array());
            gaussians.values.push((opacity / (1.0 - opacity)).ln());
            gaussians.values.extend(&splats.sh[i * numbers..(i + 1) * numbers]);
        }
        gaussians
    }

    /// Returns the Gaussians as splats for rendering, without rows that are not finite.
    pub fn to_splats(&self) -> Splats {
        let mut splats = Splats { sh_degree: self.degree, ..Splats::default() };
        for row in self.values.chunks_exact(self.stride()) {
            let rotation = Quat::from_slice(&row[column::ROTATION..]).normalize();
            if !(row.iter().all(|v| v.is_finite()) && rotation.is_finite()) {
                continue;
            }
            splats.means_m.push(Vec3::from_slice(&row[column::MEAN..]));
            let scale = |k: usize| row[column::LOG_SCALE + k].exp();
            splats.scales_m.push(Vec3::new(scale(0), scale(1), scale(2)));
            splats.rotations.push(rotation);
            splats.opacities.push(sigmoid(row[column::LOGIT]));
            splats.sh.extend(&row[column::SH..]);
        }
        splats
    }
}

/// Rows per unit of parallel work.
pub(crate) const CHUNK: usize = 1024;

/// Returns the range of the ascending `rows` that lies in the chunk starting at row `first`.
pub(crate) fn within(rows: &[u32], first: usize) -> Range<usize> {
    let place = |row: usize| rows.partition_point(|&r| (r as usize) < row);
    place(first)..place(first + CHUNK)
}

/// Returns the number of coefficients of a degree: 1, 4, 9 or 16.
pub(crate) fn coefficients(degree: u8) -> usize {
    (usize::from(degree) + 1).pow(2)
}

/// Returns the opacity of a logit.
pub(crate) fn sigmoid(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

/// Returns the inverse of [`sigmoid`].
pub(crate) fn logit(opacity: f32) -> f32 {
    (opacity / (1.0 - opacity)).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn converts_splats_without_loss() {
        let splats = Splats {
            means_m: vec![Vec3::new(1.0, -2.0, 3.0), Vec3::ZERO],
            scales_m: vec![Vec3::new(0.1, 0.02, 0.5), Vec3::splat(0.3)],
            rotations: vec![Quat::from_rotation_x(0.7), Quat::IDENTITY],
            opacities: vec![0.3, 0.99],
            sh_degree: 1,
            sh: (0..24).map(|i| i as f32 / 24.0).collect(),
            antialiased: false,
        };
        let back = Gaussians::from_splats(&splats).to_splats();
        assert_eq!(back.len(), 2);
        assert_eq!((&back.means_m, &back.sh), (&splats.means_m, &splats.sh));
        for i in 0..2 {
            assert!((back.scales_m[i] - splats.scales_m[i]).length() < 1e-6);
            assert!((back.opacities[i] - splats.opacities[i]).abs() < 1e-6);
            assert!(back.rotations[i].dot(splats.rotations[i]) > 1.0 - 1e-6);
        }
    }

    #[test]
    fn omits_rows_that_are_not_finite() {
        let mut gaussians = Gaussians::new(0);
        for _ in 0..3 {
            gaussians.push(Vec3::ZERO, Vec3::ONE, Quat::IDENTITY, 0.5, [0.2; 3]);
        }
        gaussians.row_mut(1)[column::LOG_SCALE] = f32::NAN;
        gaussians.row_mut(2)[column::ROTATION..column::LOGIT].fill(0.0);
        assert_eq!(gaussians.to_splats().len(), 1);
    }
}
