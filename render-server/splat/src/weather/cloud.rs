//! Smoke, dust and patchy fog: air of spatially varying density that drifts.
//!
//! Light is attenuated along a ray by the Beer-Lambert law: `exp(-k * integral of density)`
//! remains, and is replaced by the colour of the cloud. Density is value noise of three octaves
//! that drift apart, with a mean of 1, so that `k` is the extinction of a uniform mist of the same
//! mass. The integral is computed on a coarse grid of rays in front of the camera, at depths that
//! are denser near it, with linear interpolation (Wronski, Volumetric Fog, SIGGRAPH 2014). It is
//! exact for uniform density.

use glam::{DVec3, Mat3, Vec3};
use rayon::prelude::*;

use super::random::{Random, mix, unit};
use super::rays::Rays;
use crate::Camera;

/// Cloud in the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cloud {
    /// Mean extinction: `exp(-k d)` of the light remains after a distance d. [1/m]
    pub per_m: f32,
    /// Colour where the cloud is opaque, as display values.
    pub color: [f32; 3],
    /// Variation of the density: 0 is uniform, 1 leaves gaps of clear air.
    pub patchiness: f32,
    /// Size of the largest patches. [m]
    pub patch_m: f32,
    /// Velocity of the drift. [m/s, world]
    pub drift_mps: Vec3,
    /// Lowest and highest height, with soft borders; unlimited if `None`. [m, world]
    pub layer_m: Option<[f32; 2]>,
    /// Ball that contains the cloud, with a soft border; unlimited if `None`.
    pub ball: Option<Ball>,
}

/// Ball that limits a cloud.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ball {
    /// Centre of the ball. [m, world]
    pub center_m: DVec3,
    /// Radius of the ball. [m]
    pub radius_m: f32,
}

impl Cloud {
    /// Returns whether the cloud is limited, with clear air behind it.
    pub(super) fn is_bounded(&self) -> bool {
        self.layer_m.is_some() || self.ball.is_some()
    }
}

/// Number of depths at which the integral is stored.
pub(super) const EDGES: usize = SLICES + 1;
const SLICES: usize = 24;
/// Depth beyond which the density is that of the last slice. [m, cam]
const FAR_M: f32 = 30.0;
/// Side of the noise lattice, which is periodic.
const SIDE: usize = 32;
/// Octaves: frequency, weight, and drift in addition to that of the cloud, in patches per second.
/// Without the additional drift, the cloud would move without changing its shape.
const OCTAVES: [(f32, f32, [f32; 3]); 3] = [
    (1.0, 0.55, [0.0, 0.0, 0.0]),
    (2.03, 0.30, [0.05, -0.03, 0.06]),
    (4.01, 0.15, [-0.07, 0.06, 0.11]),
];
/// Deviation of the noise from its mean of one half at which the density is zero, or twice the
/// mean.
const CONTRAST: f32 = 0.14;
/// Half width of a layer's soft border, as a share of its thickness.
const SOFT: f32 = 0.25;

/// Integrals of a cloud for one camera at one instant.
#[derive(Debug, Default)]
pub(super) struct CloudPass {
    seed: Option<u64>,
    lattice: Vec<f32>,
    /// Integral of the density over z, for each corner of the ray grid at each of [`EDGES`].
    integral: Vec<f32>,
}

impl CloudPass {
    /// Integrates the density along the rays of a camera.
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

    /// Writes the integrals for a row of pixels at the columns of the ray grid, [`EDGES`] for each
    /// column.
    pub(super) fn write_row(&self, rays: &Rays, y: usize, table: &mut [f32]) {
        let (row, down) = rays.row_at(y);
        let length = rays.columns * EDGES;
        let (above, below) = self.integral[row * length..][..2 * length].split_at(length);
        for ((out, above), below) in table.iter_mut().zip(above).zip(below) {
            *out = above + (below - above) * down;
        }
    }
}

/// Returns the integral over z up to a depth, and the total integral, interpolated between two
/// columns of a row's table.
#[inline]
pub(super) fn integral_at(pair: &[f32], across: f32, z_m: f32) -> (f32, f32) {
    let slice = ((z_m * (1.0 / FAR_M)).sqrt() * SLICES as f32) as usize;
    let slice = slice.min(SLICES - 1);
    let along = (z_m - edge_m(slice)) * PER_M[slice];
    let column = |edge: usize| pair[edge] + (pair[EDGES + edge] - pair[edge]) * across;
    let (near, far) = (column(slice), column(slice + 1));
    (near + (far - near) * along, column(SLICES))
}

/// Inverse thickness of each slice. [1/m]
const PER_M: [f32; SLICES] = {
    let mut per_m = [0.0; SLICES];
    let mut slice = 0;
    while slice < SLICES {
        per_m[slice] = 1.0 / (edge_m(slice + 1) - edge_m(slice));
        slice += 1;
    }
    per_m
};

/// Returns the depth of an edge. Edges are denser near the camera, where patches are large in the
/// image.
#[inline]
const fn edge_m(edge: usize) -> f32 {
    let share = edge as f32 * (1.0 / SLICES as f32);
    FAR_M * share * share
}

/// Density around a camera.
struct Field<'a> {
    lattice: &'a [f32],
    patchiness: f32,
    /// For each octave: position of the camera on the lattice, cells per metre, and weight.
    octaves: [(Vec3, f32, f32); 3],
    camera_z_m: f32,
    layer_m: Option<[f32; 2]>,
    /// Centre relative to the camera, and radius. [m, world]
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

    /// Returns the density at an offset from the camera [m, world]. The mean within the cloud is 1.
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

    /// Returns the interpolated value of the lattice.
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

/// Smoothstep: 0 up to 0, 1 from 1 on, smooth in between.
pub(super) fn smooth(t: f32) -> f32 {
    let t = t.clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Separates the random numbers of the cloud from those of other effects.
const SALT: u64 = 0xc10d;
