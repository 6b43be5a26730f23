//! Smoke, dust and patchy fog: air of a density that differs from place to place and drifts.
//!
//! Light is lost along a ray as Beer and Lambert have it: `exp(-k * integral of density)` is left, and what is
//! lost comes from the cloud's own colour. Density is value noise of three octaves that drift apart, with a mean
//! of 1, so that `k` is what a mist of the same mass everywhere would have. The integral is taken on a coarse
//! grid of rays ahead of the camera, at depths that are denser near it, and is linear between (Wronski, Volumetric
//! Fog, SIGGRAPH 2014): exact where the density is the same everywhere.

use glam::{DVec3, Mat3, Vec3};
use rayon::prelude::*;

use super::random::{Random, mix, unit};
use super::rays::Rays;
use crate::Camera;

/// A cloud in the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cloud {
    /// How much light is lost on the way, on average: `exp(-k d)` is left. [1/m]
    pub per_m: f32,
    /// What it looks like where it hides everything, as display values.
    pub color: [f32; 3],
    /// 0 is the same density everywhere, 1 leaves gaps of clear air.
    pub patchiness: f32,
    /// Size of the largest patches. [m]
    pub patch_m: f32,
    /// How it moves. [m/s, world]
    pub drift_mps: Vec3,
    /// From which height up to which it lies, with soft borders; everywhere without. [m, world]
    pub layer_m: Option<[f32; 2]>,
    /// It ends there, softly; nowhere without.
    pub ball: Option<Ball>,
}

/// A ball that a cloud does not leave.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ball {
    /// Its centre. [m, world]
    pub center_m: DVec3,
    /// Its radius. [m]
    pub radius_m: f32,
}

impl Cloud {
    /// Whether there is clear air behind it.
    pub(super) fn is_bounded(&self) -> bool {
        self.layer_m.is_some() || self.ball.is_some()
    }
}

/// Depths at which the integral is known.
pub(super) const EDGES: usize = SLICES + 1;
const SLICES: usize = 24;
/// Beyond, the air is that of the last slice. [m, cam]
const FAR_M: f32 = 30.0;
/// Side of the noise's lattice, which repeats.
const SIDE: usize = 32;
/// The octaves: frequency, weight, and how they drift besides the cloud's own drift, in patches a second: a cloud that
/// only moved along would not change.
const OCTAVES: [(f32, f32, [f32; 3]); 3] = [
    (1.0, 0.55, [0.0, 0.0, 0.0]),
    (2.03, 0.30, [0.05, -0.03, 0.06]),
    (4.01, 0.15, [-0.07, 0.06, 0.11]),
];
/// Noise that is this far from its mean of one half is a gap, or twice the mean density.
const CONTRAST: f32 = 0.14;
/// A layer's borders are this much of its thickness to either side.
const SOFT: f32 = 0.25;

/// A cloud as one camera sees it, at one instant.
#[derive(Debug, Default)]
pub(super) struct CloudPass {
    seed: Option<u64>,
    lattice: Vec<f32>,
    /// Integral of the density over z, for each corner of the rays' cells at each of [`EDGES`].
    integral: Vec<f32>,
}

impl CloudPass {
    /// Integrates along the rays of a camera.
    pub(super) fn follow(
        &mut self,
        cloud: &Cloud,
        seed: u64,
        at_s: f64,
        camera: &Camera,
        rays: &Rays,
    ) {
        if self.seed != Some(seed) {
            self.seed = Some(seed);
            self.lattice.clear();
            let count = (SIDE * SIDE * SIDE) as u64;
            self.lattice.extend((0..count).map(|n| unit(mix(mix(seed ^ SALT).wrapping_add(n)))));
        }
        self.integral.resize(rays.columns * rays.rows * EDGES, 0.0);
        let field =
            Field::new(cloud, seed, at_s, camera.world_from_cam.translation_m, &self.lattice);
        let turn = Mat3::from_quat(camera.world_from_cam.rotation.as_quat());
        let rows = self
            .integral
            .par_chunks_mut(rays.columns * EDGES)
            .zip(rays.slopes.par_chunks(rays.columns));
        rows.for_each(|(integrals, slopes)| {
            for (integral, slope) in integrals.chunks_exact_mut(EDGES).zip(slopes) {
                let per_z = turn * slope.extend(1.0);
                let mut sum = 0.0;
                integral[0] = 0.0;
                for slice in 0..SLICES {
                    let (near_m, far_m) = (edge_m(slice), edge_m(slice + 1));
                    sum += field.at(per_z * (0.5 * (near_m + far_m))) * (far_m - near_m);
                    integral[slice + 1] = sum;
                }
            }
        });
    }

    /// Writes the integrals of a row of pixels at the columns of the rays' corners, [`EDGES`] each.
    pub(super) fn write_row(&self, rays: &Rays, y: usize, table: &mut [f32]) {
        let (row, down) = rays.row_at(y);
        let length = rays.columns * EDGES;
        let (above, below) = self.integral[row * length..][..2 * length].split_at(length);
        for ((out, above), below) in table.iter_mut().zip(above).zip(below) {
            *out = above + (below - above) * down;
        }
    }
}

