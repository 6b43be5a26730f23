//! Splats in, fewer or moved splats out: what a captured scene needs before it is flown.
//!
//! A [`EditStep`] is one edit with all that it depends on, in the axes and units that the scene has when its turn comes. Steps
//! are data: whoever keeps them beside the original can repeat the edit, or leave the last one out.
//!
//! ```text
//! Step::check --> numbers that can be meant
//! Step::apply --> region, cells, carve, decimate: which splats stay --> Splats::keep
//!             \-> similarity: where they come to lie
//! ```
//! What stays keeps its order and its bits. Selections are made of f64 sums, products, quotients and roots alone, so that
//! the same splats go on every processor. Budget: 1 M splats of degree 3 in a second on two cores, for any step; bound by
//! memory (`benches/edit.rs`).

mod carve;
mod cells;
mod decimate;
mod parts;
mod region;
mod similarity;
mod step;
mod words;

pub use carve::Carve;
pub use region::{Axis, Region, select};
pub use similarity::transform;
pub use step::{EditError, EditStep, InvalidStep};

use crate::Splats;

impl Splats {
    /// Keeps the splats that are marked, in order.
    ///
    /// # Panics
    /// If there are not as many marks as splats.
    pub fn keep(&mut self, keep: &[bool]) {
        assert_eq!(keep.len(), self.len(), "one mark for each splat");
        let numbers = self.sh_coefficients() * 3;
        let Self { means_m, scales_m, rotations, opacities, sh, .. } = self;
        rayon::scope(|scope| {
            scope.spawn(|_| retain(sh, keep, numbers));
            retain(means_m, keep, 1);
            retain(scales_m, keep, 1);
            retain(rotations, keep, 1);
            retain(opacities, keep, 1);
        });
    }
}

/// Keeps the blocks of `width` values that are marked, in order.
fn retain<T: Copy>(values: &mut Vec<T>, keep: &[bool], width: usize) {
    let mut end = 0;
    for (block, _) in keep.iter().enumerate().filter(|(_, keep)| **keep) {
        if block * width != end {
            values.copy_within(block * width..(block + 1) * width, end);
        }
        end += width;
    }
    values.truncate(end);
}

#[cfg(test)]
mod tests;
