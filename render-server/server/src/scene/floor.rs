//! Detection of a floor in the splats at a place: a level surface, seen from above.
//!
//! The ground around the place is divided into cells. Each thin splat adds its height to the cells that it
//! covers, and the fullest layer of 0.25 m counts. So a capture's floor may be slightly shifted and inclined,
//! and neither a wall nor clutter counts as a floor. Budget: 5 ms for 1 M splats at other places.

use glam::{DVec2, DVec3, Mat3, Vec2, Vec3, Vec3Swizzles};
use vizflyt_splat::Splats;

/// Returns the share of the ground within [`REACH_M`] of a place that is level at about its height, with splats
/// of at least `min_opacity`. [m, world]
pub(super) fn floor_share(splats: &Splats, place_m: DVec3, min_opacity: f32) -> f64 {
    let per_side = (2.0 * REACH_M / CELL_M).round() as usize;
    let offset = |n: usize| (n as f64 + 0.5) * CELL_M - REACH_M;
    let cells: Vec<Vec2> = (0..per_side * per_side)
        .map(|k| DVec2::new(offset(k % per_side), offset(k / per_side)))
        .filter(|at| at.length() <= REACH_M)
        .map(glam::DVec2::as_vec2)
        .collect();
    // One bit per step of height.
    let mut heights = vec![0_u16; cells.len()];
    for k in 0..splats.len() {
        let p = (splats.means_m[k].as_dvec3() - place_m).as_vec3();
        let reach_m = REACH_M as f32 + CUTOFF * (splats.scales_m[k].max_element() + WIDENING_M);
        if splats.opacities[k] >= min_opacity && p.xy().length_squared() <= reach_m * reach_m {
            let sheet = Sheet::of(p, splats.scales_m[k], Mat3::from_quat(splats.rotations[k]));
            let Some(sheet) = sheet else { continue };
            for (at, heights) in cells.iter().zip(&mut heights) {
                *heights |= sheet.step_at(*at).map_or(0, |step| 1 << step);
            }
        }
    }
    let layer = (1_u16 << STEPS_OF_LAYER) - 1;
    let full = |layer: u16| heights.iter().filter(|heights| **heights & layer != 0).count();
    let fullest = (0..=STEPS - STEPS_OF_LAYER).map(|step| full(layer << step)).max();
    fullest.unwrap_or(0) as f64 / cells.len() as f64
}

/// Splat seen from above: an inclined ellipse.
struct Sheet {
    center: Vec3,
    /// Inverse of its horizontal covariance: xx, xy, yy.
    inverse: [f32; 3],
    slope: Vec2,
}

impl Sheet {
    /// Returns `None` for a splat that is too thick to be a surface seen from above.
    fn of(center: Vec3, scales_m: Vec3, axes: Mat3) -> Option<Self> {
        let covariance = axes * Mat3::from_diagonal(scales_m * scales_m) * axes.transpose();
        let widened = WIDENING_M * WIDENING_M;
        let (xx, yy) = (covariance.x_axis.x + widened, covariance.y_axis.y + widened);
        let xy = covariance.x_axis.y;
        let determinant = xx * yy - xy * xy;
        let inverse = [yy / determinant, -xy / determinant, xx / determinant];
        let along = Vec2::new(covariance.x_axis.z, covariance.y_axis.z);
        let slope = times(inverse, along);
        let thickness_m = (covariance.z_axis.z - slope.dot(along)).max(0.0).sqrt();
        (determinant > 0.0 && thickness_m <= SHEET_M).then_some(Self { center, inverse, slope })
    }

    /// Returns its step of height at a place, if it covers the place.
    fn step_at(&self, at: Vec2) -> Option<u32> {
        let away = at - self.center.xy();
        let height_m = self.center.z + self.slope.dot(away);
        let step = ((height_m - LOWEST_M) / STEP_M).floor();
        let there = times(self.inverse, away).dot(away) <= CUTOFF * CUTOFF;
        (there && (0.0..STEPS as f32).contains(&step)).then_some(step as u32)
    }
}

fn times([xx, xy, yy]: [f32; 3], v: Vec2) -> Vec2 {
    Vec2::new(xx * v.x + xy * v.y, xy * v.x + yy * v.y)
}

/// Radius of a vehicle with its climb and drift. [m]
pub(super) const REACH_M: f64 = 0.6;
const CELL_M: f64 = 0.1;
/// Splats that are finer than a cell still cover it: half a cell. [m]
const WIDENING_M: f32 = 0.05;
/// Maximum standard deviation of a surface across itself; thicker splats are haze. [m]
const SHEET_M: f32 = 0.08;
/// Extent of a splat, as in the baker. [standard deviations]
const CUTOFF: f32 = 2.0;
/// A floor may be this far below the start, and up to 0.4 m above: because of the guessed height of a capture,
/// or of grass. [m]
const LOWEST_M: f32 = -0.3;
const STEP_M: f32 = 0.05;
const STEPS: u32 = 14;
/// Maximum unevenness of a floor: 0.25 m. The captured room's floor is inclined by some degrees.
const STEPS_OF_LAYER: u32 = 5;

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;

    /// Discs of 5 cm, 10 cm apart, on a square of 2 m, rotated, at heights.
    fn ground(rotation: Quat, height_m: impl Fn(f32, f32) -> f32) -> Splats {
        let on_line = |k: usize| k as f32 * 0.1 - 1.0;
        let places = (0..441).map(|k| (on_line(k % 21), on_line(k / 21)));
        Splats {
            antialiased: false,
            means_m: places.map(|(x, y)| Vec3::new(x, y, height_m(x, y))).collect(),
            scales_m: vec![Vec3::new(0.1, 0.1, 0.005); 441],
            rotations: vec![rotation; 441],
            opacities: vec![0.9; 441],
            sh_degree: 0,
            sh: vec![0.5; 3 * 441],
        }
    }

    fn share(splats: &Splats) -> f64 {
        floor_share(splats, DVec3::ZERO, 0.3)
    }

    #[test]
    fn level_and_slightly_inclined_ground_is_a_floor() {
        for height_m in [-0.25, 0.0, 0.3] {
            assert_eq!(share(&ground(Quat::IDENTITY, |_, _| height_m)), 1.0);
        }
        let inclined = Quat::from_rotation_y(-0.1);
        assert!(share(&ground(inclined, |x, _| 0.1 * x)) > 0.95);
        // Finer than the cells.
        let mut fine = ground(Quat::IDENTITY, |_, _| 0.0);
        fine.scales_m.fill(Vec3::splat(0.002));
        assert_eq!(share(&fine), 1.0);
    }

    #[test]
    fn walls_haze_steep_and_distant_ground_are_not_a_floor() {
        let flat = || ground(Quat::IDENTITY, |_, _| 0.0);
        let upright = ground(Quat::from_rotation_x(1.5), |_, _| 0.0);
        assert_eq!(share(&upright), 0.0);
        for height_m in [-0.5, 0.6, 3.0] {
            assert_eq!(share(&ground(Quat::IDENTITY, |_, _| height_m)), 0.0);
        }
        assert!(share(&ground(Quat::from_rotation_y(-0.8), |x, _| x)) < 0.5);
        let mut haze = flat();
        haze.scales_m.fill(Vec3::splat(0.3));
        assert_eq!(share(&haze), 0.0);
        let mut faint = flat();
        faint.opacities.fill(0.1);
        assert_eq!(share(&faint), 0.0);
        let mut broken = flat();
        broken.scales_m.fill(Vec3::splat(f32::NAN));
        assert_eq!(share(&broken), 0.0);
        assert_eq!(share(&Splats::default()), 0.0);
    }
}
