//! Core of a captured scene: dense parts, without sky, backdrop and floaters.
//!
//! ```text
//! centres of solid splats -> median, reach -> counts in coarse cells -> largest connected part
//! ```
//! A few per cent of sky a hundred times further away distort extremes and percentiles, but neither a median
//! nor density. Cells are a sixth of the median reach wide. A cell counts if it holds a minimum share of the
//! splats, and touching cells form one part.

use glam::{DVec3, IVec3, Vec3};
use vizflyt_splat::Splats;

/// Returns the centres of the scene's core, each transformed by `place`: of splats with at least half opacity,
/// or of all splats if there are none. Returns all centres if no dense part exists.
pub fn core(splats: &Splats, place: impl Fn(Vec3) -> Vec3) -> Vec<Vec3> {
    let solid = |least: f32| -> Vec<Vec3> {
        let means = splats.means_m.iter().zip(&splats.opacities);
        means.filter(|(_, opacity)| **opacity >= least).map(|(mean, _)| place(*mean)).collect()
    };
    let mut points = solid(SOLID_OPACITY);
    if points.is_empty() {
        points = solid(0.0);
    }
    let cells = Cells::around(&points);
    let Some(part) = cells.and_then(|cells| cells.largest_part(&points)) else { return points };
    if part.len() as f64 >= LEAST_SHARE * points.len() as f64 { part } else { points }
}

/// Returns the corners of a box around all points except [`EDGE`] of them at either end of each axis; zeros
/// without points.
pub fn bounds(mut points: Vec<Vec3>) -> [DVec3; 2] {
    let mut corners = [DVec3::ZERO; 2];
    let Some(last) = points.len().checked_sub(1) else { return corners };
    for axis in 0..3 {
        for (corner, share) in corners.iter_mut().zip([EDGE, 1.0 - EDGE]) {
            let index = (share * last as f64).round() as usize;
            let (_, found, _) =
                points.select_nth_unstable_by(index, |a, b| a[axis].total_cmp(&b[axis]));
            corner[axis] = f64::from(found[axis]);
        }
    }
    corners
}

/// Cube of cells around the middle of the points.
struct Cells {
    low: Vec3,
    side: f32,
}

impl Cells {
    /// `None` if the points have no extent.
    fn around(points: &[Vec3]) -> Option<Self> {
        let median = |values: &mut Vec<f32>| {
            let middle = values.len() / 2;
            (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f32::total_cmp).1)
        };
        let mut middle = Vec3::ZERO;
        for axis in 0..3 {
            middle[axis] = median(&mut points.iter().map(|p| p[axis]).collect())?;
        }
        let away = |p: &Vec3| (*p - middle).abs().max_element();
        let reach = median(&mut points.iter().map(away).collect())?;
        let side = reach / CELLS_PER_REACH;
        let low = middle - side * (SIDE / 2) as f32;
        // A sixth of a denormal reach is not normal.
        (side.is_normal() && low.is_finite()).then_some(Self { low, side })
    }

    /// Returns the cell of a point; `None` outside the cube.
    fn of(&self, p: Vec3) -> Option<usize> {
        index(((p - self.low) / self.side).floor().as_ivec3())
    }

    /// Returns the points of the largest part: of cells that are full enough and touch each other, also at
    /// corners.
    fn largest_part(&self, points: &[Vec3]) -> Option<Vec<Vec3>> {
        let mut counts = vec![0_u32; (SIDE * SIDE * SIDE) as usize];
        for cell in points.iter().filter_map(|p| self.of(*p)) {
            counts[cell] += 1;
        }
        let least = (DENSE_SHARE * points.len() as f64).ceil().max(1.0) as u32;
        let mut part_of = vec![0_u32; counts.len()];
        let (mut most, mut parts, mut stack) = ((0_u64, 0_u32), 0, Vec::new());
        for first in 0..counts.len() {
            if part_of[first] != 0 || counts[first] < least {
                continue;
            }
            parts += 1;
            part_of[first] = parts;
            stack.push(first);
            let mut held = 0;
            while let Some(cell) = stack.pop() {
                held += u64::from(counts[cell]);
                for next in neighbours(cell) {
                    if part_of[next] == 0 && counts[next] >= least {
                        part_of[next] = parts;
                        stack.push(next);
                    }
                }
            }
            most = most.max((held, parts));
        }
        let largest = (most.0 > 0).then_some(most.1)?;
        let is_in = |p: &&Vec3| self.of(**p).is_some_and(|cell| part_of[cell] == largest);
        Some(points.iter().filter(is_in).copied().collect())
    }
}

fn index(cell: IVec3) -> Option<usize> {
    let within = cell.cmpge(IVec3::ZERO).all() && cell.cmplt(IVec3::splat(SIDE)).all();
    within.then(|| ((cell.x * SIDE + cell.y) * SIDE + cell.z) as usize)
}

