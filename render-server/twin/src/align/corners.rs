//! Triangulation of the corners of printed tags, from cameras with known poses in the scene.

use glam::{DMat3, DVec3};

use super::eigen::symmetric;

/// A line of sight to a corner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Camera position. [scene]
    pub origin: DVec3,
    /// Unit direction to the corner. [scene]
    pub direction: DVec3,
}

impl Ray {
    fn off_rad(&self, p: DVec3) -> f64 {
        let towards = p - self.origin;
        towards.cross(self.direction).length().atan2(towards.dot(self.direction))
    }
}

/// A point triangulated from several rays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Corner {
    /// Position. [scene]
    pub position: DVec3,
    /// RMS angle between the rays and the point. [rad]
    pub rms_rad: f64,
    /// Number of rays used.
    pub used: usize,
}

/// Triangulates a point. Rays that miss the intersection of the others are rejected. Returns `None` if fewer than two
/// remain, fewer than half of them, or if all are nearly parallel.
pub fn meet(rays: &[Ray]) -> Option<Corner> {
    meet_within(rays, PASSES_BY_RAD)
}

/// Triangulates like [`meet`], with a given accuracy of the rays. [rad]
pub fn meet_within(rays: &[Ray], passes_by_rad: f64) -> Option<Corner> {
    let mut used = rays.to_vec();
    loop {
        let position = nearest(&used)?;
        let worst = used.iter().map(|ray| ray.off_rad(position)).enumerate();
        let (index, off_rad) = worst.max_by(|(_, a), (_, b)| a.total_cmp(b))?;
        if off_rad <= passes_by_rad {
            let squares: f64 = used.iter().map(|ray| ray.off_rad(position).powi(2)).sum();
            let rms_rad = (squares / used.len() as f64).sqrt();
            return Some(Corner { position, rms_rad, used: used.len() });
        }
        // A bad ray displaces the solution for all: remove only the worst, then solve again.
        used.swap_remove(index);
        if used.len() < 2 || used.len() * 2 < rays.len() {
            return None;
        }
    }
}

/// Returns the point with the least sum of squared angles.
fn nearest(rays: &[Ray]) -> Option<DVec3> {
    let mut weights = vec![1.0; rays.len()];
    let mut position = DVec3::ZERO;
    for _ in 0..ROUNDS {
        let (mut across, mut sum) = (DMat3::ZERO, DVec3::ZERO);
        for (ray, weight) in rays.iter().zip(&weights) {
            let d = ray.direction;
            let outer = DMat3::from_cols(d * d.x, d * d.y, d * d.z);
            let part = (DMat3::IDENTITY - outer) * *weight;
            across += part;
            sum += part * ray.origin;
        }
        let rows = std::array::from_fn(|row| across.row(row).to_array());
        let [(least, _), _, (greatest, _)] = symmetric::<3>(rows);
        if !(least > PARALLEL * greatest) {
            return None;
        }
        position = across.inverse() * sum;
        for (weight, ray) in weights.iter_mut().zip(rays) {
            // The angle is the distance from the ray, divided by the distance from the camera.
            *weight = 1.0 / position.distance_squared(ray.origin).max(f64::MIN_POSITIVE);
        }
    }
    let is_ahead = |ray: &Ray| (position - ray.origin).dot(ray.direction) > 0.0;
    rays.iter().all(is_ahead).then_some(position)
}

/// Maximum angle of a used ray: three pixels at a focal length of 600 px; detected corners are within one pixel.
const PASSES_BY_RAD: f64 = 0.005;
/// Minimum eigenvalue ratio: rays within about 2 degrees do not determine a distance (square of half of that).
const PARALLEL: f64 = 3e-4;
const ROUNDS: usize = 5;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::tests_support::gauss;

    fn ray(origin: DVec3, p: DVec3) -> Ray {
        Ray { origin, direction: (p - origin).normalize() }
    }

    #[test]
    fn triangulates_and_rejects_a_wrong_ray() {
        let mut random = crate::random::Random::new(3);
        let p = DVec3::new(0.4, -0.2, 0.1);
        let around = |k: i32| {
            let angle = f64::from(k) * 0.25;
            DVec3::new(2.0 * angle.cos(), 2.0 * angle.sin(), 1.4)
        };
        let mut rays: Vec<Ray> =
            (0..8).map(|k| ray(around(k), p + gauss(&mut random) * 5e-4)).collect();
        let found = meet(&rays).unwrap();
        assert!(found.position.distance(p) < 1e-3 && found.used == 8, "{found:?}");
        rays[3] = ray(around(3), p + DVec3::X * 0.3);
        let found = meet(&rays).unwrap();
        assert!(found.position.distance(p) < 1e-3 && found.used == 7, "{found:?}");
    }

    #[test]
    fn rejects_rays_that_do_not_meet() {
        let p = DVec3::new(0.0, 5.0, 0.0);
        let side_by_side = [ray(DVec3::ZERO, p), ray(DVec3::new(0.01, 0.0, 0.0), p)];
        assert_eq!(meet(&side_by_side), None);
        assert_eq!(meet(&side_by_side[..1]), None);
        // Two rays that intersect behind both cameras.
        let behind =
            [DVec3::X, -DVec3::X].map(|origin| Ray { origin, direction: (origin - p).normalize() });
        assert_eq!(meet(&behind), None);
        let apart = [ray(DVec3::X, p), ray(-DVec3::X, p + DVec3::Z)];
        assert_eq!(meet(&apart), None);
    }
}
