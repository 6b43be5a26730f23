//! Optimiser: Adam (Kingma and Ba 2015) on the rows visible in an image.
//!
//! Rows that no pixel of the image sees keep their moments (as in Mallick et al. 2024, "Taming 3DGS"): their gradient
//! is unknown, not zero.

use rayon::prelude::*;
use vizflyt_splat::simd::{InstructionSet, Kernel, Simd};

use crate::gaussians::{CHUNK, Gaussians, coefficients, column, sigmoid, within};
use crate::project::RowGradient;

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPSILON: f32 = 1e-15;

/// Learning rates of each group of columns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// Means. [units of the dataset]
    pub mean: f32,
    /// Logarithms of the scales.
    pub log_scale: f32,
    /// Rotations.
    pub rotation: f32,
    /// Logits.
    pub logit: f32,
    /// Constant harmonic.
    pub sh: f32,
    /// Other harmonics.
    pub sh_rest: f32,
}

/// Regularisation weights against haze and needles; each applies to a mean over all rows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tolls {
    /// Weight of the opacity.
    pub opacity: f32,
    /// Weight of the scales, relative to the extent of the capture.
    pub scale: f32,
    /// Weight of the smallest scale, relative to the extent: surfaces are flat.
    pub thickness: f32,
    /// Weight of the log ratio of the largest scale to the middle one, above [`MAX_RATIO`].
    pub needle: f32,
}

/// Maximum unpenalised ratio of a disc's two larger scales.
const MAX_RATIO: f32 = 3.0;

/// First and second moments of every row.
#[derive(Clone, Debug, PartialEq)]
pub struct Moments {
    /// Moments of the gradient.
    pub first: Gaussians,
    /// Moments of its square.
    pub second: Gaussians,
}

impl Moments {
    /// Returns zero moments.
    pub fn of(gaussians: &Gaussians) -> Self {
        Self { first: gaussians.zeros(), second: gaussians.zeros() }
    }
}

/// One optimiser step of all visible rows.
pub(crate) struct AdamStep<'a> {
    /// Visible rows, ascending, one per gradient.
    pub(crate) seen: &'a [u32],
    pub(crate) gradients: &'a [RowGradient],
    /// Step number, from 1.
    pub(crate) number: u32,
    pub(crate) rates: Rates,
    pub(crate) tolls: Tolls,
    /// Extent of the capture. [units of the dataset]
    pub(crate) extent: f32,
    /// Degree of the harmonics used.
    pub(crate) degree: u8,
}

impl AdamStep<'_> {
    /// Updates the rows.
    pub(crate) fn apply(
        &self,
        instructions: InstructionSet,
        gaussians: &mut Gaussians,
        moments: &mut Moments,
    ) {
        let (stride, rows) = (gaussians.stride(), gaussians.len());
        let len = CHUNK * stride;
        gaussians
            .values
            .par_chunks_mut(len)
            .zip(moments.first.values.par_chunks_mut(len))
            .zip(moments.second.values.par_chunks_mut(len))
            .enumerate()
            .for_each(|(chunk, ((values, first), second))| {
                let first_row = chunk * CHUNK;
                let part = within(self.seen, first_row);
                instructions.run(Rows {
                    step: self,
                    stride,
                    rows,
                    seen: &self.seen[part.clone()],
                    gradients: &self.gradients[part],
                    first_row,
                    values,
                    first,
                    second,
                });
            });
    }

    /// Returns the gradient of a row including regularisation, up to the harmonics used.
    #[inline(always)]
    fn gradient(&self, row: &[f32], by: &RowGradient, rows: usize) -> [f32; 59] {
        let mut out = [0.0; 59];
        out[..column::SH].copy_from_slice(&by.geometry);
        for k in 0..coefficients(self.degree) {
            for channel in 0..3 {
                out[column::SH + 3 * k + channel] = by.basis[k] * by.rgb[channel];
            }
        }
        let share = 1.0 / rows as f32;
        let opacity = sigmoid(row[column::LOGIT]);
        out[column::LOGIT] += self.tolls.opacity * share * opacity * (1.0 - opacity);
        let logs: [f32; 3] = std::array::from_fn(|k| row[column::LOG_SCALE + k]);
        let scales = logs.map(|log| log.exp() / self.extent);
        let mut order = [0, 1, 2];
        order.sort_unstable_by(|&a, &b| logs[a].total_cmp(&logs[b]));
        let [least, middle, greatest] = order;
        for k in 0..3 {
            out[column::LOG_SCALE + k] += self.tolls.scale * share / 3.0 * scales[k];
        }
        out[column::LOG_SCALE + least] += self.tolls.thickness * share * scales[least];
        if logs[greatest] - logs[middle] > MAX_RATIO.ln() {
            out[column::LOG_SCALE + greatest] += self.tolls.needle * share;
            out[column::LOG_SCALE + middle] -= self.tolls.needle * share;
        }
        out
    }
}