/// Returns the integral over z down to a depth, and all of it, between two columns of a row's table.
#[inline]
pub(super) fn integral_at(pair: &[f32], across: f32, z_m: f32) -> (f32, f32) {
    let slice = ((z_m * (1.0 / FAR_M)).sqrt() * SLICES as f32) as usize;
    let slice = slice.min(SLICES - 1);
    let along = (z_m - edge_m(slice)) * PER_M[slice];
    let column = |edge: usize| pair[edge] + (pair[EDGES + edge] - pair[edge]) * across;
    let (near, far) = (column(slice), column(slice + 1));
    (near + (far - near) * along, column(SLICES))
}

/// One over each slice's thickness. [1/m]
const PER_M: [f32; SLICES] = {
    let mut per_m = [0.0; SLICES];
    let mut slice = 0;
    while slice < SLICES {
        per_m[slice] = 1.0 / (edge_m(slice + 1) - edge_m(slice));
        slice += 1;
    }
    per_m
};

/// Denser near the camera, where patches are large in the image.
#[inline]
const fn edge_m(edge: usize) -> f32 {
    let share = edge as f32 * (1.0 / SLICES as f32);
    FAR_M * share * share
}

/// The density around a camera.
struct Field<'a> {
    lattice: &'a [f32],
    patchiness: f32,
    /// Of each octave: where the camera is on the lattice, and cells a metre.
    octaves: [(Vec3, f32, f32); 3],
    camera_z_m: f32,
    layer_m: Option<[f32; 2]>,
    /// From the camera. [m, world]
    ball: Option<(Vec3, f32)>,
}

impl<'a> Field<'a> {
    fn new(cloud: &Cloud, seed: u64, at_s: f64, camera_m: DVec3, lattice: &'a [f32]) -> Self {
        let octaves = OCTAVES.map(|(frequency, weight, own)| {
            let per_m = f64::from(frequency) / f64::from(cloud.patch_m);
            let drift_mps =
                cloud.drift_mps.as_dvec3() + Vec3::from(own).as_dvec3() * f64::from(cloud.patch_m);
            let mut random = Random::of(seed ^ SALT, [frequency.to_bits().into(), 0, 0, 0]);
            let start = Vec3::from([(); 3].map(|()| random.unit() * SIDE as f32)).as_dvec3();
            let at = (camera_m - drift_mps * at_s) * per_m + start;
            (at.rem_euclid(DVec3::splat(SIDE as f64)).as_vec3(), per_m as f32, weight)
        });
        Self {
            lattice,
            patchiness: cloud.patchiness,
            octaves,
            camera_z_m: camera_m.z as f32,
            layer_m: cloud.layer_m,
            ball: cloud.ball.map(|ball| ((ball.center_m - camera_m).as_vec3(), ball.radius_m)),
        }
    }

    /// Returns the density at an offset from the camera [m, world]; 1 on average within the cloud.
    fn at(&self, offset_m: Vec3) -> f32 {
        let mut density = 1.0;
        if let Some([bottom_m, top_m]) = self.layer_m {
            let z_m = self.camera_z_m + offset_m.z;
            let soft_m = SOFT * (top_m - bottom_m);
            density *= smooth((z_m - bottom_m + soft_m) / (2.0 * soft_m));
            density *= smooth((top_m - z_m + soft_m) / (2.0 * soft_m));
        }
        if let Some((center_m, radius_m)) = self.ball {
            let distance_m = (offset_m - center_m).length();
            density *= smooth((radius_m - distance_m) / (0.5 * radius_m));
        }
        if self.patchiness > 0.0 && density > 0.0 {
            let noise: f32 = self
                .octaves
                .iter()
                .map(|&(at, per_m, weight)| weight * self.noise(at + offset_m * per_m))
                .sum();
            let patch = smooth((noise - 0.5 + CONTRAST) / (2.0 * CONTRAST)) * 2.0;
            density *= 1.0 + self.patchiness * (patch - 1.0);
        }
        density
    }

    /// Returns the lattice's value between its points.
    fn noise(&self, at: Vec3) -> f32 {
        let whole = |x: f32| {
            let cut = x as i32;
            if (cut as f32) > x { cut - 1 } else { cut }
        };
        let [x, y, z] = at.to_array().map(whole);
        let step = |x: f32, whole: i32| {
            let t = x - whole as f32;
            t * t * (3.0 - 2.0 * t)
        };
        let (tx, ty, tz) = (step(at.x, x), step(at.y, y), step(at.z, z));
        let wrap = |i: i32| i as usize & (SIDE - 1);
        let (x0, x1) = (wrap(x), wrap(x.wrapping_add(1)));
        let line = |y: i32, z: i32| {
            let row = (wrap(z) * SIDE + wrap(y)) * SIDE;
            let (a, b) = (self.lattice[row + x0], self.lattice[row + x1]);
            a + (b - a) * tx
        };
        let sheet = |z: i32| {
            let (a, b) = (line(y, z), line(y.wrapping_add(1), z));
            a + (b - a) * ty
        };
        let (a, b) = (sheet(z), sheet(z.wrapping_add(1)));
        a + (b - a) * tz
    }
}

/// 0 up to 0, 1 from 1 on, smooth between.
pub(super) fn smooth(t: f32) -> f32 {
    let t = t.clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Keeps the cloud's numbers apart from those of other effects.
const SALT: u64 = 0xc10d;
