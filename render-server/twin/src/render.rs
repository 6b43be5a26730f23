//! Runs the passes in order, forward and backward, with the buffers between them.
//!
//! Every sum has a fixed order, so results do not depend on the number of threads.

use rayon::prelude::*;
use vizflyt_splat::simd::{InstructionSet, Kernel, Simd};

use crate::bin::Bins;
use crate::blend::{BY_CHANNELS, Backward, CHANNELS, Forward, PairSums, SUMS, flat_gradient};
use crate::gaussians::Gaussians;
use crate::planes::Planes;
use crate::project::{Flat, RowGradient, Style};
use crate::view::View;

/// Names of the channels of an image, and of its derivative.
pub mod channel {
    /// Red, then green and blue; without a background.
    pub const RED: usize = 0;
    /// `sum w z`. [units of the dataset]
    pub const FIRST: usize = 3;
    /// `sum w z^2`.
    pub const SECOND: usize = 4;
    /// Share of light that passes all Gaussians, 0 to 1.
    pub const TRANSMITTANCE: usize = 5;
    /// Number of channels of an image.
    pub const COUNT: usize = super::CHANNELS;
    /// Weight of a pixel's error; only in derivatives.
    pub const ERROR: usize = COUNT;
    /// Number of channels of a derivative.
    pub const BY_COUNT: usize = super::BY_CHANNELS;
}

/// Renders Gaussians and propagates derivatives back to them. Buffers are reused between images.
#[derive(Debug)]
pub struct Renderer {
    instructions: InstructionSet,
    /// Gaussians of the last image.
    flats: Vec<Flat>,
    chunks: Vec<Vec<Flat>>,
    bins: Bins,
    image: Planes,
    pairs: Vec<PairSums>,
}

/// Rows that one thread projects at a time.
const CHUNK: usize = 1024;

impl Default for Renderer {
    fn default() -> Self {
        Self::with(InstructionSet::available()[0])
    }
}

impl Renderer {
    /// Returns a renderer for an instruction set.
    pub fn with(instructions: InstructionSet) -> Self {
        Self {
            instructions,
            flats: Vec::new(),
            chunks: Vec::new(),
            bins: Bins::default(),
            image: Planes::default(),
            pairs: Vec::new(),
        }
    }

    /// Returns `cpu` and the instruction set.
    pub(crate) fn name(&self) -> &'static str {
        self.instructions.name()
    }

    /// Renders a view. The channels are those of [`channel`].
    pub fn forward(&mut self, gaussians: &Gaussians, view: &View, style: Style) -> &Planes {
        let instructions = self.instructions;
        let stride = gaussians.stride();
        let count = gaussians.len().div_ceil(CHUNK);
        if self.chunks.len() < count {
            self.chunks.resize_with(count, Vec::new);
        }
        self.chunks[..count]
            .par_iter_mut()
            .zip(gaussians.values.par_chunks(CHUNK * stride))
            .enumerate()
            .for_each(|(i, (out, rows))| {
                out.clear();
                let first = (i * CHUNK) as u32;
                instructions.run(Project { rows, stride, first, view, style, out });
            });
        self.flats.clear();
        for chunk in &self.chunks[..count] {
            self.flats.extend_from_slice(chunk);
        }
        self.bins.bin(&self.flats, view.width, view.height);
        self.image.resize(CHANNELS, view.width, view.height);
        let (len, stride) = (self.image.band_len(), self.image.stride);
        let (flats, bins) = (&self.flats[..], &self.bins);
        self.image.values.par_chunks_mut(len).enumerate().with_max_len(1).for_each(
            |(band, out)| {
                instructions.run(Forward { flats, bins, band, stride, out });
            },
        );
        &self.image
    }

    /// Returns the rows visible in the last image, in ascending order.
    pub fn seen(&self) -> impl ExactSizeIterator<Item = usize> + '_ {
        self.flats.iter().map(|flat| flat.index as usize)
    }

    /// Returns the number of (tile, Gaussian) pairs of the last image.
    pub fn pairs(&self) -> usize {
        self.bins.entries.len()
    }

    /// Propagates a derivative by the last image's channels back to the visible rows.
    pub(crate) fn backward(
        &mut self,
        gaussians: &Gaussians,
        view: &View,
        style: Style,
        by: &Planes,
        out: &mut Vec<RowGradient>,
    ) {
        let instructions = self.instructions;
        assert_eq!((by.channels, by.width, by.height), (BY_CHANNELS, view.width, view.height));
        let (flats, bins) = (&self.flats[..], &self.bins);
        self.pairs.resize(bins.entries.len(), [0.0; SUMS]);
        let (len, stride) = (self.image.band_len(), self.image.stride);
        // The pairs of a band are contiguous.
        let mut bands = Vec::with_capacity(self.image.bands());
        let mut rest = &mut self.pairs[..];
        for band in 0..self.image.bands() {
            let first = bins.starts[band * bins.tiles_x];
            let end = bins.starts[(band + 1) * bins.tiles_x];
            let (pairs, more) = rest.split_at_mut((end - first) as usize);
            bands.push(pairs);
            rest = more;
        }
        bands
            .into_par_iter()
            .zip(self.image.values.par_chunks(len))
            .zip(by.values.par_chunks(by.band_len()))
            .enumerate()
            .with_max_len(1)
            .for_each(|(band, ((out, image), by))| {
                instructions.run(Backward { flats, bins, band, stride, image, by, out });
            });
        out.resize(flats.len(), RowGradient::default());
        let pairs = &self.pairs[..];
        out.par_chunks_mut(CHUNK).zip(flats.par_chunks(CHUNK)).enumerate().for_each(
            |(chunk, (out, flats))| {
                let first = chunk * CHUNK;
                instructions.run(Unproject {
                    gaussians,
                    view,
                    style,
                    flats,
                    first,
                    bins,
                    pairs,
                    out,
                });
            },
        );
    }
}

/// Projects a chunk of rows.
struct Project<'a> {
    rows: &'a [f32],
    stride: usize,
    first: u32,
    view: &'a View,
    style: Style,
    out: &'a mut Vec<Flat>,
}

impl Kernel for Project<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        for (i, row) in self.rows.chunks_exact(self.stride).enumerate() {
            if let Some(flat) = Flat::of(row, self.first + i as u32, self.view, self.style) {
                self.out.push(flat);
            }
        }
    }
}

/// Sums the pairs of a chunk of projected Gaussians and propagates them back to their rows.
struct Unproject<'a> {
    gaussians: &'a Gaussians,
    view: &'a View,
    style: Style,
    flats: &'a [Flat],
    first: usize,
    bins: &'a Bins,
    pairs: &'a [PairSums],
    out: &'a mut [RowGradient],
}

impl Kernel for Unproject<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        for (i, (flat, out)) in self.flats.iter().zip(self.out).enumerate() {
            let i = self.first + i;
            let places = self.bins.firsts[i] as usize..self.bins.firsts[i + 1] as usize;
            let mut sums = [0.0; SUMS];
            for &place in &self.bins.places[places] {
                let pair = &self.pairs[place as usize];
                for k in 0..SUMS {
                    sums[k] += pair[k];
                }
            }
            let by = flat_gradient(flat, &sums);
            *out =
                Flat::backward(self.gaussians.row(flat.index as usize), self.view, self.style, &by);
            out.error = sums[SUMS - 1];
        }
    }
}

#[cfg(test)]
pub(crate) mod tests;