/// A chunk of rows.
struct Rows<'a> {
    step: &'a AdamStep<'a>,
    stride: usize,
    rows: usize,
    seen: &'a [u32],
    gradients: &'a [RowGradient],
    first_row: usize,
    values: &'a mut [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
}

impl Kernel for Rows<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let Rates { mean, log_scale, rotation, logit, sh, sh_rest } = self.step.rates;
        let mut rates = [sh_rest; 59];
        rates[column::MEAN..column::LOG_SCALE].fill(mean);
        rates[column::LOG_SCALE..column::ROTATION].fill(log_scale);
        rates[column::ROTATION..column::LOGIT].fill(rotation);
        rates[column::LOGIT] = logit;
        rates[column::SH..column::SH + 3].fill(sh);
        let number = self.step.number as i32;
        let bias1 = 1.0 / (1.0 - BETA1.powi(number));
        let bias2 = 1.0 / (1.0 - BETA2.powi(number));
        let counted = column::SH + 3 * coefficients(self.step.degree);
        for (&row, by) in self.seen.iter().zip(self.gradients) {
            let at = (row as usize - self.first_row) * self.stride;
            let values = &mut self.values[at..at + counted];
            let gradient = self.step.gradient(values, by, self.rows);
            // A row with an invalid gradient stays unchanged.
            if !is_finite(&gradient) {
                continue;
            }
            let first = &mut self.first[at..at + counted];
            let second = &mut self.second[at..at + counted];
            let steps = values.iter_mut().zip(first).zip(second).zip(&gradient).zip(&rates);
            for ((((value, first), second), gradient), rate) in steps {
                *first = BETA1 * *first + (1.0 - BETA1) * gradient;
                *second = BETA2 * *second + (1.0 - BETA2) * gradient * gradient;
                *value -= rate * *first * bias1 / ((*second * bias2).sqrt() + EPSILON);
            }
        }
    }
}

/// Returns whether the sum of the numbers is finite, in eight partial sums (for SIMD).
#[inline(always)]
fn is_finite(numbers: &[f32]) -> bool {
    let mut sums = [0.0f32; 8];
    for numbers in numbers.chunks(8) {
        for (sum, number) in sums.iter_mut().zip(numbers) {
            *sum += number;
        }
    }
    sums.iter().sum::<f32>().is_finite()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec3};

    #[test]
    fn first_step_equals_the_rate_and_goes_downhill() {
        let mut gaussians = Gaussians::new(0);
        for _ in 0..3 {
            gaussians.push(Vec3::ZERO, Vec3::splat(0.1), Quat::IDENTITY, 0.5, [0.5; 3]);
        }
        let before = gaussians.clone();
        let mut moments = Moments::of(&gaussians);
        let mut by = RowGradient::default();
        by.geometry[column::MEAN] = 3.0;
        by.geometry[column::LOGIT] = -0.01;
        let rates =
            Rates { mean: 0.1, log_scale: 0.2, rotation: 0.3, logit: 0.4, sh: 0.5, sh_rest: 0.6 };
        let tolls = Tolls { opacity: 0.0, scale: 0.0, thickness: 0.0, needle: 0.0 };
        let step = AdamStep {
            seen: &[1],
            gradients: &[by],
            number: 1,
            rates,
            tolls,
            extent: 1.0,
            degree: 0,
        };
        step.apply(InstructionSet::available()[0], &mut gaussians, &mut moments);
        assert_eq!(gaussians.row(0), before.row(0));
        assert_eq!(gaussians.row(2), before.row(2));
        // Adam's first step equals its rate, for any gradient length.
        assert!((gaussians.row(1)[column::MEAN] + 0.1).abs() < 1e-6);
        assert!((gaussians.row(1)[column::LOGIT] - 0.4).abs() < 1e-6);
        assert_eq!(gaussians.row(1)[column::LOG_SCALE], before.row(1)[column::LOG_SCALE]);
    }
}
