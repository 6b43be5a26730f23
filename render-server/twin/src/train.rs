//! Training schedule: photo order, learning rates, and relocation and growth of the Gaussians.
//!
//! One step: a photo that is not held out is drawn, rendered on a random background (so that walls become opaque) and
//! compared, and every visible Gaussian is updated once. The same dataset, options and kind of processor give the same
//! twin, for any number of threads.

mod checkpoint;
mod start;

pub use checkpoint::{Checkpoint, CheckpointError};

use std::time::Instant;

use rayon::prelude::*;
use vizflyt_splat::Splats;
use vizflyt_splat::gpu::training::Changed;
use vizflyt_splat::simd::InstructionSet;

use crate::adam::{AdamStep, Moments, Rates, Tolls};
use crate::dataset::{Dataset, Photo};
use crate::gaussians::{CHUNK, Gaussians, coefficients, column, within};
use crate::loss::{Exposure, Loss, Parts, Weights};
use crate::passes::Passes;
use crate::project::{RowGradient, Style};
use crate::random::Random;
use crate::relocate::{relocate, wander};
use crate::times::{Times, lap};

/// Training options.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// Number of steps; each trains with one photo.
    pub steps: u32,
    /// Maximum number of Gaussians.
    pub splats: usize,
    /// Degree of the harmonics, 0 to 3.
    pub degree: u8,
    /// Random seed: the same seed gives the same twin.
    pub seed: u64,
    /// Interval of held-out photos, starting with the first: `8` holds out every eighth photo for evaluation; 0 holds
    /// out none.
    pub hold_out: usize,
    /// Train for a renderer that dims splats smaller than a pixel.
    pub antialiased: bool,
    /// Estimate the brightness and colour of each photo.
    pub exposure: bool,
    /// Weights of the parts of the loss.
    pub weights: Weights,
    /// Regularisation weights.
    pub tolls: Tolls,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            steps: 3000,
            splats: 60_000,
            degree: 2,
            seed: 1,
            hold_out: 8,
            antialiased: false,
            exposure: true,
            weights: Weights { dssim: 0.2, depth: 0.5, spread: 0.02, bend: 0.1 },
            tolls: Tolls { opacity: 0.01, scale: 0.01, thickness: 0.1, needle: 0.001 },
        }
    }
}

/// A running training.
#[derive(Debug)]
pub struct Trainer<'a> {
    dataset: &'a Dataset,
    options: Options,
    extent: f32,
    gaussians: Gaussians,
    moments: Moments,
    exposures: Vec<ExposureState>,
    passes: Passes,
    loss: Loss,
    gradients: Vec<RowGradient>,
    seen: Vec<u32>,
    /// Number of values per row in `seen` that changed since the last rendering; `None`: any value of any row.
    stale: Option<usize>,
    /// Error seen through each Gaussian since the last relocation.
    errors: Vec<f32>,
    /// Photos left in this shuffled pass over the dataset.
    queue: Vec<usize>,
    random: Random,
    step: u32,
    /// Step after which `times` counts; `times` holds sums.
    timed_from: u32,
    times: Times,
}

/// Exposure of a photo and its moments: gain, then offset.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct ExposureState {
    exposure: Exposure,
    first: [f32; 6],
    second: [f32; 6],
    steps: i32,
}

/// Image quality of the held-out photos.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Quality {
    /// Number of held-out photos.
    pub photos: usize,
    /// Mean peak signal-to-noise ratio. [dB]
    pub psnr_db: f64,
    /// Mean structural similarity; at most 1.
    pub ssim: f64,
}

/// Comparison of a photo with its rendering.
#[derive(Clone, Debug, PartialEq)]
pub struct Comparison {
    /// Peak signal-to-noise ratio. [dB]
    pub psnr_db: f64,
    /// Structural similarity; at most 1.
    pub ssim: f64,
    /// Rendering at the photo's size, H x W x 3, sRGB.
    pub rgb: Vec<u8>,
}

