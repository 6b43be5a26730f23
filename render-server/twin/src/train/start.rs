//! Initial Gaussians of a training, from the first source available:
//!
//! 1. Points of structure from motion. Where a photo has none nearby (floors, ceilings), the depth follows from its
//!    nearest points.
//! 2. Depths of depth images.
//! 3. Random places in the cameras' views.

use glam::{DMat3, DVec3, Quat, Vec3};

use super::Options;
use crate::dataset::{Dataset, Photo};
use crate::gaussians::Gaussians;
use crate::neighbours::spacing;
use crate::random::Random;

/// Returns the initial Gaussians, at most half the maximum number.
pub(super) fn gaussians(dataset: &Dataset, options: &Options, extent: f32) -> Gaussians {
    let mut random = Random::stream(options.seed, 2);
    let most = (options.splats / 2).max(1);
    let mut places: Vec<(Vec3, [f32; 3])> = dataset
        .points
        .iter()
        .filter(|point| point.position.is_finite())
        .map(|point| (point.position, point.rgb.map(|v| f32::from(v) / 255.0)))
        .collect();
    places.extend(dataset.photos.iter().flat_map(between_points));
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

/// Returns places between the points that a photo saw, on a coarse grid: where no point is near, at the depth of a
/// plane through the nearest points. A plane's inverse depth is affine in the pixel.
fn between_points(photo: &Photo) -> Vec<(Vec3, [f32; 3])> {
    let Photo { view, target, .. } = photo;
    let known: Vec<[f32; 3]> = target
        .points
        .iter()
        .map(|p| {
            let (x, y) = (p.pixel as usize % view.width, p.pixel as usize / view.width);
            [x as f32 + 0.5, y as f32 + 0.5, 1.0 / p.z]
        })
        .collect();
    if known.len() < NEIGHBOURS {
        return Vec::new();
    }
    let step = (view.width / GRID).max(4);
    let mut places = Vec::new();
    let mut nearest = Vec::new();
    for y in (step / 2..view.height).step_by(step) {
        for x in (step / 2..view.width).step_by(step) {
            let i = y * view.width + x;
            let at = [x as f32 + 0.5, y as f32 + 0.5];
            nearest.clear();
            nearest.extend(known.iter().map(|&[u, v, w]| {
                let (dx, dy) = (u - at[0], v - at[1]);
                (dx * dx + dy * dy, dx, dy, w)
            }));
            nearest.select_nth_unstable_by(NEIGHBOURS - 1, |a, b| a.0.total_cmp(&b.0));
            let nearest = &mut nearest[..NEIGHBOURS];
            let closest = nearest.iter().map(|n| n.0).fold(f32::INFINITY, f32::min).sqrt();
            if closest < step as f32 || target.mask.get(i) == Some(&0) {
                continue;
            }
            let inverse = plane(nearest, step as f64);
            // Not much nearer or farther than the points it is interpolated from.
            let (low, high) = nearest
                .iter()
                .fold((f32::INFINITY, 0f32), |(low, high), n| (low.min(n.3), high.max(n.3)));
            let z = 1.0 / inverse.clamp(0.7 * low, 1.5 * high);
            let rgb = std::array::from_fn(|c| f32::from(target.rgb[3 * i + c]) / 255.0);
            places.push((view.unproject(at, z), rgb));
        }
    }
    places
}

/// Returns the inverse depth at the origin of a plane through points (squared distance, x, y, inverse depth). Nearer
/// points have more weight. The plane is level if the points do not determine its inclination.
fn plane(points: &[(f32, f32, f32, f32)], unit: f64) -> f32 {
    let mut matrix = DMat3::from_diagonal(DVec3::new(0.0, 0.05, 0.05));
    let mut right = DVec3::ZERO;
    for &(square, x, y, inverse) in points {
        let weight = unit * unit / (f64::from(square) + unit * unit);
        let row = DVec3::new(1.0, f64::from(x) / unit, f64::from(y) / unit);
        matrix += DMat3::from_cols(row * row.x, row * row.y, row * row.z) * weight;
        right += row * (weight * f64::from(inverse));
    }
    (matrix.inverse() * right).x as f32
}

/// Returns a random place that some photo sees, with its colour in the photo.
fn guess(dataset: &Dataset, extent: f32, random: &mut Random) -> (Vec3, [f32; 3]) {
    let Photo { view, target, .. } = &dataset.photos[random.below(dataset.photos.len())];
    let (x, y) = (random.below(view.width), random.below(view.height));
    let i = y * view.width + x;
    let z = match target.depth.get(i) {
        Some(&z) if z > 0.0 => z,
        // Logarithmic distribution: as many at 1 to 2 as at 2 to 4.
        _ => extent * 10f32.powf(random.within(-1.0, 0.5)),
    };
    let rgb = std::array::from_fn(|c| f32::from(target.rgb[3 * i + c]) / 255.0);
    (view.unproject([x as f32 + 0.5, y as f32 + 0.5], z), rgb)
}

/// Number of points that determine a plane.
const NEIGHBOURS: usize = 8;
/// Grid cells across a photo.
const GRID: usize = 20;
/// Minimum number of points; with fewer, random places are added.
const MIN_POINTS: usize = 100;
/// Initial size of a Gaussian, in distances to its neighbours.
const SIZE: f32 = 0.6;
const OPACITY: f32 = 0.5;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loss::{SeenPoint, Target};
    use crate::view::View;
    use vizflyt_protocol::geometry::{Intrinsics, Pose};

    #[test]
    fn places_between_points_lie_on_their_plane() {
        let view =
            View::new(&Intrinsics::from_horizontal_fov(320, 240, 1.2), &Pose::IDENTITY, 0.01);
        // y = 1.5: a floor below the camera, seen in a strip at its far end.
        let floor = |x: usize, y: usize| {
            let down = (y as f32 + 0.5 - view.center[1]) / view.focal[1];
            SeenPoint { pixel: (y * view.width + x) as u32, z: 1.5 / down }
        };
        let points = (0..60).map(|n| floor(5 + 5 * n, 160 + 7 * (n % 5))).collect();
        let rgb = vec![90; 3 * view.width * view.height];
        let target = Target { width: 320, height: 240, rgb, points, ..Target::default() };
        let photo = Photo { name: String::new(), view, target };
        let below = |p: &&(Vec3, [f32; 3])| p.0.y / p.0.z > 0.38;
        let places = between_points(&photo);
        let floor: Vec<_> = places.iter().filter(below).collect();
        assert!(floor.len() > 10, "{} guesses", floor.len());
        // At the depth of the nearest points they would be as low as 2.4.
        for (p, _) in floor {
            assert!((p.y - 1.5).abs() < 0.4, "{p}");
        }
    }
}
