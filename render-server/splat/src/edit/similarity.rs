//! Turns, scales and moves splats, with their colours by direction.

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use crate::Splats;
use crate::harmonics::Turn;

/// Moves every splat: `p_new = scale * (rotation * p_old) + translation`; sizes are multiplied, rotations and harmonics
/// turned. What is not changed keeps its bits.
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
