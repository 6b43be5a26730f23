//! Reads part of a packed scene as splats, for obstacles, beams and maps.

use glam::{Mat3, Quat, Vec3};
use half::f16;

use super::super::scene::{BLOCK, Block, GROUP, GROUP_NUMBERS, column};
use super::file::{GEOMETRY, PackedError, PackedScene};
use crate::Splats;

impl PackedScene {
    /// Reads the original splats with centres in a box, in the scene's frame [m]. Their colour is independent of
    /// direction (degree 0).
    ///
    /// # Errors
    /// [`PackedError::Crowded`] if the box contains more than `most` splats; other errors if the file cannot be read
    /// or is damaged.
    pub fn splats_within(
        &mut self,
        min_m: Vec3,
        max_m: Vec3,
        most: usize,
    ) -> Result<Splats, PackedError> {
        let mut splats = Splats { antialiased: self.antialiased, ..Splats::default() };
        let mut geometry = vec![0.0; GEOMETRY];
        let harmonics = self.coefficients * 3 * GROUP;
        let mut sh = vec![0; harmonics * (BLOCK / GROUP)];
        for tree in self.trees.clone() {
            for block in tree.first..tree.first + tree.levels[1] {
                let Block { center_m, half_m, .. } = self.blocks[block];
                // Bounds that are not finite count as inside.
                let is_outside =
                    (center_m + half_m).cmplt(min_m) | (center_m - half_m).cmpgt(max_m);
                if is_outside.any() {
                    continue;
                }
                self.read(block, &mut geometry, &mut sh)?;
                let groups = geometry.chunks_exact(GROUP_NUMBERS).zip(sh.chunks_exact(harmonics));
                for (geometry, sh) in groups {
                    for lane in 0..GROUP {
                        let at_m = three(geometry, column::MEAN, lane);
                        if (at_m.cmpge(min_m) & at_m.cmple(max_m)).all() {
                            push(&mut splats, at_m, geometry, sh, lane);
                        }
                    }
                }
                if splats.len() > most {
                    return Err(PackedError::Crowded { most, min_m, max_m });
                }
            }
        }
        Ok(splats)
    }
}

/// Returns three columns of a splat in a group, starting at `first`.
fn three(geometry: &[f32], first: usize, lane: usize) -> Vec3 {
    Vec3::from_array([0, 1, 2].map(|k| geometry[(first + k) * GROUP + lane]))
}

/// Appends the splat of a group's lane; skips it if its values are invalid.
fn push(splats: &mut Splats, at_m: Vec3, geometry: &[f32], sh: &[u16], lane: usize) {
    let axes = [0, 3, 6].map(|k| three(geometry, column::AXES + k, lane));
    let scale_m = Vec3::from_array(axes.map(Vec3::length));
    let opacity = geometry[column::LEVEL * GROUP + lane].exp2();
    let colour = [0, 1, 2].map(|k| f16::from_bits(sh[k * GROUP + lane]).to_f32());
    let numbers = [at_m, scale_m, colour.into()];
    if !(numbers.iter().all(|numbers| numbers.is_finite()) && opacity.is_finite()) {
        return;
    }
    splats.means_m.push(at_m);
    splats.scales_m.push(scale_m);
    splats.rotations.push(rotation(axes));
    splats.opacities.push(opacity);
    splats.sh.extend(colour);
}

/// Returns the rotation of a splat from its axes times scales. Axes with zero scale are completed from the others.
fn rotation(axes: [Vec3; 3]) -> Quat {
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| axes[b].length().total_cmp(&axes[a].length()));
    let [i, j, k] = order;
    let first = axes[i].try_normalize().unwrap_or(Vec3::AXES[i]);
    let second = (axes[j] - first * first.dot(axes[j]))
        .try_normalize()
        .filter(|second| second.dot(first).abs() < 1e-3)
        .unwrap_or_else(|| first.any_orthonormal_vector());
    let mut columns = [first; 3];
    columns[j] = second;
    // Right-handed: (0, 1, 2) and its cyclic permutations.
    columns[k] = if (i + 1) % 3 == j { first.cross(second) } else { second.cross(first) };
    let [x, y, z] = columns;
    Quat::from_mat3(&Mat3::from_cols(x, y, z)).normalize()
}
