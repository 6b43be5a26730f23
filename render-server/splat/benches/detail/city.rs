//! Generated quarter of a city with any number of splats: streets, houses with windows, trees.
//!
//! Splats are on the surfaces like after training: flat, jittered, overlapping, many of them faint, with uniform
//! density. The same arguments give the same splats.

use glam::{Mat3, Quat, Vec3};
use vizflyt_splat::Splats;

/// Knuth's MMIX generator; uses its upper 24 bits.
pub(crate) struct Random(u64);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed ^ 0x9e37_79b9_7f4a_7c15)
    }

    pub(crate) fn range(&mut self, low: f32, high: f32) -> f32 {
        let Self(state) = self;
        *state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        low + (*state >> 40) as f32 / (1u64 << 24) as f32 * (high - low)
    }

    fn within(&mut self, half: Vec3) -> Vec3 {
        Vec3::new(
            self.range(-half.x, half.x),
            self.range(-half.y, half.y),
            self.range(-half.z, half.z),
        )
    }
}

/// Surface that is covered with splats.
#[derive(Clone, Copy)]
enum Surface {
    /// Rectangle: centre, half sides.
    Flat { middle: Vec3, u: Vec3, v: Vec3, colour: Vec3, windows: bool },
    /// Ball of leaves, filled with splats.
    Leaves { middle: Vec3, radius_m: f32 },
}

impl Surface {
    fn area_m2(&self) -> f32 {
        match self {
            Self::Flat { u, v, .. } => 4.0 * u.length() * v.length(),
            // Number of splats of three shells of the ball.
            Self::Leaves { radius_m, .. } => 3.0 * 4.0 * std::f32::consts::PI * radius_m * radius_m,
        }
    }
}

/// Returns `count` splats over `blocks` x `blocks` blocks of 40 m around the origin, z up.
pub(crate) fn city(count: usize, blocks: usize, sh_degree: u8) -> Splats {
    let random = &mut Random::new(7);
    let surfaces = surfaces(blocks, random);
    let total_m2: f32 = surfaces.iter().map(Surface::area_m2).sum();
    let spacing_m = (total_m2 / count as f32).sqrt();
    let mut splats = Splats { sh_degree, ..Splats::default() };
    splats.sh.reserve(count * splats.sh_coefficients() * 3);
    // Cumulative share of each surface, so that the sum is exact.
    let (mut area_m2, mut done) = (0.0, 0);
    for surface in &surfaces {
        area_m2 += surface.area_m2();
        let due = ((area_m2 / total_m2) * count as f32).round() as usize;
        for _ in done..due.min(count) {
            add(surface, spacing_m, random, &mut splats);
        }
        done = done.max(due.min(count));
    }
    splats
}

fn surfaces(blocks: usize, random: &mut Random) -> Vec<Surface> {
    const BLOCK_M: f32 = 40.0;
    let mut surfaces = Vec::new();
    let flat = |middle, u, v, colour, windows| Surface::Flat { middle, u, v, colour, windows };
    for i in 0..blocks * blocks {
        let at = |k: usize| (k as f32 - (blocks as f32 - 1.0) / 2.0) * BLOCK_M;
        let middle = Vec3::new(at(i % blocks), at(i / blocks), 0.0);
        let half = BLOCK_M / 2.0;
        let grey = Vec3::splat(random.range(-0.6, -0.2));
        surfaces.push(flat(middle, Vec3::X * half, Vec3::Y * half, grey, false));
        // Every fifth block is a park.
        if i % 5 == 2 {
            for _ in 0..12 {
                let foot = middle + random.within(Vec3::new(17.0, 17.0, 0.0));
                let radius_m = random.range(1.2, 3.0);
                surfaces
                    .push(Surface::Leaves { middle: foot + Vec3::Z * (2.0 + radius_m), radius_m });
                let stem = foot + Vec3::Z * 1.2;
                let brown = Vec3::new(-0.2, -0.5, -0.9);
                for u in [Vec3::X, Vec3::Y] {
                    surfaces.push(flat(stem, u * 0.25, Vec3::Z * 1.2, brown, false));
                }
            }
            continue;
        }
        let (x, y) = (random.range(9.0, 14.0), random.range(9.0, 14.0));
        let z = random.range(4.0, 20.0);
        let colour = random.within(Vec3::splat(0.9));
        let body = middle + Vec3::Z * z;
        for side in [-1.0, 1.0] {
            let (across, along) = (Vec3::X * x, Vec3::Y * y);
            surfaces.push(flat(body + across * side, along, Vec3::Z * z, colour, true));
            surfaces.push(flat(body + along * side, across, Vec3::Z * z, colour, true));
        }
        surfaces.push(flat(body + Vec3::Z * z, Vec3::X * x, Vec3::Y * y, colour * 0.5, false));
    }
    surfaces
}

fn add(surface: &Surface, spacing_m: f32, random: &mut Random, splats: &mut Splats) {
    let (mean_m, normal, mut colour) = match *surface {
        Surface::Flat { middle, u, v, colour, windows } => {
            let (a, b) = (random.range(-1.0, 1.0), random.range(-1.0, 1.0));
            let place = middle + u * a + v * b;
            let (s, t) = (a * u.length(), b * v.length());
            let mut colour = colour;
            if windows && s.rem_euclid(3.0) < 1.3 && t.rem_euclid(3.2) < 1.7 {
                colour = Vec3::new(-1.2, -1.1, -0.8);
            } else if !windows {
                // Slabs, and stains some metres wide.
                let joint = s.rem_euclid(2.0) < 0.15 || t.rem_euclid(2.0) < 0.15;
                let stain = (s * 0.9).sin() * (t * 0.7).cos() * 0.25;
                colour += Vec3::splat(stain - if joint { 0.4 } else { 0.0 });
            }
            (place, u.cross(v).normalize(), colour)
        }
        Surface::Leaves { middle, radius_m } => {
            let offset = loop {
                let offset = random.within(Vec3::ONE);
                if offset.length_squared() <= 1.0 {
                    break offset;
                }
            };
            let normal = random.within(Vec3::ONE).normalize_or(Vec3::Z);
            let green = Vec3::new(-0.7, 0.1, -0.9) * (0.6 + 0.4 * offset.z);
            (middle + offset * radius_m, normal, green)
        }
    };
    let u = normal.any_orthonormal_vector();
    let frame = Mat3::from_cols(u, normal.cross(u), normal);
    let turn = Quat::from_rotation_z(random.range(0.0, std::f32::consts::TAU));
    let tilt = Quat::from_rotation_x(random.range(-0.15, 0.15));
    splats.means_m.push(mean_m + normal * (random.range(-0.1, 0.1) * spacing_m));
    splats.rotations.push((Quat::from_mat3(&frame) * turn * tilt).normalize());
    let size = |random: &mut Random| spacing_m * random.range(-1.1, 0.3).exp();
    splats.scales_m.push(Vec3::new(size(random), size(random), spacing_m * 0.08));
    let faint = random.range(0.0, 1.0) < 0.3;
    splats.opacities.push(if faint { random.range(0.02, 0.4) } else { random.range(0.6, 1.0) });
    colour += random.within(Vec3::splat(0.15));
    splats.sh.extend(colour.to_array());
    for _ in 3..splats.sh_coefficients() * 3 {
        splats.sh.push(random.range(-0.08, 0.08));
    }
}