impl<'a> Trainer<'a> {
    /// Starts a training on the processor.
    ///
    /// # Panics
    /// If the dataset has no photo, or all photos are held out.
    pub fn new(dataset: &'a Dataset, options: Options) -> Self {
        Self::with(dataset, options, Passes::cpu())
    }

    /// Starts a training on a device.
    ///
    /// # Panics
    /// If the dataset has no photo, or all photos are held out.
    pub fn with(dataset: &'a Dataset, options: Options, passes: Passes) -> Self {
        let extent = dataset.extent();
        let gaussians = start::gaussians(dataset, &options, extent);
        let trainer = Self {
            dataset,
            options,
            extent,
            moments: Moments::of(&gaussians),
            errors: vec![0.0; gaussians.len()],
            gaussians,
            exposures: vec![ExposureState::default(); dataset.photos.len()],
            passes,
            loss: Loss::default(),
            gradients: Vec::new(),
            seen: Vec::new(),
            stale: None,
            queue: Vec::new(),
            random: Random::stream(options.seed, 1),
            step: 0,
            timed_from: 0,
            times: Times::default(),
        };
        assert!(trainer.trained().next().is_some(), "no photo to train with");
        trainer
    }

    /// Returns the number of completed steps.
    pub fn steps(&self) -> u32 {
        self.step
    }

    /// Returns the device's passes.
    pub fn passes(&mut self) -> &mut Passes {
        &mut self.passes
    }

    /// Returns the mean time of each part of a step, over the steps of this process.
    pub fn times(&self) -> Times {
        let device = self.passes.device_times();
        Times { device, ..self.times }.mean(self.step - self.timed_from)
    }

    pub fn gaussians(&self) -> &Gaussians {
        &self.gaussians
    }

    /// Returns the twin in its present state, without invisible splats.
    pub fn splats(&self) -> Splats {
        let mut splats = self.gaussians.to_splats();
        let visible: Vec<bool> = splats.opacities.iter().map(|&o| o >= 1.0 / 255.0).collect();
        let numbers = 3 * splats.sh_coefficients();
        let keep = |i: usize| visible[i];
        retain(&mut splats.means_m, 1, keep);
        retain(&mut splats.scales_m, 1, keep);
        retain(&mut splats.rotations, 1, keep);
        retain(&mut splats.opacities, 1, keep);
        retain(&mut splats.sh, numbers, keep);
        splats
    }

    /// Runs one step; returns the parts of the loss before it.
    pub fn step(&mut self) -> Parts {
        let mut start = Instant::now();
        let photo = self.draw();
        let Photo { view, target, .. } = &self.dataset.photos[photo];
        let style = self.style();
        let background = std::array::from_fn(|_| self.random.unit());
        let exposure = self.exposures[photo].exposure;
        let weights = self.options.weights;
        let changed = changed(self.stale, &self.seen);
        let image = self.passes.forward(&self.gaussians, changed, view, style);
        lap(&mut self.times.forward, &mut start);
        let (parts, by_exposure, by) = self.loss.of(image, target, &exposure, background, &weights);
        lap(&mut self.times.loss, &mut start);
        let (seen, gradients) = (&mut self.seen, &mut self.gradients);
        self.passes.backward(&self.gaussians, view, style, by, seen, gradients);
        lap(&mut self.times.backward, &mut start);
        note(&mut self.errors, &self.seen, &self.gradients);
        self.step += 1;
        let rates = self.rates();
        let step = AdamStep {
            seen: &self.seen,
            gradients: &self.gradients,
            number: self.step,
            rates,
            tolls: self.options.tolls,
            extent: self.extent,
            degree: style.degree,
        };
        step.apply(InstructionSet::available()[0], &mut self.gaussians, &mut self.moments);
        self.stale = Some(column::SH + 3 * coefficients(style.degree));
        if self.options.exposure {
            let rate = EXPOSURE_RATE * self.decay(0.1);
            self.exposures[photo].apply(&by_exposure, rate);
        }
        lap(&mut self.times.adam, &mut start);
        if self.is_moving() {
            let seed = self.options.seed ^ (u64::from(self.step) << 32);
            wander(&mut self.gaussians, &self.seen, NOISE * rates.mean, seed);
            lap(&mut self.times.wander, &mut start);
            if self.step.is_multiple_of(RELOCATE_EVERY) {
                let grow = self.growth();
                let (gaussians, moments) = (&mut self.gaussians, &mut self.moments);
                relocate(gaussians, moments, &mut self.errors, grow, &mut self.random);
                self.stale = None;
                lap(&mut self.times.relocate, &mut start);
            }
        }
        parts
    }

