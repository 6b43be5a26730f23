//! Keeps the splats that are visible from the free space around a path: the inside of a room,
//! without splats that float in it or lie behind its walls.
//!
//! ```text
//! solid splats -> occupied cells -> minus cells around the path -> grown by the radius -> flood
//! from the path -> free space
//! free space, grown by radius and depth -> splats near it stay; haze in the middle of it is
//! removed
//! ```
//! Cells exist up to `reach` around the path. If the flood reaches the border of the grid, the
//! scene is open, and splats beyond the grid stay.

use glam::{DVec3, IVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::cells::{Cells, is_solid};
use super::step::{EditError, InvalidStep, check_length, check_point, invalid};
use crate::Splats;

/// Parameters of [`super::EditStep::Carve`]. [scene]
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Carve {
    /// Point in the free space, or corners of a path through it.
    pub path: Vec<[f64; 3]>,
    /// Radius around the path that is assumed free, and that must fit through gaps.
    pub radius: f64,
    /// Thickness of a wall that is kept behind its surface.
    pub depth: f64,
    /// Side of the cells.
    pub cell: f64,
    /// Extent of the grid around the path.
    pub reach: f64,
}

/// Error: the grid needs too much memory.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "carve: {cells:.1e} cells of {side}, the maximum is {MAX_CELLS:.0e}: give larger cells, or a shorter reach"
)]
pub struct TooManyCells {
    /// Number of cells.
    pub cells: f64,
    /// Side of a cell. [scene]
    pub side: f64,
}

impl Carve {
    pub(super) fn check(&self) -> Result<(), InvalidStep> {
        if !(1..=MAX_CORNERS).contains(&self.path.len()) {
            let advice = "give 1 to 10000 points";
            return Err(invalid("path", format!("{} points", self.path.len()), advice));
        }
        self.path.iter().try_for_each(|p| check_point("path", *p))?;
        check_length("radius", self.radius)?;
        check_length("depth", self.depth)?;
        check_length("cell", self.cell)?;
        check_length("reach", self.reach)
    }

    /// Marks the splats to keep.
    ///
    /// # Errors
    /// [`EditError::TooManyCells`], [`EditError::NothingAround`], [`EditError::NoRoom`].
    pub(super) fn seen(&self, splats: &Splats) -> Result<Vec<bool>, EditError> {
        let grid = Grid::of(self)?;
        let on_path = self.cells_of_path(&grid);
        let around_path = grid.grown(&on_path, grid.steps(self.radius));
        let mut occupied = grid.covered(splats);
        occupied.iter_mut().zip(&around_path).for_each(|(cell, free)| *cell &= !free);
        if !occupied.contains(&1) {
            return Err(EditError::NothingAround(self.path[0], self.reach));
        }
        let blocked = grid.grown(&occupied, grid.steps(self.radius));
        let flooded = grid.flooded(&on_path, &blocked);
        if flooded.iter().zip(&around_path).all(|(free, known)| free <= known) {
            return Err(EditError::NoRoom(self.path[0]));
        }
        let is_open = grid.has_on_border(&flooded);
        let free = grid.grown(&flooded, grid.steps(self.radius));
        let near = grid.grown(&free, grid.steps(self.depth).max(1));
        let beside_solid = grid.grown(&occupied, 1);
        let stays = |index: usize| {
            let center = grid.index_of(splats.means_m[index].as_dvec3());
            let Some(center) = center else { return is_open };
            if around_path[center] == 1 || (free[center] == 1 && beside_solid[center] == 0) {
                return false;
            }
            let mut is_near = false;
            grid.cells.covered(splats, index, |cell| {
                is_near |= grid.index(cell).is_some_and(|cell| near[cell] == 1);
            });
            is_near
        };
        Ok((0..splats.len()).into_par_iter().map(stays).collect())
    }

    /// Returns the cells along the path.
    fn cells_of_path(&self, grid: &Grid) -> Vec<u8> {
        let mut on_path = vec![0; grid.len()];
        let mut mark = |p: DVec3| {
            if let Some(cell) = grid.index_of(p) {
                on_path[cell] = 1;
            }
        };
        let points: Vec<DVec3> = self.path.iter().copied().map(DVec3::from).collect();
        mark(points[0]);
        for pair in points.windows(2) {
            let steps = (pair[0].distance(pair[1]) / self.cell * 2.0).ceil().max(1.0);
            (0..=steps as u64).for_each(|k| mark(pair[0].lerp(pair[1], k as f64 / steps)));
        }
        on_path
    }
}

/// Box of cells, z fastest. Its fields contain 0 or 1 per cell.
struct Grid {
    cells: Cells,
    low: IVec3,
    size: [usize; 3],
}

