//! Space in cubic cells, and which of them a splat covers.

use glam::{DMat3, DVec3, IVec3};

use crate::Splats;

/// Cells of one side, without an end but that of their numbers.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cells {
    /// Their side. [scene]
    pub(super) side: f64,
}

impl Cells {
    /// Returns the cell that a point lies in; `None` where it has no number.
    pub(super) fn of(self, p: DVec3) -> Option<IVec3> {
        let cell = (p / self.side).floor();
        // Positively stated: NaN fails.
        (cell.abs().max_element() < f64::from(END)).then(|| cell.as_ivec3())
    }

    /// Calls `visit` with the cell of a splat's centre and those within one standard deviation of it; some more than once.
    /// What is too large for that (sky) covers the cell of its centre.
    pub(super) fn covered(self, splats: &Splats, index: usize, mut visit: impl FnMut(IVec3)) {
        let center = splats.means_m[index].as_dvec3();
        let mut show = |p: DVec3| self.of(p).into_iter().for_each(&mut visit);
        show(center);
        let scales = splats.scales_m[index].as_dvec3();
        if !(scales.max_element() > self.side / 2.0) {
            return;
        }
        // A cell apart at most: no cell between two of them is left out.
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

/// Returns a cell's number: those along z follow each other.
pub(super) fn key(cell: IVec3) -> u64 {
    let [x, y, z] = (cell + END).to_array().map(|n| n as u64);
    x << 42 | y << 21 | z
}

/// Whether a splat is no haze.
pub(super) fn is_solid(splats: &Splats, index: usize, least: f32) -> bool {
    splats.opacities[index] >= least && splats.means_m[index].is_finite()
}

/// Cells have numbers below this on each axis: 21 bits each, with room for neighbours.
const END: i32 = (1 << 20) - 2;
/// A splat over more points than these is sky, and connects nothing.
const MOST_COVERED: f64 = 4096.0;