    /// Returns the mean quality of the held-out photos, each with its best-fitting exposure; `None` if no photo is held
    /// out.
    pub fn judge(&mut self) -> Option<Quality> {
        let held_out = self.held_out();
        let (mut psnr_db, mut ssim) = (0.0, 0.0);
        for &photo in &held_out {
            let comparison = self.compare(photo);
            psnr_db += comparison.psnr_db;
            ssim += comparison.ssim;
        }
        let photos = held_out.len();
        let share = 1.0 / photos as f64;
        (photos > 0).then_some(Quality { photos, psnr_db: psnr_db * share, ssim: ssim * share })
    }

    /// Returns the indices of the held-out photos.
    pub fn held_out(&self) -> Vec<usize> {
        (0..self.dataset.photos.len()).filter(|&i| self.is_held_out(i)).collect()
    }

    /// Renders the view of a photo, with the best-fitting exposure.
    ///
    /// # Panics
    /// If the index is out of range.
    pub fn compare(&mut self, photo: usize) -> Comparison {
        let Photo { view, target, .. } = &self.dataset.photos[photo];
        let style = Style { degree: self.options.degree, ..self.style() };
        let changed = changed(self.stale.replace(0), &self.seen);
        let image = self.passes.forward(&self.gaussians, changed, view, style);
        let exposure = if self.options.exposure {
            Exposure::fitting(image, target)
        } else {
            Exposure::default()
        };
        let (psnr_db, ssim) = self.loss.quality(image, target, &exposure);
        let level = |c: usize, value: f32| {
            let exposed = value * exposure.gain[c] + exposure.offset[c];
            (exposed.clamp(0.0, 1.0) * 255.0).round() as u8
        };
        let mut rgb = Vec::with_capacity(3 * image.width * image.height);
        for y in 0..image.height {
            for x in 0..image.width {
                rgb.extend((0..3).map(|c| level(c, image.at(c, x, y))));
            }
        }
        Comparison { psnr_db, ssim, rgb }
    }

    fn is_held_out(&self, photo: usize) -> bool {
        self.options.hold_out > 0 && photo.is_multiple_of(self.options.hold_out)
    }

    fn trained(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.dataset.photos.len()).filter(|&i| !self.is_held_out(i))
    }

    /// Returns the next photo: each once in random order, then all again.
    fn draw(&mut self) -> usize {
        if self.queue.is_empty() {
            self.queue = self.trained().collect();
            self.random.shuffle(&mut self.queue);
        }
        self.queue.pop().expect("some photo is trained with")
    }

    /// Returns the fraction of completed steps.
    fn progress(&self) -> f32 {
        self.step as f32 / self.options.steps.max(1) as f32
    }

    /// Returns a factor that falls exponentially from 1 to `end`.
    fn decay(&self, end: f32) -> f32 {
        end.powf(self.progress().min(1.0))
    }

    fn style(&self) -> Style {
        let degree = (self.progress() * DEGREES_PER_TRAINING) as u8;
        Style { degree: degree.min(self.options.degree), antialiased: self.options.antialiased }
    }

    fn rates(&self) -> Rates {
        Rates {
            mean: MEAN_RATE * self.extent * self.decay(0.01),
            log_scale: 0.01 * self.decay(0.2),
            rotation: 0.003 * self.decay(0.2),
            logit: 0.05,
            sh: 0.005 * self.decay(0.2),
            sh_rest: 0.005 / 20.0,
        }
    }

    /// Returns whether Gaussians are relocated at this step: not at the start, before errors are known, nor at the end,
    /// when the result settles.
    fn is_moving(&self) -> bool {
        (0.02..0.85).contains(&self.progress())
    }

    /// Returns the number of Gaussians to add, so that the maximum is reached after [`GROWN`] of the steps.
    fn growth(&self) -> usize {
        let (count, budget) = (self.gaussians.len(), self.options.splats);
        let left = (GROWN - self.progress()) * self.options.steps as f32 / RELOCATE_EVERY as f32;
        let factor = (budget as f32 / count.max(1) as f32).powf(1.0 / left.max(1.0));
        let wanted = (count as f32 * (factor.min(MAX_GROWTH) - 1.0)).ceil().max(0.0) as usize;
        wanted.min(budget.saturating_sub(count))
    }
}

