//! Cubic cells of space, and the cells that a splat covers.

use glam::{DMat3, DVec3, IVec3};

use crate::Splats;

/// Unbounded grid of cubic cells; only the range of their numbers limits it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cells {
    /// Side of a cell. [scene]
    pub(super) side: f64,
}

impl Cells {
    /// Returns the cell of a point, or `None` if it is outside the range of numbers.
    pub(super) fn of(self, p: DVec3) -> Option<IVec3> {
        let cell = (p / self.side).floor();
        // The comparison is false for NaN, so NaN is rejected.
        (cell.abs().max_element() < f64::from(END)).then(|| cell.as_ivec3())
    }

    /// Calls `visit` with the cell of a splat's centre and the cells within one standard deviation
    /// of it, some of them more than once. Splats that are too large for that (sky) cover only the
    /// cell of their centre.
    pub(super) fn covered(self, splats: &Splats, index: usize, mut visit: impl FnMut(IVec3)) {
        let center = splats.means_m[index].as_dvec3();
        let mut show = |p: DVec3| self.of(p).into_iter().for_each(&mut visit);
        show(center);
        let scales = splats.scales_m[index].as_dvec3();
        if !(scales.max_element() > self.side / 2.0) {
            return;
        }
        // Sample points are at most one cell apart, so no cell between them is missed.
        let across =
            |scale: f64| if scale > self.side / 2.0 { (scale / self.side).ceil() } else { 0.0 };
        let steps = DVec3::from(scales.to_array().map(across));
        if !((steps * 2.0 + 1.0).element_product() <= MOST_COVERED) {
            return;
        }
        let axes = DMat3::from_quat(splats.rotations[index].as_dquat());
        let [nx, ny, nz] = steps.to_array().map(|n| n as i32);
        let inverse = steps.max(DVec3::ONE).recip();
        for x in -nx..=nx {
            for y in -ny..=ny {
                for z in -nz..=nz {
                    let at = IVec3::new(x, y, z).as_dvec3() * inverse;
                    if at.length_squared() <= 1.0 {
                        show(center + axes * (at * scales));
                    }
                }
            }
        }
    }
}

/// Returns the number of a cell. Cells along z have consecutive numbers.
pub(super) fn key(cell: IVec3) -> u64 {
    let [x, y, z] = (cell + END).to_array().map(|n| n as u64);
    x << 42 | y << 21 | z
}

/// Returns whether a splat is solid: not haze, and at a finite position.
pub(super) fn is_solid(splats: &Splats, index: usize, least: f32) -> bool {
    splats.opacities[index] >= least && splats.means_m[index].is_finite()
}

/// Limit of cell numbers on each axis: 21 bits each, with room for neighbours.
const END: i32 = (1 << 20) - 2;
/// Maximum sample points of a splat. A larger splat is sky, and connects nothing.
const MOST_COVERED: f64 = 4096.0;
