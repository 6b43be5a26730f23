//! Edits that prepare a captured scene for flights: removing and moving splats.
//!
//! An [`EditStep`] is one edit with all its parameters, in the axes and units that the scene has
//! when the step is applied. Steps are data: a list of steps next to the original file allows
//! repeating the edits, or omitting the last one.
//!
//! ```text
//! EditStep::check --> are all numbers valid?
//! EditStep::apply --> region, cells, carve, decimate: select the splats to keep --> Splats::keep
//!                 \-> similarity: transform the splats
//! ```
//! Kept splats keep their order and their bits. Selections use only sums, products, quotients and
//! roots in f64, so that every processor selects the same splats. Budget: 1 M splats of degree 3
//! per second on two cores, for any step, limited by memory bandwidth (`benches/edit.rs`).

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
    /// Keeps the marked splats, in order.
    ///
    /// # Panics
    /// If the number of marks differs from the number of splats.
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

/// Keeps the marked blocks of `width` values, in order.
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