impl Grid {
    fn of(carve: &Carve) -> Result<Self, EditError> {
        let cells = Cells { side: carve.cell };
        let points = || carve.path.iter().copied().map(DVec3::from);
        let min = points().fold(DVec3::INFINITY, DVec3::min) - carve.reach;
        let max = points().fold(DVec3::NEG_INFINITY, DVec3::max) + carve.reach;
        let count = ((max - min) / carve.cell).ceil() + 1.0;
        let too_many = TooManyCells { cells: count.element_product(), side: carve.cell };
        let corners = cells.of(min).zip(cells.of(max));
        let (low, high) = corners
            .filter(|_| count.element_product() <= MAX_CELLS)
            .ok_or(EditError::TooManyCells(too_many))?;
        Ok(Self { cells, low, size: (high - low + 1).to_array().map(|n| n as usize) })
    }

    fn len(&self) -> usize {
        self.size.iter().product()
    }

    /// Returns a length in cells.
    fn steps(&self, length: f64) -> usize {
        // Clamped, because no field is longer than the maximum number of cells.
        (length / self.cells.side).round().clamp(0.0, MAX_CELLS) as usize
    }

    fn index(&self, cell: IVec3) -> Option<usize> {
        let [x, y, z] = (cell - self.low).to_array().map(|n| usize::try_from(n).ok());
        let [nx, ny, nz] = self.size;
        let [x, y, z] = [x.filter(|x| *x < nx)?, y.filter(|y| *y < ny)?, z.filter(|z| *z < nz)?];
        Some((x * ny + y) * nz + z)
    }

    fn index_of(&self, p: DVec3) -> Option<usize> {
        self.index(self.cells.of(p)?)
    }

    /// Returns the cells that solid splats cover.
    fn covered(&self, splats: &Splats) -> Vec<u8> {
        let mut covered = vec![0; self.len()];
        for index in (0..splats.len()).filter(|&index| is_solid(splats, index, SOLID_OPACITY)) {
            self.cells.covered(splats, index, |cell| {
                if let Some(cell) = self.index(cell) {
                    covered[cell] = 1;
                }
            });
        }
        covered
    }

    /// Returns a field in which each marked cell is grown to a cube, by `steps` cells along each
    /// axis in turn.
    fn grown(&self, field: &[u8], steps: usize) -> Vec<u8> {
        let [nx, ny, nz] = self.size;
        let mut grown = field.to_vec();
        for (length, stride) in [(nz, 1), (ny, nz), (nx, ny * nz)] {
            grown.par_chunks_exact_mut(length * stride).for_each(|block| {
                // Cells that were marked before are 1, cells marked here are 2.
                let mark = |row: &mut [u8], left: &mut [u32]| {
                    for (cell, left) in row.iter_mut().zip(left) {
                        if *cell == 1 {
                            *left = steps as u32;
                        } else if *left > 0 {
                            *left -= 1;
                            *cell = 2;
                        }
                    }
                };
                // Forward, then backward: `left` holds the remaining steps of the last marked cell,
                // for each line along the axis.
                let mut left = vec![0; stride];
                block.chunks_exact_mut(stride).for_each(|row| mark(row, &mut left));
                left.fill(0);
                block.chunks_exact_mut(stride).rev().for_each(|row| mark(row, &mut left));
                for cell in block {
                    *cell = u8::from(*cell > 0);
                }
            });
        }
        grown
    }

    /// Returns the cells that are connected to the seeds through faces of unblocked cells.
    fn flooded(&self, seeds: &[u8], blocked: &[u8]) -> Vec<u8> {
        let [nx, ny, nz] = self.size;
        let mut reached = seeds.to_vec();
        let mut open: Vec<usize> = (0..seeds.len()).filter(|cell| seeds[*cell] == 1).collect();
        while let Some(cell) = open.pop() {
            let (x, y, z) = (cell / (ny * nz), cell / nz % ny, cell % nz);
            let beside = [
                (x > 0).then(|| cell - ny * nz),
                (x + 1 < nx).then(|| cell + ny * nz),
                (y > 0).then(|| cell - nz),
                (y + 1 < ny).then(|| cell + nz),
                (z > 0).then(|| cell - 1),
                (z + 1 < nz).then(|| cell + 1),
            ];
            for other in beside.into_iter().flatten() {
                if reached[other] == 0 && blocked[other] == 0 {
                    reached[other] = 1;
                    open.push(other);
                }
            }
        }
        reached
    }

    /// Returns whether a cell of a field at the border of the grid is marked.
    fn has_on_border(&self, field: &[u8]) -> bool {
        let [nx, ny, nz] = self.size;
        let is_border = |cell: usize| {
            let (x, y, z) = (cell / (ny * nz), cell / nz % ny, cell % nz);
            x == 0 || x + 1 == nx || y == 0 || y + 1 == ny || z == 0 || z + 1 == nz
        };
        (0..field.len()).any(|cell| field[cell] == 1 && is_border(cell))
    }
}

/// Maximum points of a path: ten per second of a walk of several minutes.
const MAX_CORNERS: usize = 10_000;
/// Maximum cells of the grid: six fields of one byte per cell are 200 MB.
const MAX_CELLS: f64 = 3.2e7;
/// Minimum opacity of a splat that occupies cells: the default of the obstacle baker.
const SOLID_OPACITY: f32 = 0.3;
