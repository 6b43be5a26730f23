//! Path of the camera: space in which the camera has been is free.

use glam::{DVec3, Mat3, Vec3};
use rayon::prelude::*;
use vizflyt_splat::Splats;

use super::{CarveOptions, Seen};
use crate::align::Similarity;
use crate::dataset::Dataset;

/// Balls along the path. [m, world]
#[derive(Clone, Debug)]
pub(super) struct Path {
    places_m: Vec<DVec3>,
    radius_m: f64,
}

impl Path {
    /// Returns the path of a capture: its photos in the order of their names, interpolated between photos that are
    /// close to each other.
    pub(super) fn of(dataset: &Dataset, world: &Similarity, options: &CarveOptions) -> Self {
        let radius_m = options.camera_radius_m;
        let mut places_m: Vec<DVec3> = Vec::new();
        let mut before: Option<DVec3> = None;
        for photo in &dataset.photos {
            let here_m = world.transform_point(photo.view.position.as_dvec3());
            if let Some(before_m) = before.filter(|p| p.distance(here_m) <= options.stride_m) {
                let steps = (before_m.distance(here_m) / (0.5 * radius_m)).ceil() as usize;
                let step = |n: usize| before_m.lerp(here_m, n as f64 / steps as f64);
                places_m.extend((1..steps).map(step));
            }
            places_m.push(here_m);
            before = Some(here_m);
        }
        Self { places_m, radius_m }
    }

    /// Marks the voxels on the path as seen.
    pub(super) fn mark(&self, seen: &mut Seen) {
        let reach_m = DVec3::splat(self.radius_m);
        for &p_m in &self.places_m {
            let [xs, ys, zs] = seen.voxels.within(p_m - reach_m, p_m + reach_m);
            for x in xs {
                for y in ys.clone() {
                    for z in zs.clone() {
                        if seen.voxels.center_m([x, y, z]).distance(p_m) <= self.radius_m {
                            seen.mark([x, y, z]);
                        }
                    }
                }
            }
        }
    }

    /// Returns for each splat whether it reaches onto the path, with [`REACH`] standard deviations.
    pub(super) fn touches(&self, splats: &Splats, world: &Similarity) -> Vec<bool> {
        let unit = world.scale;
        let back = world.rotation.inverse();
        let places: Vec<Vec3> = self
            .places_m
            .iter()
            .map(|p_m| (back * (*p_m - world.translation_m) / unit).as_vec3())
            .collect();
        let radius = (self.radius_m / unit) as f32;
        (0..splats.len())
            .into_par_iter()
            .map(|i| {
                let (mean, half) = (splats.means_m[i], splats.scales_m[i] * REACH + radius);
                let furthest = half.max_element().powi(2);
                let turn = Mat3::from_quat(splats.rotations[i]).transpose();
                places.iter().any(|p| {
                    let d = *p - mean;
                    d.length_squared() < furthest && (turn * d / half).length_squared() < 1.0
                })
            })
            .collect()
    }
}

/// Size of a splat, as in the baking of obstacles. [standard deviations]
const REACH: f32 = 2.0;
