//! Assembly of single corners into the board's grid.

use std::collections::{HashMap, VecDeque};

use glam::{DVec2, IVec2};

use super::Checkerboard;
use super::corners::sample;
use crate::image::Gray;

/// Returns the board's corners in the order of [`Checkerboard::corners_m`]; `None` unless the connected corners are
/// exactly those of the board. [px]
pub(super) fn grow(image: &Gray, corners: &[DVec2], board: &Checkerboard) -> Option<Vec<DVec2>> {
    if corners.len() < board.count() {
        return None;
    }
    corners.iter().take(MAX_SEEDS).enumerate().find_map(|(seed, _)| {
        let cells = grow_from(image, corners, seed)?;
        order(&cells, corners, board)
    })
}

/// Returns columns and rows of a complete connected grid of any board, the smaller first.
pub(super) fn count(image: &Gray, corners: &[DVec2]) -> Option<(u32, u32)> {
    corners.iter().take(MAX_SEEDS).enumerate().find_map(|(seed, _)| {
        let cells = grow_from(image, corners, seed)?;
        let least = cells.keys().copied().reduce(IVec2::min)?;
        let size = cells.keys().copied().reduce(IVec2::max)? - least + 1;
        let is_whole = size.x * size.y == cells.len() as i32 && size.min_element() >= 3;
        // A grid close to the image's border may continue outside it.
        let step_px = |cell: &IVec2| {
            let next = cells.get(&(*cell + IVec2::X))?;
            Some(corners[*next].distance(corners[cells[cell]]))
        };
        let margin = DVec2::splat(2.0 * cells.keys().filter_map(step_px).fold(0.0, f64::max));
        let size_px = DVec2::new(image.width_px().into(), image.height_px().into());
        let inside =
            |corner: DVec2| corner.cmpgt(margin).all() && corner.cmplt(size_px - margin).all();
        let is_whole = is_whole && cells.values().all(|&corner| inside(corners[corner]));
        is_whole.then(|| (size.min_element() as u32, size.max_element() as u32))
    })
}

/// Returns the minimum distance between neighbours in a row. [px]
pub(super) fn least_spacing_px(grid: &[DVec2], columns: usize) -> f64 {
    let rows = grid.chunks(columns).flat_map(|row| row.windows(2));
    rows.map(|pair| pair[0].distance(pair[1])).fold(f64::INFINITY, f64::min)
}

/// Follows edges from one corner; returns the corner in each cell.
fn grow_from(image: &Gray, corners: &[DVec2], seed: usize) -> Option<HashMap<IVec2, usize>> {
    let start = corners[seed];
    let mut near: Vec<usize> = (0..corners.len()).filter(|&other| other != seed).collect();
    near.sort_by(|&a, &b| {
        start.distance_squared(corners[a]).total_cmp(&start.distance_squared(corners[b]))
    });
    let mut joined =
        near.into_iter().take(8).filter(|&other| is_edge(image, start, corners[other]));
    let along = corners[joined.next()?] - start;
    let across = joined
        .map(|other| corners[other] - start)
        .find(|step| step.angle_to(along).sin().abs() > MIN_SINE)?;
    let mut cells = HashMap::from([(IVec2::ZERO, seed)]);
    let mut taken = vec![false; corners.len()];
    taken[seed] = true;
    let mut queue = VecDeque::from([IVec2::ZERO]);
    while let Some(cell) = queue.pop_front() {
        let here = corners[cells[&cell]];
        for side in [IVec2::X, IVec2::NEG_X, IVec2::Y, IVec2::NEG_Y] {
            let next = cell + side;
            if cells.contains_key(&next) {
                continue;
            }
            let step = step(&cells, corners, cell, side)
                .unwrap_or_else(|| along * f64::from(side.x) + across * f64::from(side.y));
            let reach_px = REACH * step.length();
            let found = (0..corners.len())
                .filter(|&other| !taken[other])
                .map(|other| (corners[other].distance(here + step), other))
                .min_by(|a, b| a.0.total_cmp(&b.0));
            if let Some((off_px, other)) = found
                && off_px < reach_px
                && is_edge(image, here, corners[other])
            {
                taken[other] = true;
                cells.insert(next, other);
                queue.push_back(next);
            }
        }
    }
    Some(cells)
}

/// Returns the expected step from a cell to a neighbour, from nearby steps.
fn step(
    cells: &HashMap<IVec2, usize>,
    corners: &[DVec2],
    cell: IVec2,
    side: IVec2,
) -> Option<DVec2> {
    let between =
        |from: IVec2, to: IVec2| Some(corners[*cells.get(&to)?] - corners[*cells.get(&from)?]);
    let other = IVec2::new(side.y, side.x);
    between(cell - side, cell)
        .or_else(|| between(cell + other, cell + other + side))
        .or_else(|| between(cell - other, cell - other + side))
}

/// Returns whether an edge between squares connects two corners: dark on one side and bright on the other, along its
/// whole length.
fn is_edge(image: &Gray, from: DVec2, to: DVec2) -> bool {
    let aside = (to - from).perp() * 0.2;
    let difference = |t: f64| {
        let at = from.lerp(to, t);
        Some(sample(image, at + aside)? - sample(image, at - aside)?)
    };
    let [Some(a), Some(b), Some(c)] = [0.3, 0.5, 0.7].map(difference) else { return false };
    a.abs().min(b.abs()).min(c.abs()) > MIN_CONTRAST && a * b > 0.0 && b * c > 0.0
}

/// Returns the corners in the board's order.
fn order(
    cells: &HashMap<IVec2, usize>,
    corners: &[DVec2],
    board: &Checkerboard,
) -> Option<Vec<DVec2>> {
    if cells.len() != board.count() {
        return None;
    }
    // All mappings of columns and rows to the grid, without mirroring.
    let ways = [IVec2::X, IVec2::Y, IVec2::NEG_X, IVec2::NEG_Y]
        .into_iter()
        .flat_map(|x| [(x, x.perp()), (x, -x.perp())]);
    let laid = ways.filter_map(|(x, y)| {
        let place = |cell: &IVec2| IVec2::new(cell.dot(x), cell.dot(y));
        let least = cells.keys().map(place).reduce(IVec2::min)?;
        let mut grid = vec![None; board.count()];
        for (cell, &corner) in cells {
            let at = place(cell) - least;
            if at.x >= board.columns as i32 || at.y >= board.rows as i32 {
                return None;
            }
            grid[(at.y * board.columns as i32 + at.x) as usize] = Some(corners[corner]);
        }
        let grid: Vec<DVec2> = grid.into_iter().collect::<Option<_>>()?;
        let columns = board.columns as usize;
        let right = grid[columns - 1] - grid[0];
        let up = grid[grid.len() - columns] - grid[0];
        // y points down in the image, and up on the board.
        (right.perp_dot(up) < 0.0).then_some((right.normalize().x, grid))
    });
    laid.max_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, grid)| grid)
}

/// Maximum number of corners from which a grid is grown, the clearest first.
const MAX_SEEDS: usize = 40;
/// Maximum distance of a neighbour from its expected position, as a share of a step.
const REACH: f64 = 0.35;
/// Minimum sine of the angle between edges of a corner: 20 degrees, for tilted boards.
const MIN_SINE: f64 = 0.34;
/// Minimum contrast between the squares on both sides of an edge. [grey levels]
const MIN_CONTRAST: f64 = 12.0;
