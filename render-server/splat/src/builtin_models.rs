//! Splats of generated models: boxes with plain colours, and a quadrotor made of them.
//!
//! Other vehicles in the room are rendered as this quadrotor, and a generated scene can contain one. Created once;
//! some thousand splats.

use glam::{Mat3, Quat, Vec3};

use crate::Splats;

/// Box of a model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Part {
    /// Centre. [m, object]
    pub center_m: Vec3,
    /// Half side lengths. [m, object]
    pub half_m: Vec3,
    /// Displayed colour, 0 to 1.
    pub colour: [f32; 3],
}

/// Quadrotor of 0.22 m across, which fits a body of 0.12 m radius: x forward, y left, z up, with an orange nose.
pub const QUADROTOR: [Part; 8] = [
    part([0.0, 0.0, 0.0], [0.045, 0.03, 0.022], GREY),
    part([0.05, 0.0, 0.0], [0.008, 0.022, 0.016], ORANGE),
    part([0.055, 0.055, 0.012], [0.022, 0.022, 0.008], DARK),
    part([0.055, -0.055, 0.012], [0.022, 0.022, 0.008], DARK),
    part([-0.055, 0.055, 0.012], [0.022, 0.022, 0.008], DARK),
    part([-0.055, -0.055, 0.012], [0.022, 0.022, 0.008], DARK),
    part([0.055, 0.0, 0.0], [0.007, 0.06, 0.007], DARK),
    part([-0.055, 0.0, 0.0], [0.007, 0.06, 0.007], DARK),
];

const GREY: [f32; 3] = [0.72, 0.74, 0.78];
const ORANGE: [f32; 3] = [0.95, 0.48, 0.10];
const DARK: [f32; 3] = [0.16, 0.17, 0.20];

const fn part(center_m: [f32; 3], half_m: [f32; 3], colour: [f32; 3]) -> Part {
    Part { center_m: Vec3::from_array(center_m), half_m: Vec3::from_array(half_m), colour }
}

/// Returns the splats of boxes in the boxes' frame: flat splats on every face, brighter at the top than at the
/// bottom, so that edges are visible without lighting. [m, object]
pub fn boxes(parts: &[Part]) -> Splats {
    boxes_in_patches(parts, PATCH_M)
}

/// Same as [`boxes`], with patches of at most this side length. Large plain boxes need few patches. [m]
pub fn boxes_in_patches(parts: &[Part], patch_m: f32) -> Splats {
    let mut splats = Splats::default();
    for part in parts {
        for axis in 0..3 {
            for side in [-1.0, 1.0] {
                face(&mut splats, part, patch_m, axis, side);
            }
        }
    }
    splats
}

fn face(splats: &mut Splats, part: &Part, patch_m: f32, axis: usize, side: f32) {
    let out = Vec3::AXES[axis] * side;
    let right = Vec3::AXES[(axis + 1) % 3];
    let up = out.cross(right);
    let half = |direction: Vec3| direction.abs().dot(part.half_m);
    let (wide_m, high_m) = (2.0 * half(right), 2.0 * half(up));
    let columns = (wide_m / patch_m).ceil().max(1.0);
    let rows = (high_m / patch_m).ceil().max(1.0);
    let shade = 0.82 + 0.18 * out.z;
    let rotation = Quat::from_mat3(&Mat3::from_cols(right, up, out)).normalize();
    for row in 0..rows as u16 {
        for column in 0..columns as u16 {
            let across = (f32::from(column) + 0.5) / columns - 0.5;
            let along = (f32::from(row) + 0.5) / rows - 0.5;
            let at_m =
                out * (half(out) - SINK_M) + right * (across * wide_m) + up * (along * high_m);
            splats.means_m.push(part.center_m + at_m);
            let (sigma_x_m, sigma_y_m) = (wide_m / columns, high_m / rows);
            let sigma = Vec3::new(sigma_x_m * OVERLAP, sigma_y_m * OVERLAP, 0.0008);
            splats.scales_m.push(sigma);
            splats.rotations.push(rotation);
            splats.opacities.push(0.98);
            splats.sh.extend(part.colour.map(|colour| (colour * shade - 0.5) / SH_CONSTANT));
        }
    }
}

/// Maximum side of a patch: smaller than a pixel of an image 320 px wide at half a metre. [m]
const PATCH_M: f32 = 0.012;
/// Standard deviation as a share of the patch's side: neighbours overlap enough to be opaque.
const OVERLAP: f32 = 0.55;
/// Depth of the patches below the surface: their thickness. [m]
const SINK_M: f32 = 0.001;
/// The constant harmonic, 1 / (2 sqrt(pi)).
const SH_CONSTANT: f32 = 0.282_094_8;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quadrotor_fits_its_body_and_is_well_formed() {
        let splats = boxes(&QUADROTOR);
        let Splats { means_m, scales_m, rotations, opacities, sh_degree, sh, antialiased: _ } =
            &splats;
        assert!((500..5000).contains(&splats.len()), "{}", splats.len());
        assert_eq!((*sh_degree, sh.len()), (0, 3 * splats.len()));
        assert_eq!((scales_m.len(), opacities.len()), (splats.len(), splats.len()));
        assert!(means_m.iter().all(|p| p.length() < 0.12));
        assert!(rotations.iter().all(|q| (q.length() - 1.0).abs() < 1e-5));
    }
}