/// Returns the cells around a cell, including itself.
fn neighbours(cell: usize) -> impl Iterator<Item = usize> {
    let cell = cell as i32;
    let at = IVec3::new(cell / (SIDE * SIDE), cell / SIDE % SIDE, cell % SIDE);
    let offsets =
        (-1..=1).flat_map(|x| (-1..=1).flat_map(move |y| (-1..=1).map(move |z| [x, y, z])));
    offsets.filter_map(move |offset| index(at + IVec3::from(offset)))
}

/// Minimum opacity of a solid splat; below it, it is haze.
pub(super) const SOLID_OPACITY: f32 = 0.5;
/// Share of the core's splats omitted at either end.
const EDGE: f64 = 0.02;
/// For a room of 29 x 17 x 15 units this gives cells of 1.4: walls stay connected, sky does not.
const CELLS_PER_REACH: f32 = 6.0;
/// Cells along the cube's side: points more than 12 times the reach away do not belong to the core.
const SIDE: i32 = 144;
/// Minimum share of all splats in a cell, which is 4 for `room.ply` (63 k solid ones), 50 for 1 M. 4 % of sky on a
/// sphere of twelve times the reach leaves 0.6 of 1 M in a cell.
const DENSE_SHARE: f64 = 5e-5;
/// Minimum share of the scene in the core.
const LEAST_SHARE: f64 = 0.25;

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;
    use proptest::prelude::*;

    /// Evenly distributed numbers in 0..1 without a generator (Weyl sequences).
    fn even(k: usize) -> Vec3 {
        let at = |step: f64| (k as f64 * step).fract() as f32;
        Vec3::new(at(0.819_172_513_4), at(0.671_043_606_7), at(0.549_700_477_9))
    }

    fn splats(means_m: Vec<Vec3>) -> Splats {
        let count = means_m.len();
        Splats {
            antialiased: false,
            means_m,
            scales_m: vec![Vec3::splat(0.1); count],
            rotations: vec![Quat::IDENTITY; count],
            opacities: vec![0.9; count],
            sh_degree: 0,
            sh: vec![0.0; count * 3],
        }
    }

    /// Faces of a room of 8 x 6 x 3 units.
    fn room(count: usize) -> Vec<Vec3> {
        let on_face = |k: usize| {
            let mut p = even(k);
            p[k % 3] = p[k % 3].round();
            p * Vec3::new(8.0, 6.0, 3.0)
        };
        (0..count).map(on_face).collect()
    }

    fn sky(count: usize, radius: f32) -> impl Iterator<Item = Vec3> {
        let direction = |k: usize| (even(k) - 0.5).normalize_or(Vec3::Z);
        (0..count).map(move |k| direction(k) * radius)
    }

    fn check_room(means: Vec<Vec3>) {
        let [low, high] = bounds(core(&splats(means), |p| p));
        let (low_off, high_off) = (low.abs(), (high - DVec3::new(8.0, 6.0, 3.0)).abs());
        assert!(low_off.max(high_off).max_element() < 0.35, "{low} to {high}");
    }

    #[test]
    fn sky_and_floaters_are_not_in_the_core() {
        check_room(room(20_000));
        for radius in [40.0, 300.0, 1e3, 1e6, 1e30] {
            for count in [800, 4000] {
                check_room(room(20_000).into_iter().chain(sky(count, radius)).collect());
            }
        }
        let floaters = (0..200).map(|k| (even(k + 7) - 0.5) * 60.0);
        check_room(room(20_000).into_iter().chain(floaters).collect());
    }

    #[test]
    fn rotated_scenes_have_the_same_core() {
        let turn = Quat::from_rotation_y(std::f32::consts::FRAC_PI_2);
        let turned = bounds(core(&splats(room(9000)), |p| turn * p));
        let size = turned[1] - turned[0];
        assert!((size - DVec3::new(3.0, 6.0, 8.0)).abs().max_element() < 0.4, "{size}");
    }

    proptest! {
        /// For any file contents: no panic, and the core is part of them.
        #[test]
        fn any_points_have_a_core(
            points in prop::collection::vec(
                prop::array::uniform3(prop_oneof![-10.0f32..10.0, prop::num::f32::NORMAL]), 0..80,
            ),
        ) {
            let points: Vec<Vec3> = points.into_iter().map(Vec3::from).collect();
            let core = core(&splats(points.clone()), |p| p);
            prop_assert!(core.iter().all(|p| points.contains(p)));
            prop_assert_eq!(core.is_empty(), points.is_empty());
            let [low, high] = bounds(core);
            prop_assert!(low.cmple(high).all());
        }
    }
}
