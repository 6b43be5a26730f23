//! Viewing distance of each photo: depth of the trained scene at its pose, checked against the points of structure from
//! motion.

use rayon::prelude::*;
use vizflyt_protocol::geometry::Pose;
use vizflyt_splat::{Camera, CpuRenderer, Rasterizer, RgbdImage, Splats};

use crate::dataset::{Dataset, Photo};

/// Depths of all photos. [units of the dataset, cam]
#[derive(Debug)]
pub(super) struct Depths {
    pub(super) photos: Vec<PhotoDepths>,
    /// Number of points that the rendered depth hides.
    pub(super) hidden_points: usize,
    /// Number of points, counted once per photo.
    pub(super) points: usize,
}

/// Camera-z depths of one photo, H x W.
#[derive(Debug)]
pub(super) struct PhotoDepths {
    /// Depth at which half of the light has stopped; 0 if less stops.
    pub(super) surface: Vec<f32>,
    /// Depth up to which the ray is certainly free: the nearest surface of the neighbouring pixels, minus the depth
    /// error.
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
                // A pose or lens that cannot be rendered gives no depth.
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
    /// Returns the depths, and the number of the photo's points that they hide.
    fn of(photo: &Photo, surface: Vec<f32>, depth_error: f32) -> (Self, usize) {
        let (width, height) = (photo.view.width, photo.view.height);
        let mut free = least_around(&surface, width, height);
        for z in &mut free {
            *z *= 1.0 - depth_error;
        }
        let mask = &photo.target.mask;
        if !mask.is_empty() {
            // Masked pixels showed moving or absent things.
            free.iter_mut().zip(mask).filter(|(_, mask)| **mask == 0).for_each(|(z, _)| *z = 0.0);
        }
        let mut hidden = 0;
        for point in &photo.target.points {
            let (x, y) = (point.pixel as usize % width, point.pixel as usize / width);
            let nearest = point.z * (1.0 - depth_error);
            hidden += usize::from(surface[point.pixel as usize] < nearest);
            for y in y.saturating_sub(AROUND_POINT)..(y + AROUND_POINT + 1).min(height) {
                for x in x.saturating_sub(AROUND_POINT)..(x + AROUND_POINT + 1).min(width) {
                    // The point is a surface: a larger rendered depth means a hole of the training.
                    free[y * width + x] = free[y * width + x].min(nearest);
                }
            }
            // The photo saw the point: a smaller rendered depth means a floater.
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

/// Returns the minimum of each pixel and its eight neighbours.
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

/// Radius around a point's pixel within which rays end at the point. [px]
const AROUND_POINT: usize = 1;
