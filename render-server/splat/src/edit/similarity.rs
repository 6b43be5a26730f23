//! Rotates, scales and moves splats, including their directional colours.

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use crate::Splats;
use crate::harmonics::Turn;

/// Transforms every splat: `p_new = scale * (rotation * p_old) + translation`. Sizes are
/// multiplied; rotations and harmonics are rotated. Unchanged values keep their bits.
pub fn transform(splats: &mut Splats, scale: f64, rotation: DQuat, translation: DVec3) {
    splats.means_m.par_iter_mut().for_each(|mean| {
        let p = rotation * mean.as_dvec3() * scale + translation;
        *mean = p.as_vec3();
    });
    splats.scales_m.par_iter_mut().for_each(|scales| *scales *= scale as f32);
    if rotation == DQuat::IDENTITY {
        return;
    }
    let turn_f32 = rotation.as_quat();
    splats.rotations.par_iter_mut().for_each(|axes| *axes = (turn_f32 * *axes).normalize());
    let turn = Turn::new(rotation, splats.sh_degree);
    let width = splats.sh_coefficients() * 3;
    splats.sh.par_chunks_exact_mut(width).for_each(|sh| turn.apply(sh));
}
