//! How far each photo looks: the trained scene's depth at its pose, held against the points that structure
//! from motion saw in it.

use rayon::prelude::*;
use vizflyt_protocol::geometry::Pose;
use vizflyt_splat::{Camera, CpuRenderer, Rasterizer, RgbdImage, Splats};

use crate::dataset::{Dataset, Photo};

/// Depths of all photos. [units of the dataset, cam]
#[derive(Debug)]
pub(super) struct Depths {
    pub(super) photos: Vec<PhotoDepths>,
    /// Points of which the photos' rays fell short.
    pub(super) hidden_points: usize,
    /// Points there are, once a photo.
    pub(super) points: usize,
}

/// Depths of one photo, H x W camera-z.
#[derive(Debug)]
pub(super) struct PhotoDepths {
    /// Where half of the light has stopped; 0 where it never does.
    pub(super) surface: Vec<f32>,
    /// To where the ray is free for certain: the nearest surface around, less what that may be off.
    pub(super) free: Vec<f32>,
}

impl Depths {
    pub(super) fn render(dataset: &Dataset, splats: &Splats, depth_error: f32) -> Self {
        let mut renderer = CpuRenderer::new(splats);
        let mut images = [RgbdImage::default()];
        let surfaces: Vec<Vec<f32>> = dataset
            .photos
            .iter()
            .map(|photo| {
                let camera = camera(photo);
                // A pose or lens that cannot be rendered shows nothing.
                match renderer.render(&[], &[camera], &mut images) {
                    Ok(_) => images[0].depth_median_m.clone(),
                    Err(_) => vec![0.0; photo.view.width * photo.view.height],
                }
            })
            .collect();
        let checked: Vec<(PhotoDepths, usize)> = dataset
            .photos
            .par_iter()
            .zip(surfaces)
            .map(|(photo, surface)| PhotoDepths::of(photo, surface, depth_error))
            .collect();
        let hidden_points = checked.iter().map(|(_, hidden)| hidden).sum();
        let points = dataset.photos.iter().map(|photo| photo.target.points.len()).sum();
        let photos = checked.into_iter().map(|(depths, _)| depths).collect();
        Self { photos, hidden_points, points }
    }
}

impl PhotoDepths {
    /// Returns the depths, and how many of the photo's points they fall short of.
    fn of(photo: &Photo, surface: Vec<f32>, depth_error: f32) -> (Self, usize) {
        let (width, height) = (photo.view.width, photo.view.height);
        let mut free = least_around(&surface, width, height);
        for z in &mut free {
            *z *= 1.0 - depth_error;
        }
        let mask = &photo.target.mask;
        if !mask.is_empty() {
            // What was masked moved, or was not there.
            free.iter_mut().zip(mask).filter(|(_, mask)| **mask == 0).for_each(|(z, _)| *z = 0.0);
        }
        let mut hidden = 0;
        for point in &photo.target.points {
            let (x, y) = (point.pixel as usize % width, point.pixel as usize / width);
            let nearest = point.z * (1.0 - depth_error);
            hidden += usize::from(surface[point.pixel as usize] < nearest);
            for y in y.saturating_sub(AROUND_POINT)..(y + AROUND_POINT + 1).min(height) {
                for x in x.saturating_sub(AROUND_POINT)..(x + AROUND_POINT + 1).min(width) {
                    // Something is there: what is rendered behind it is a hole of the training.
                    free[y * width + x] = free[y * width + x].min(nearest);
                }
            }
            // The ray to the point itself has been: what is rendered before it is a floater.
            free[point.pixel as usize] = nearest;
        }
        (Self { surface, free }, hidden)
    }
}

fn camera(photo: &Photo) -> Camera {
    let view = &photo.view;
    let [right, down, ahead] = view.rows.map(glam::Vec3::as_dvec3);
    let rotation = glam::DQuat::from_mat3(&glam::DMat3::from_cols(right, down, ahead));
    let pose = Pose::new(view.position.as_dvec3(), rotation.normalize());
    Camera::new(view.intrinsics(), pose, view.near)
}

/// Returns for every pixel the least of itself and its eight neighbours.
fn least_around(image: &[f32], width: usize, height: usize) -> Vec<f32> {
    let mut rows = vec![0.0; image.len()];
    for (out, row) in rows.chunks_exact_mut(width).zip(image.chunks_exact(width)) {
        for x in 0..width {
            out[x] = row[x].min(row[x.saturating_sub(1)]).min(row[(x + 1).min(width - 1)]);
        }
    }
    let mut least = vec![0.0; image.len()];
    for y in 0..height {
        let (above, below) = (y.saturating_sub(1) * width, (y + 1).min(height - 1) * width);
        for x in 0..width {
            least[y * width + x] = rows[y * width + x].min(rows[above + x]).min(rows[below + x]);
        }
    }
    least
}

/// Within so many pixels of a point it is what a ray meets. [px]
const AROUND_POINT: usize = 1;
