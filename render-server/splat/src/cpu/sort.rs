//! Pass 3: sorts the slots of projected splats from near to far.
//!
//! Parallel radix sort, least significant digit first: two stable passes of 11 bits. Keys are the f32 bits of the
//! depth minus those of the nearest, shifted so that the range fits 22 bits. A scene from 0.2 to 50 m is ordered to
//! 2e-6 relative, less than the difference between two f32 projections.
//!
//! Each slice counts its digits. The counts determine the output positions of every slice, and all slices scatter at
//! once. The positions are disjoint, but the borrow checker cannot prove that: the arrays are relaxed atomics, which
//! compile to plain moves.
//!
//! Budget: 16 bytes moved per splat and pass, 2-4 ns per splat and thread.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use rayon::prelude::*;

use super::project::Projected;
use super::scene::BLOCK;

const DIGIT_BITS: u32 = 11;
const BINS: usize = 1 << DIGIT_BITS;
/// Minimum slice; for smaller inputs, a second slice costs more than it saves.
const MIN_SLICE: usize = 4096;

/// Buffers of the sort, and its result.
#[derive(Debug, Default)]
pub(super) struct Sorter {
    /// Result of the first pass: key in the upper half, slot in the lower half.
    half_sorted: Vec<AtomicU64>,
    /// Slots from near to far; the first `len` are valid.
    order: Vec<AtomicU32>,
    len: usize,
    /// Digit counts per slice.
    histograms: Vec<Vec<u32>>,
    /// First region of each slice, and the end of the last slice.
    bounds: Vec<usize>,
}

impl Sorter {
    /// Returns the slots from near to far.
    pub(super) fn order(&self) -> &[AtomicU32] {
        &self.order[..self.len]
    }

    /// Sorts all projected splats by depth.
    pub(super) fn sort(&mut self, projected: &Projected) {
        let len: usize = projected.counts.iter().map(|&count| count as usize).sum();
        self.len = len;
        if self.order.len() < len {
            self.half_sorted.resize_with(len, AtomicU64::default);
            self.order.resize_with(len, AtomicU32::default);
        }
        let slices = (len / MIN_SLICE).clamp(1, rayon::current_num_threads());
        // Never fewer than before, to keep their memory.
        if self.histograms.len() < slices {
            self.histograms.resize_with(slices, || vec![0; BINS]);
        }
        self.split_regions(&projected.counts, len, slices);
        let histograms = &mut self.histograms[..slices];

        let (least, shift) = key_range(projected);
        let regions = |slice: usize| self.bounds[slice]..self.bounds[slice + 1];
        let keys = |region: usize| {
            projected.keys[region * BLOCK..][..projected.counts[region] as usize].iter()
        };
        // Keys have 22 bits, so the upper digit needs no mask.
        let compact = |key: u32| (key - least) >> shift;
        let low = |key: u32| key as usize % BINS;
        let high = |key: u32| (key >> DIGIT_BITS) as usize % BINS;

        histograms.par_iter_mut().enumerate().for_each(|(slice, histogram)| {
            histogram.fill(0);
            for key in regions(slice).flat_map(keys) {
                histogram[low(compact(*key))] += 1;
            }
        });
        to_places(histograms);
        let half_sorted = &self.half_sorted;
        histograms.par_iter_mut().enumerate().for_each(|(slice, places)| {
            for region in regions(slice) {
                for (i, &key) in keys(region).enumerate() {
                    let key = compact(key);
                    let place = &mut places[low(key)];
                    let slot = (region * BLOCK + i) as u64;
                    half_sorted[*place as usize].store(u64::from(key) << 32 | slot, Relaxed);
                    *place += 1;
                }
            }
        });

        let half_sorted = &self.half_sorted[..len];
        let part = |slice: usize| &half_sorted[len * slice / slices..len * (slice + 1) / slices];
        histograms.par_iter_mut().enumerate().for_each(|(slice, histogram)| {
            histogram.fill(0);
            for pair in part(slice) {
                histogram[high((pair.load(Relaxed) >> 32) as u32)] += 1;
            }
        });
        to_places(histograms);
        let order = &self.order;
        histograms.par_iter_mut().enumerate().for_each(|(slice, places)| {
            for pair in part(slice) {
                let pair = pair.load(Relaxed);
                let place = &mut places[high((pair >> 32) as u32)];
                order[*place as usize].store(pair as u32, Relaxed);
                *place += 1;
            }
        });
    }

