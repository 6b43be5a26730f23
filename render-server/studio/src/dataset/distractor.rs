//! Distractors: boxes, cylinders and spheres of plain splats without any meaning.

use std::f32::consts::TAU;

use glam::{Mat3, Quat, Vec3};
use vizflyt_splat::Splats;
use vizflyt_splat::builtin_models::{Part, boxes};
use vizflyt_twin::random::Random;

use super::texture::{self, SH_CONSTANT};

/// Returns a solid around the origin with a maximum half side of `reach_m`. [m, object]
pub(super) fn solid(reach_m: f32, random: &mut Random) -> Splats {
    let colour = texture::colour(random);
    match random.below(3) {
        0 => {
            let half_m = Vec3::from_array([(); 3].map(|()| reach_m * random.within(0.35, 1.0)));
            boxes(&[Part { center_m: Vec3::ZERO, half_m, colour: colour.to_array() }])
        }
        1 => {
            let radius_m = reach_m * random.within(0.2, 0.6);
            let points = cylinder(radius_m, reach_m);
            patches(points, colour)
        }
        _ => patches(sphere(reach_m), colour),
    }
}

/// Point on a surface, outward normal, and area of its patch.
type Point = (Vec3, Vec3, f32);

fn sphere(radius_m: f32) -> Vec<Point> {
    // Fibonacci lattice: even within a few percent.
    let area = 4.0 * std::f32::consts::PI * radius_m * radius_m;
    let count = ((area / PATCH_M2).ceil() as usize).clamp(60, 4000);
    let golden = TAU * 0.381_966;
    let point = |n: usize| {
        let z = 1.0 - (2.0 * n as f32 + 1.0) / count as f32;
        let (sin, cos) = (golden * n as f32).sin_cos();
        let out = Vec3::new(cos, sin, 0.0) * (1.0 - z * z).sqrt() + Vec3::Z * z;
        (out * radius_m, out, area / count as f32)
    };
    (0..count).map(point).collect()
}

fn cylinder(radius_m: f32, half_m: f32) -> Vec<Point> {
    let side_m = PATCH_M2.sqrt();
    let around = ((TAU * radius_m / side_m).ceil()).max(12.0);
    let up = (2.0 * half_m / side_m).ceil().max(2.0);
    let mut points = Vec::new();
    let of_side = TAU * radius_m * 2.0 * half_m / (around * up);
    for row in 0..up as usize {
        for column in 0..around as usize {
            let (sin, cos) = (TAU * (column as f32 + 0.5) / around).sin_cos();
            let out = Vec3::new(cos, sin, 0.0);
            let z_m = half_m * ((2.0 * row as f32 + 1.0) / up - 1.0);
            points.push((out * radius_m + Vec3::Z * z_m, out, of_side));
        }
    }
    // The lids: rings of patches.
    let rings = (radius_m / side_m).ceil().max(2.0);
    for side in [-1.0, 1.0] {
        for ring in 0..rings as usize {
            let r_m = radius_m * (ring as f32 + 0.5) / rings;
            let count = (TAU * r_m / side_m).ceil().max(4.0);
            let area = TAU * r_m * (radius_m / rings) / count;
            for n in 0..count as usize {
                let (sin, cos) = (TAU * n as f32 / count).sin_cos();
                let at_m = Vec3::new(cos * r_m, sin * r_m, side * half_m);
                points.push((at_m, Vec3::Z * side, area));
            }
        }
    }
    points
}

fn patches(points: Vec<Point>, colour: Vec3) -> Splats {
    let mut splats = Splats::default();
    for (p_m, out, area) in points {
        let along = out.any_orthonormal_vector();
        let axes = Mat3::from_cols(along, out.cross(along), out);
        let sigma_m = OVERLAP * area.sqrt();
        splats.means_m.push(p_m - out * 0.001);
        splats.scales_m.push(Vec3::new(sigma_m, sigma_m, 0.0008));
        splats.rotations.push(Quat::from_mat3(&axes).normalize());
        splats.opacities.push(0.98);
        let shade = 0.75 + 0.25 * out.z;
        splats.sh.extend(((colour * shade - 0.5) / SH_CONSTANT).to_array());
    }
    splats
}

/// Area of a patch. [m^2]
const PATCH_M2: f32 = 0.02 * 0.02;
/// Standard deviation relative to the side of a patch, so that neighbours overlap to an opaque surface.
const OVERLAP: f32 = 0.6;

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};
    use vizflyt_protocol::geometry::{Intrinsics, Pose};
    use vizflyt_splat::{Camera, CpuRenderer, Rasterizer, RgbdImage};

    use super::*;

    #[test]
    fn solids_keep_their_size_and_are_opaque() {
        for n in 0..30 {
            let splats = solid(0.2, &mut Random::stream(7, n));
            let reach_m = splats.means_m.iter().map(|p| p.length()).fold(0.0, f32::max);
            assert!((0.1..=0.2 * 3f32.sqrt()).contains(&reach_m), "{n}: {reach_m}");
            let back = Pose::new(DVec3::new(0.0, 0.0, -1.0), DQuat::IDENTITY);
            let camera = Camera::new(Intrinsics::from_horizontal_fov(96, 96, 0.7), back, 0.01);
            let mut images = [RgbdImage::default()];
            CpuRenderer::new(&splats).render(&[], &[camera], &mut images).unwrap();
            let middle = images[0].alpha[48 * 96 + 48];
            assert!(middle > 0.9, "{n}: {middle}");
            let depth_m = images[0].depth_median_m[48 * 96 + 48];
            assert!((0.78..1.0).contains(&depth_m), "{n}: {depth_m}");
        }
    }
}
