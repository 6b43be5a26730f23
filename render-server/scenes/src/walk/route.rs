//! Planner of a closed path over the free floor.
//!
//! The floor is a grid. A cell is free if a person fits between the true solids. The corners of a rectangle within the
//! fence are moved to the nearest reachable free cells and connected by shortest paths with a cost near obstacles
//! (Dijkstra 1959). The result is smoothed.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use glam::{DVec2, DVec3};
use vizflyt_protocol::geometry::Volume;

use crate::solids::Solids;

/// Walkable ground.
pub(crate) struct Ground<'a> {
    /// Solids of the scene.
    pub(crate) solids: &'a Solids,
    /// Additional volumes to avoid.
    pub(crate) keep_out: &'a [Volume],
    /// Walkable floor. [m, world]
    pub(crate) floor_m: [DVec2; 2],
    /// Floor area to capture. [m, world]
    pub(crate) within_m: [DVec2; 2],
}

/// Returns a closed path of about this length, with several laps if the ground is small. `None` without free floor.
pub(super) fn closed_way(ground: &Ground<'_>, wanted_m: f64) -> Option<Vec<DVec2>> {
    let grid = Grid::new(ground);
    let around = |share: f64, shift: f64| {
        let way = grid.joined(&rectangle(ground, share, shift))?;
        Some(smooth(&evenly(&way, SPACING_M)))
    };
    let whole = around(1.0, 0.0)?;
    let laps = libm::floor(wanted_m / length_m(&whole) + 0.2);
    if laps >= 1.0 {
        let laps = laps as usize;
        return Some((0..laps).flat_map(|_| whole.iter().copied()).collect());
    }
    // Find a smaller rectangle by bisection. If a wall is in its middle, the path is long, and another place is better.
    let mut best: Option<Vec<DVec2>> = None;
    let mut shortest = whole;
    for shift in SHIFTS {
        let (mut low, mut high) = (0.04, 1.0);
        for _ in 0..7 {
            let share = f64::midpoint(low, high);
            let Some(way) = around(share, shift) else { break };
            let found_m = length_m(&way);
            if found_m > wanted_m {
                high = share;
                if found_m < length_m(&shortest) {
                    shortest = way;
                }
            } else {
                low = share;
                if best.as_ref().is_none_or(|best| length_m(best) < found_m) {
                    best = Some(way);
                }
            }
        }
        if best.as_ref().is_some_and(|best| length_m(best) > 0.8 * wanted_m) {
            break;
        }
    }
    Some(best.unwrap_or(shortest))
}

/// Returns points at even distances along a closed path.
pub(super) fn evenly(way: &[DVec2], step_m: f64) -> Vec<DVec2> {
    let total_m = length_m(way);
    let count = ((total_m / step_m).round() as usize).max(8);
    let mut points = Vec::with_capacity(count);
    let (mut n, mut behind_m) = (0, 0.0);
    for k in 0..count {
        let wanted_m = total_m * k as f64 / count as f64;
        loop {
            let (a, b) = (way[n % way.len()], way[(n + 1) % way.len()]);
            let piece_m = (b - a).length();
            if behind_m + piece_m >= wanted_m || n >= way.len() {
                let t = if piece_m > 0.0 { (wanted_m - behind_m) / piece_m } else { 0.0 };
                points.push(a.lerp(b, t.clamp(0.0, 1.0)));
                break;
            }
            behind_m += piece_m;
            n += 1;
        }
    }
    points
}

/// Returns the length of a closed path. [m]
pub(super) fn length_m(way: &[DVec2]) -> f64 {
    (0..way.len()).map(|n| (way[(n + 1) % way.len()] - way[n]).length()).sum()
}

/// Returns the corners of a rectangle within the captured area, and points between them. `share` is its relative
/// length, `shift` its offset relative to the remaining length.
fn rectangle(ground: &Ground<'_>, share: f64, shift: f64) -> Vec<DVec2> {
    let [low, high] = ground.within_m;
    let middle = (low + high) / 2.0;
    let half = ((high - low) / 2.0 - ASIDE_M).max(DVec2::splat(0.5));
    // Only the long side is reduced, so that a short walk in a long place still covers its width.
    let long = half.max_element();
    let whole = half;
    let half = half.min(DVec2::splat((long * share).max(0.25)));
    let middle = middle + (whole - half) * shift;
    let mut points = Vec::new();
    let corners = [
        DVec2::new(-1.0, -1.0),
        DVec2::new(1.0, -1.0),
        DVec2::new(1.0, 1.0),
        DVec2::new(-1.0, 1.0),
    ];
    for n in 0..4 {
        let (a, b) = (corners[n] * half, corners[(n + 1) % 4] * half);
        let pieces = ((b - a).length() / BETWEEN_M).ceil().max(1.0);
        for k in 0..pieces as usize {
            points.push(middle + a.lerp(b, k as f64 / pieces));
        }
    }
    points
}

/// Rounds corners with a Gaussian along the closed path.
fn smooth(way: &[DVec2]) -> Vec<DVec2> {
    let count = way.len() as isize;
    let reach = ((3.0 * ROUND_M / SPACING_M) as isize).min(count / 2);
    let at = |n: isize| {
        let (mut sum, mut weights) = (DVec2::ZERO, 0.0);
        for offset in -reach..=reach {
            let far = offset as f64 * SPACING_M / ROUND_M;
            let weight = libm::exp(-0.5 * far * far);
            sum += way[(n + offset).rem_euclid(count) as usize] * weight;
            weights += weight;
        }
        sum / weights
    };
    (0..count).map(at).collect()
}

/// Grid of the floor.
struct Grid {
    low_m: DVec2,
    columns: usize,
    rows: usize,
    /// Cost of each cell; infinite where a person does not fit.
    costs: Vec<f64>,
}

