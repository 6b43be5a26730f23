//! Indexed true geometry: distances, and ambient openness of surface points.

use glam::DVec3;
use vizflyt_protocol::geometry::Volume;

/// Volumes with a grid over x and y, so that a query only tests near volumes.
#[derive(Debug)]
pub(crate) struct Solids {
    volumes: Vec<Volume>,
    everywhere: Vec<u32>,
    cells: Vec<Vec<u32>>,
    min_x_m: f64,
    min_y_m: f64,
    columns: usize,
    rows: usize,
}

impl Solids {
    /// Builds the index.
    pub(crate) fn new(volumes: Vec<Volume>) -> Self {
        let boxes: Vec<Option<(DVec3, DVec3)>> = volumes.iter().map(bounds).collect();
        let (mut low, mut high) = (DVec3::splat(f64::MAX), DVec3::splat(f64::MIN));
        for (a, b) in boxes.iter().flatten() {
            low = low.min(*a);
            high = high.max(*b);
        }
        if low.x > high.x {
            (low, high) = (DVec3::ZERO, DVec3::ZERO);
        }
        let (min_x_m, min_y_m) = (low.x - REACH_M, low.y - REACH_M);
        let columns = ((high.x + REACH_M - min_x_m) / CELL_M) as usize + 1;
        let rows = ((high.y + REACH_M - min_y_m) / CELL_M) as usize + 1;
        let mut solids = Self {
            volumes,
            everywhere: Vec::new(),
            cells: vec![Vec::new(); columns * rows],
            min_x_m,
            min_y_m,
            columns,
            rows,
        };
        for (index, bounds) in boxes.iter().enumerate() {
            let Some((a, b)) = bounds else {
                solids.everywhere.push(index as u32);
                continue;
            };
            let to_column = |x: f64| (((x - min_x_m) / CELL_M).max(0.0) as usize).min(columns - 1);
            let to_row = |y: f64| (((y - min_y_m) / CELL_M).max(0.0) as usize).min(rows - 1);
            for row in to_row(a.y - REACH_M)..=to_row(b.y + REACH_M) {
                for column in to_column(a.x - REACH_M)..=to_column(b.x + REACH_M) {
                    solids.cells[row * columns + column].push(index as u32);
                }
            }
        }
        solids
    }

    pub(crate) fn into_volumes(self) -> Vec<Volume> {
        self.volumes
    }

    /// Returns the signed distance to the nearest volume, at most [`REACH_M`]; includes half spaces. [m]
    pub(crate) fn distance_m(&self, p_m: DVec3) -> f64 {
        let mut nearest = self.distance_to_bodies_m(p_m);
        for &index in &self.everywhere {
            nearest = nearest.min(self.volumes[index as usize].signed_distance_m(p_m));
        }
        nearest
    }

    /// Same as [`Self::distance_m`], but without half spaces (the floor).
    pub(crate) fn distance_to_bodies_m(&self, p_m: DVec3) -> f64 {
        let mut nearest = REACH_M;
        let (column, row) = ((p_m.x - self.min_x_m) / CELL_M, (p_m.y - self.min_y_m) / CELL_M);
        if column >= 0.0
            && row >= 0.0
            && (column as usize) < self.columns
            && (row as usize) < self.rows
        {
            for &index in &self.cells[row as usize * self.columns + column as usize] {
                nearest = nearest.min(self.volumes[index as usize].signed_distance_m(p_m));
            }
        }
        nearest
    }

    /// Returns the openness of a surface point to ambient light, 0 to 1. It compares the distance field along the
    /// normal with that of a single plane (Evans, SIGGRAPH 2006).
    pub(crate) fn openness(&self, p_m: DVec3, normal: DVec3) -> f64 {
        let mut blocked = 0.0;
        for (step_m, weight) in [(0.06, 0.9), (0.15, 0.7), (0.35, 0.55), (0.7, 0.35)] {
            let distance_m = self.distance_m(p_m + normal * step_m);
            blocked += weight * ((step_m - distance_m) / step_m).clamp(0.0, 1.0);
        }
        (1.0 - 0.45 * blocked).clamp(0.12, 1.0)
    }
}

/// Returns the corners of a volume's bounding box; `None` if it is unbounded.
pub(crate) fn bounds(volume: &Volume) -> Option<(DVec3, DVec3)> {
    match *volume {
        Volume::Sphere { center_m, radius_m } => {
            Some((center_m - DVec3::splat(radius_m), center_m + DVec3::splat(radius_m)))
        }
        Volume::Capsule { a_m, b_m, radius_m } => {
            Some((a_m.min(b_m) - DVec3::splat(radius_m), a_m.max(b_m) + DVec3::splat(radius_m)))
        }
        Volume::Cuboid { center_m, half_m, rotation } => {
            let reach = (rotation * DVec3::X * half_m.x).abs()
                + (rotation * DVec3::Y * half_m.y).abs()
                + (rotation * DVec3::Z * half_m.z).abs();
            Some((center_m - reach, center_m + reach))
        }
        Volume::HalfSpace { .. } => None,
    }
}

/// Maximum distance that a query returns. [m]
pub(crate) const REACH_M: f64 = 1.0;
const CELL_M: f64 = 0.5;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Rng;
    use glam::DQuat;

    #[test]
    fn the_index_returns_the_exact_minimum() {
        let mut rng = Rng::new(5, 0);
        let point = |rng: &mut Rng| DVec3::new(rng.spread(6.0), rng.spread(4.0), rng.spread(2.0));
        let mut volumes = vec![Volume::HalfSpace { normal: DVec3::Z, offset_m: -1.0 }];
        for _ in 0..20 {
            let (a_m, b_m) = (point(&mut rng), point(&mut rng));
            volumes.push(Volume::Capsule { a_m, b_m, radius_m: 0.2 });
            volumes.push(Volume::Sphere { center_m: point(&mut rng), radius_m: 0.3 });
            volumes.push(Volume::Cuboid {
                center_m: point(&mut rng),
                half_m: DVec3::new(0.5, 0.1, 0.3),
                rotation: DQuat::from_scaled_axis(rng.direction()),
            });
        }
        let solids = Solids::new(volumes.clone());
        for _ in 0..2000 {
            let p = point(&mut rng) * 1.5;
            let plain = volumes.iter().map(|v| v.signed_distance_m(p)).fold(REACH_M, f64::min);
            assert!((solids.distance_m(p) - plain).abs() < 1e-12);
        }
    }

    #[test]
    fn corners_are_less_open_than_free_surfaces() {
        let solids = Solids::new(vec![
            Volume::HalfSpace { normal: DVec3::Z, offset_m: 0.0 },
            Volume::aabb(DVec3::new(0.0, -2.0, 0.0), DVec3::new(0.2, 2.0, 2.0)),
        ]);
        let open = solids.openness(DVec3::new(-3.0, 0.0, 0.0), DVec3::Z);
        let corner = solids.openness(DVec3::new(-0.05, 0.0, 0.0), DVec3::Z);
        assert!(open > 0.99 && corner < 0.7, "open {open}, corner {corner}");
    }
}
