//! Corners of printed tags, seen by cameras whose poses in the scene are known: where the scene has each.

use glam::{DMat3, DVec3};

use super::eigen::symmetric;

/// A line of sight to a corner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// The camera. [scene]
    pub origin: DVec3,
    /// Towards the corner, of unit length. [scene]
    pub direction: DVec3,
}

impl Ray {
    fn off_rad(&self, p: DVec3) -> f64 {
        let towards = p - self.origin;
        towards.cross(self.direction).length().atan2(towards.dot(self.direction))
    }
}

/// A point that several rays meet in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Corner {
    /// Where. [scene]
    pub position: DVec3,
    /// How far rays pass by it, root mean square. [rad]
    pub rms_rad: f64,
    /// Rays that meet there.
    pub used: usize,
}

/// Returns where rays meet; `None` where fewer than two do, or all look along one line. Rays that pass by where the
/// others meet are left out.
pub fn meet(rays: &[Ray]) -> Option<Corner> {
    meet_within(rays, PASSES_BY_RAD)
}

/// As [`meet`], by rays that are known to an angle. [rad]
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
        // One that is far off pulls the rest along: the worst goes, then all are looked at again.
        used.swap_remove(index);
        if used.len() < 2 || used.len() * 2 < rays.len() {
            return None;
        }
    }
}

/// Returns the point with the least squares of angles.
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
            // A distance from the ray is an angle by how far it is.
            *weight = 1.0 / position.distance_squared(ray.origin).max(f64::MIN_POSITIVE);
        }
    }
    let is_ahead = |ray: &Ray| (position - ray.origin).dot(ray.direction) > 0.0;
    rays.iter().all(is_ahead).then_some(position)
}

/// Three pixels of a lens with 600 px: a corner that was found is within one.
const PASSES_BY_RAD: f64 = 0.005;
/// Rays less than some 2 degrees apart do not say how far they meet: the square of half of that.
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
    fn rays_meet_and_a_wrong_one_is_left_out() {
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
    fn what_does_not_meet_is_nowhere() {
        let p = DVec3::new(0.0, 5.0, 0.0);
        let side_by_side = [ray(DVec3::ZERO, p), ray(DVec3::new(0.01, 0.0, 0.0), p)];
        assert_eq!(meet(&side_by_side), None);
        assert_eq!(meet(&side_by_side[..1]), None);
        // They cross behind both.
        let behind =
            [DVec3::X, -DVec3::X].map(|origin| Ray { origin, direction: (origin - p).normalize() });
        assert_eq!(meet(&behind), None);
        let apart = [ray(DVec3::X, p), ray(-DVec3::X, p + DVec3::Z)];
        assert_eq!(meet(&apart), None);
    }
}