    /// Splits the regions into slices with similar numbers of splats.
    fn split_regions(&mut self, counts: &[u32], len: usize, slices: usize) {
        self.bounds.clear();
        self.bounds.push(0);
        let mut before = 0;
        for (region, &count) in counts.iter().enumerate() {
            before += count as usize;
            if before * slices >= len * self.bounds.len() && self.bounds.len() < slices {
                self.bounds.push(region + 1);
            }
        }
        self.bounds.resize(slices + 1, counts.len());
    }
}

/// Returns the minimum key, and the shift after which the difference of any key to it fits two digits.
fn key_range(projected: &Projected) -> (u32, u32) {
    let (least, greatest) = projected
        .counts
        .par_iter()
        .zip(projected.keys.par_chunks(BLOCK))
        .with_min_len(64)
        .map(|(&count, keys)| {
            let keys = &keys[..count as usize];
            keys.iter()
                .fold((u32::MAX, 0), |(least, greatest), &key| (key.min(least), key.max(greatest)))
        })
        .reduce(|| (u32::MAX, 0), |a, b| (a.0.min(b.0), a.1.max(b.1)));
    let bits = u32::BITS - greatest.saturating_sub(least).leading_zeros();
    (least, bits.saturating_sub(2 * DIGIT_BITS))
}

/// Converts counts per slice and digit into the output position of each slice's first entry of each digit.
fn to_places(histograms: &mut [Vec<u32>]) {
    let mut place = 0;
    for bin in 0..BINS {
        for histogram in &mut *histograms {
            let count = histogram[bin];
            histogram[bin] = place;
            place += count;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn sorted_slots(regions: &[Vec<f32>]) -> Vec<u32> {
        let mut projected = Projected {
            keys: vec![0; regions.len() * BLOCK],
            counts: regions.iter().map(|region| region.len() as u32).collect(),
            ..Projected::default()
        };
        for (i, region) in regions.iter().enumerate() {
            for (j, z) in region.iter().enumerate() {
                projected.keys[i * BLOCK + j] = z.to_bits();
            }
        }
        let mut sorter = Sorter::default();
        // Twice, because the state after the first run must not matter.
        sorter.sort(&projected);
        sorter.sort(&projected);
        sorter.order().iter().map(|slot| slot.load(Relaxed)).collect()
    }

    proptest! {
        #[test]
        fn sorting_is_a_permutation_in_depth_order(
            regions in prop::collection::vec(prop::collection::vec(0.2..50.0f32, 0..=BLOCK), 0..60),
        ) {
            let order = sorted_slots(&regions);
            let depth = |slot: u32| regions[slot as usize / BLOCK][slot as usize % BLOCK];
            for pair in order.windows(2) {
                let (a, b) = (depth(pair[0]), depth(pair[1]));
                prop_assert!(a <= b * (1.0 + 4e-6), "{} before {}", a, b);
            }
            let mut slots = order;
            slots.sort_unstable();
            let expected = regions.iter().enumerate().flat_map(|(i, region)| {
                (0..region.len()).map(move |j| (i * BLOCK + j) as u32)
            });
            prop_assert!(slots.into_iter().eq(expected));
        }
    }

    #[test]
    fn equal_depths_keep_their_order() {
        let order = sorted_slots(&vec![vec![3.5; BLOCK]; 100]);
        assert!(order.is_sorted() && order.len() == 100 * BLOCK);
    }
}