impl Grid {
    fn new(ground: &Ground<'_>) -> Self {
        let [low_m, high_m] = ground.floor_m;
        let size = ((high_m - low_m) / CELL_M).max(DVec2::ONE);
        let (columns, rows) = (size.x as usize, size.y as usize);
        let mut costs = Vec::with_capacity(columns * rows);
        for row in 0..rows {
            for column in 0..columns {
                let at = low_m + (DVec2::new(column as f64, row as f64) + 0.5) * CELL_M;
                let free_m = HEIGHTS_M
                    .map(|z| {
                        let p_m = DVec3::new(at.x, at.y, z);
                        let kept = ground.keep_out.iter().map(|v| v.signed_distance_m(p_m));
                        kept.fold(ground.solids.distance_to_bodies_m(p_m), f64::min)
                    })
                    .into_iter()
                    .fold(f64::MAX, f64::min);
                let crowded = (ELBOW_M - free_m).max(0.0) / ELBOW_M;
                costs.push(if free_m < BODY_M { f64::INFINITY } else { 1.0 + 6.0 * crowded });
            }
        }
        Self { low_m, columns, rows, costs }
    }

    /// Returns the closed path through all points, each moved to the nearest cell that is reachable from the first one.
    fn joined(&self, points: &[DVec2]) -> Option<Vec<DVec2>> {
        let reachable = self.search(self.nearest(points[0], |_| true)?, None);
        let cells: Vec<usize> = points
            .iter()
            .filter_map(|&p| self.nearest(p, |cell| reachable.costs[cell].is_finite()))
            .collect();
        let mut way = Vec::new();
        for n in 0..cells.len() {
            let (from, to) = (cells[n], cells[(n + 1) % cells.len()]);
            // Search backwards, so that the path is in order.
            let search = self.search(to, Some(from));
            let mut cell = from;
            while cell != to {
                way.push(self.middle_m(cell));
                cell = search.before[cell]?;
            }
        }
        if way.is_empty() {
            way.push(self.middle_m(*cells.first()?));
        }
        Some(way)
    }

    fn middle_m(&self, cell: usize) -> DVec2 {
        let at = DVec2::new((cell % self.columns) as f64, (cell / self.columns) as f64);
        self.low_m + (at + 0.5) * CELL_M
    }

    /// Returns the nearest free and allowed cell to a point.
    fn nearest(&self, p_m: DVec2, allowed: impl Fn(usize) -> bool) -> Option<usize> {
        (0..self.costs.len()).filter(|&cell| self.costs[cell].is_finite() && allowed(cell)).min_by(
            |&a, &b| {
                let far = |cell| (self.middle_m(cell) - p_m).length_squared();
                far(a).total_cmp(&far(b))
            },
        )
    }

    /// Searches all cells from a start, or until `until` is reached.
    fn search(&self, start: usize, until: Option<usize>) -> Search {
        let mut search = Search {
            costs: vec![f64::INFINITY; self.costs.len()],
            before: vec![None; self.costs.len()],
        };
        search.costs[start] = 0.0;
        let mut open = BinaryHeap::from([Open { cost: 0.0, cell: start }]);
        while let Some(Open { cost, cell }) = open.pop() {
            if Some(cell) == until {
                break;
            }
            if cost > search.costs[cell] {
                continue;
            }
            let (column, row) = ((cell % self.columns) as isize, (cell / self.columns) as isize);
            for (x, y) in NEIGHBOURS {
                let (to_x, to_y) = (column + x, row + y);
                let inside = (0..self.columns as isize).contains(&to_x)
                    && (0..self.rows as isize).contains(&to_y);
                if !inside {
                    continue;
                }
                let next = to_y as usize * self.columns + to_x as usize;
                let far = if x != 0 && y != 0 { core::f64::consts::SQRT_2 } else { 1.0 };
                let total = cost + far * (self.costs[cell] + self.costs[next]);
                if total < search.costs[next] {
                    search.costs[next] = total;
                    search.before[next] = Some(cell);
                    open.push(Open { cost: total, cell: next });
                }
            }
        }
        search
    }
}

struct Search {
    costs: Vec<f64>,
    before: Vec<Option<usize>>,
}

/// Entry of the queue: lowest cost first, ties by cell index, so that the order is deterministic.
#[derive(PartialEq)]
struct Open {
    cost: f64,
    cell: usize,
}

impl Eq for Open {}

impl Ord for Open {
    fn cmp(&self, other: &Self) -> Ordering {
        other.cost.total_cmp(&self.cost).then(other.cell.cmp(&self.cell))
    }
}

impl PartialOrd for Open {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

const NEIGHBOURS: [(isize, isize); 8] =
    [(-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)];
/// Tested offsets of a shorter rectangle, until the path has nearly the wanted length.
const SHIFTS: [f64; 5] = [0.0, -0.4, 0.4, -0.8, 0.8];
/// Side of a cell. [m]
const CELL_M: f64 = 0.1;
/// Heights at which a person must fit; a person can step over a twig on the floor. [m]
const HEIGHTS_M: [f64; 5] = [0.35, 0.75, 1.15, 1.55, 1.9];
/// Half the width of a person with arms, plus the deviation at rounded corners. [m]
const BODY_M: f64 = 0.42;
/// Preferred distance from obstacles. [m]
const ELBOW_M: f64 = 0.8;
/// Distance of the path from the border of the captured area. [m]
const ASIDE_M: f64 = 0.9;
/// Distance between the waypoints. [m]
const BETWEEN_M: f64 = 3.0;
/// Standard deviation of the smoothing at corners. [m]
const ROUND_M: f64 = 0.35;
/// Distance between points for the smoothing. [m]
const SPACING_M: f64 = 0.05;
