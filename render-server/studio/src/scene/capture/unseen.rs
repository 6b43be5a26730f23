//! Unseen areas at the heights of flight: solid for the referee, and shown in the report so that a user films there.

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// Connected unseen area, from above.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Area {
    /// Minimum corner. [m, world]
    pub(super) min_m: DVec2,
    pub(super) max_m: DVec2,
    /// Area. [m²]
    pub(super) area_m2: f64,
    /// Rows of the area: minimum x, maximum x, minimum y; each is [`CELL_M`] wide. [m, world]
    pub(super) rows_m: Vec<[f64; 3]>,
}

/// Returns the areas in which less than half of each column was seen, the largest first. `share` returns the seen share
/// of a box.
pub(super) fn areas(min_m: DVec3, max_m: DVec3, share: impl Fn(DVec3, DVec3) -> f64) -> Vec<Area> {
    let cells = ((max_m - min_m).truncate() / CELL_M).ceil().max(DVec2::ONE);
    let (width, height) = (cells.x as usize, cells.y as usize);
    if width.saturating_mul(height) > MOST_CELLS {
        return Vec::new();
    }
    let corner = |x: usize, y: usize| min_m.truncate() + DVec2::new(x as f64, y as f64) * CELL_M;
    let mut left: Vec<bool> = (0..width * height)
        .map(|at| {
            let low = corner(at % width, at / width);
            let high = (low + CELL_M).min(max_m.truncate());
            share(low.extend(min_m.z), high.extend(max_m.z)) < SEEN
        })
        .collect();
    let mut areas = Vec::new();
    for first in 0..left.len() {
        if !left[first] {
            continue;
        }
        left[first] = false;
        let (mut part, mut next) = (vec![first], 0);
        while let Some(&at) = part.get(next) {
            next += 1;
            let (x, y) = (at % width, at / width);
            let beside = [
                (x > 0).then(|| at - 1),
                (x + 1 < width).then(|| at + 1),
                (y > 0).then(|| at - width),
                (y + 1 < height).then(|| at + width),
            ];
            for beside in beside.into_iter().flatten() {
                if std::mem::take(&mut left[beside]) {
                    part.push(beside);
                }
            }
        }
        part.sort_unstable();
        areas.push(Area::of(&part, width, corner));
    }
    areas.retain(|area| area.area_m2 >= LEAST_M2);
    areas.sort_by(|a, b| b.area_m2.total_cmp(&a.area_m2));
    areas
}

impl Area {
    /// Returns the area of cells, which must be in ascending order, row by row.
    fn of(cells: &[usize], width: usize, corner: impl Fn(usize, usize) -> DVec2) -> Self {
        let mut area = Self {
            min_m: DVec2::INFINITY,
            max_m: DVec2::NEG_INFINITY,
            area_m2: cells.len() as f64 * CELL_M * CELL_M,
            rows_m: Vec::new(),
        };
        let mut before = None;
        for &at in cells {
            let low = corner(at % width, at / width);
            area.min_m = area.min_m.min(low);
            area.max_m = area.max_m.max(low + CELL_M);
            match area.rows_m.last_mut() {
                Some(row) if before == Some(at.wrapping_sub(1)) && at % width > 0 => {
                    row[1] = low.x + CELL_M;
                }
                _ => area.rows_m.push([low.x, low.x + CELL_M, low.y]),
            }
            before = Some(at);
        }
        area
    }
}

/// Width of a column, about that of a vehicle. [m]
pub(super) const CELL_M: f64 = 0.25;
/// Minimum seen share of a seen column. It is below 1, because the inside of objects is never seen.
const SEEN: f64 = 0.5;
/// Minimum size of a reported area; smaller ones are furniture. [m²]
const LEAST_M2: f64 = 0.5;
/// Maximum number of columns: a square kilometre.
const MOST_CELLS: usize = 16_000_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_separate_areas_and_sorts_them_by_size() {
        let (min_m, max_m) = (DVec3::new(-1.0, 2.0, 0.0), DVec3::new(5.0, 8.0, 3.0));
        let is_unseen = |p: DVec2| {
            let corner = p.x < 0.0 && p.y < 3.0;
            let strip = p.x > 4.0;
            let chair = (p - DVec2::new(2.1, 5.1)).abs().max_element() < 0.2;
            corner || strip || chair
        };
        let share = |low: DVec3, high: DVec3| {
            assert!(low.z == 0.0 && high.z == 3.0 && high.cmpgt(low).all());
            if is_unseen(DVec3::midpoint(low, high).truncate()) { 0.2 } else { 0.8 }
        };
        let found = areas(min_m, max_m, share);
        let boxes: Vec<_> = found.iter().map(|area| (area.min_m, area.max_m)).collect();
        assert_eq!(
            boxes,
            [
                (DVec2::new(4.0, 2.0), DVec2::new(5.0, 8.0)),
                (DVec2::new(-1.0, 2.0), DVec2::new(0.0, 3.0)),
            ]
        );
        assert_eq!([found[0].area_m2, found[1].area_m2], [6.0, 1.0]);
        assert_eq!(found[1].rows_m[0], [-1.0, 0.0, 2.0]);
        assert_eq!(found[1].rows_m.len(), 4);
        assert!(areas(min_m, max_m, |_, _| 1.0).is_empty());
        // Everything unseen: rows do not continue in the next row.
        let all = areas(min_m, max_m, |_, _| 0.0);
        assert_eq!((all.len(), all[0].rows_m.len(), all[0].area_m2), (1, 24, 36.0));
        assert!(all[0].rows_m.iter().all(|row| (row[0], row[1]) == (-1.0, 5.0)));
    }
}