/// Returns the difference between the device's Gaussians and the host's; see [`Trainer::stale`].
fn changed(stale: Option<usize>, seen: &[u32]) -> Changed<'_> {
    stale.map_or(Changed::All, |columns| Changed::Rows { rows: seen, columns })
}

/// Adds the errors of the visible rows, in ascending order, to the sums.
fn note(errors: &mut [f32], seen: &[u32], gradients: &[RowGradient]) {
    errors.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, errors)| {
        let first = chunk * CHUNK;
        let part = within(seen, first);
        for (&row, by) in seen[part.clone()].iter().zip(&gradients[part]) {
            errors[row as usize - first] += by.error;
        }
    });
}

/// Keeps the items (`width` values each) for which `keep` returns true.
pub(crate) fn retain<T: Copy>(list: &mut Vec<T>, width: usize, keep: impl Fn(usize) -> bool) {
    let kept = list.chunks_exact(width).enumerate().filter(|(i, _)| keep(*i));
    *list = kept.flat_map(|(_, item)| item.iter().copied()).collect();
}

impl ExposureState {
    /// Runs one Adam step, pulled towards the identity; otherwise all photos could become brighter.
    fn apply(&mut self, by: &Exposure, rate: f32) {
        self.steps += 1;
        let (bias1, bias2) = (1.0 - 0.9f32.powi(self.steps), 1.0 - 0.999f32.powi(self.steps));
        for i in 0..6 {
            let (value, by, rest) = if i < 3 {
                (&mut self.exposure.gain[i], by.gain[i], 1.0)
            } else {
                (&mut self.exposure.offset[i - 3], by.offset[i - 3], 0.0)
            };
            let gradient = by + EXPOSURE_PULL * (*value - rest);
            self.first[i] = 0.9 * self.first[i] + 0.1 * gradient;
            self.second[i] = 0.999 * self.second[i] + 0.001 * gradient * gradient;
            *value -= rate * (self.first[i] / bias1) / ((self.second[i] / bias2).sqrt() + 1e-12);
        }
    }
}

/// Initial learning rate of the means. [extents of the capture]
const MEAN_RATE: f32 = 4e-4;
/// Noise on faint Gaussians, in learning rates of the means (Kheradmand et al. 2024, their implementation).
const NOISE: f32 = 5e5;
const RELOCATE_EVERY: u32 = 50;
/// Fraction of the steps after which the maximum number of Gaussians is reached.
const GROWN: f32 = 0.5;
/// Maximum factor of growth per relocation.
const MAX_GROWTH: f32 = 1.5;
/// Number of degrees per training: each degree is added after a fifth of the steps, the third after three fifths.
const DEGREES_PER_TRAINING: f32 = 5.0;
const EXPOSURE_RATE: f32 = 3e-3;
/// Strength of the exposures' pull towards the identity.
const EXPOSURE_PULL: f32 = 0.02;

#[cfg(test)]
mod tests;
