//! The Gaussians that a training starts with: at the points of structure from motion; without them at
//! the depths of depth images; without those anywhere in what the cameras see.

use glam::{Quat, Vec3};

use super::Options;
use crate::dataset::{Dataset, Photo};
use crate::gaussians::Gaussians;
use crate::neighbours::spacing;
use crate::random::Random;

/// Returns the first Gaussians, not more than half the budget.
pub(super) fn gaussians(dataset: &Dataset, options: &Options, extent: f32) -> Gaussians {
    let mut random = Random::stream(options.seed, 2);
    let most = (options.splats / 2).max(1);
    let mut places: Vec<(Vec3, [f32; 3])> = dataset
        .points
        .iter()
        .filter(|point| point.position.is_finite())
        .map(|point| (point.position, point.rgb.map(|v| f32::from(v) / 255.0)))
        .collect();
    if places.len() < MIN_POINTS {
        let wanted = (most / 2).max(MIN_POINTS.min(most));
        places.extend((0..wanted).map(|_| guess(dataset, extent, &mut random)));
    }
    if places.len() > most {
        random.shuffle(&mut places);
        places.truncate(most);
    }
    let positions: Vec<Vec3> = places.iter().map(|(position, _)| *position).collect();
    let mut gaussians = Gaussians::new(options.degree);
    for ((position, rgb), spacing) in places.into_iter().zip(spacing(&positions)) {
        let size = spacing.clamp(1e-4 * extent, 0.1 * extent) * SIZE;
        let rotation =
            Quat::from_xyzw(random.normal(), random.normal(), random.normal(), random.normal());
        let rotation = if rotation.length() > 1e-3 { rotation.normalize() } else { Quat::IDENTITY };
        gaussians.push(position, Vec3::splat(size), rotation, OPACITY, rgb);
    }
    gaussians
}

/// Returns a place that some photo sees, with the colour that it has there.
fn guess(dataset: &Dataset, extent: f32, random: &mut Random) -> (Vec3, [f32; 3]) {
    let Photo { view, target, .. } = &dataset.photos[random.below(dataset.photos.len())];
    let (x, y) = (random.below(view.width), random.below(view.height));
    let i = y * view.width + x;
    let z = match target.depth.get(i) {
        Some(&z) if z > 0.0 => z,
        // As many at 1 to 2 as at 2 to 4.
        _ => extent * 10f32.powf(random.within(-1.0, 0.5)),
    };
    let rgb = std::array::from_fn(|c| f32::from(target.rgb[3 * i + c]) / 255.0);
    (view.unproject([x as f32 + 0.5, y as f32 + 0.5], z), rgb)
}

/// Fewer points are no start.
const MIN_POINTS: usize = 100;
/// Of a Gaussian, in distances to its neighbours.
const SIZE: f32 = 0.6;
const OPACITY: f32 = 0.5;
