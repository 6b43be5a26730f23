//! Potential field: clearance and distance to the goal for every point within 8 m.
//!
//! A textbook potential field adds an attraction to the goal and a repulsion from each obstacle. The vehicle stops
//! where they cancel: in front of a wall, in a dead end. Therefore the attraction here is not the straight distance to
//! the goal but the length of the shortest way around all remembered obstacles, where a metre close to an obstacle
//! counts several times. The only minimum of this potential is the goal. It solves the eikonal equation |grad T| = cost
//! by fast sweeping (H. Zhao, "A fast sweeping method for eikonal equations", Math. Comp. 74, 2005): 64 x 64 cells in
//! 0.4 ms.

use vizflyt_sdk::Volume;
use vizflyt_sdk::glam::{DVec2, DVec3};

/// Input of the field.
#[derive(Clone, Copy, Debug)]
pub struct Surroundings<'a> {
    /// Position of the vehicle. [m, world]
    pub p_m: DVec3,
    /// Position of the goal. [m, world]
    pub goal_m: DVec2,
    /// Volume in which the body's surface must stay. [world]
    pub geofence: &'a Volume,
    /// Radius of the vehicle. [m]
    pub body_radius_m: f64,
}

/// Clearance and distance to the goal on a square grid around the vehicle: [`SIDE`] x [`SIDE`] cells, row-major, with a
/// border of one cell that blocks all ways.
#[derive(Clone, Debug)]
#[allow(clippy::struct_field_names)] // Why: `_m` is the unit.
pub struct Field {
    /// Centre of the corner cell with the smallest x and y. [m, world]
    origin_m: DVec2,
    /// Distance from the body's surface to the nearest obstacle or the fence, at most [`COMFORT_M`]. [m]
    clearance_m: Vec<f64>,
    /// Cost of crossing a cell: its side, and more near an obstacle. [m]
    step_m: Vec<f64>,
    /// Length of the way to the goal, in metres of free space.
    to_go_m: Vec<f64>,
}

impl Default for Field {
    fn default() -> Self {
        Self {
            origin_m: DVec2::ZERO,
            clearance_m: vec![0.0; PITCH * PITCH],
            step_m: vec![CELL_M; PITCH * PITCH],
            to_go_m: vec![0.0; PITCH * PITCH],
        }
    }
}

impl Field {
    /// Recomputes the field from obstacle points. [m, world]
    pub fn update(&mut self, around: &Surroundings<'_>, points_m: impl Iterator<Item = DVec3>) {
        let half_m = CELL_M * (SIDE as f64 - 1.0) / 2.0;
        // Aligned to whole cells, so that the same obstacle is in the same cells in every image.
        let corner_m = (around.p_m.truncate() - DVec2::splat(half_m)) / CELL_M;
        self.origin_m = corner_m.round() * CELL_M;
        self.fill_clearance(around, points_m);
        self.fill_to_go(around.goal_m);
    }

    /// Returns the distance from the body's surface to the nearest obstacle for a vehicle at `p_m` [m, world]. Negative
    /// inside obstacles, at most [`COMFORT_M`]. [m]
    pub fn clearance_m(&self, p_m: DVec2) -> f64 {
        self.interpolate(&self.clearance_m, p_m)
    }

    /// Returns the length of the way to the goal from `p_m` [m, world], with detours around obstacles and the cost of
    /// passing near them. [m]
    pub fn to_go_m(&self, p_m: DVec2) -> f64 {
        self.interpolate(&self.to_go_m, p_m)
    }

    fn fill_clearance(&mut self, around: &Surroundings<'_>, points_m: impl Iterator<Item = DVec3>) {
        for row in 0..SIDE {
            for column in 0..SIDE {
                let p_m = self.centre_m(column, row).extend(around.p_m.z);
                let inside_m = -around.geofence.signed_distance_m(p_m);
                self.clearance_m[index(column, row)] =
                    (inside_m - around.body_radius_m - FENCE_MARGIN_M).min(COMFORT_M);
            }
        }
        let reach_m = COMFORT_M + around.body_radius_m;
        for point_m in points_m {
            let point_m = point_m.truncate();
            let low = (point_m - DVec2::splat(reach_m) - self.origin_m) / CELL_M;
            let high = (point_m + DVec2::splat(reach_m) - self.origin_m) / CELL_M;
            for row in cells(low.y, high.y) {
                for column in cells(low.x, high.x) {
                    let distance_m = self.centre_m(column, row).distance(point_m);
                    let clearance_m = &mut self.clearance_m[index(column, row)];
                    *clearance_m = clearance_m.min(distance_m - around.body_radius_m);
                }
            }
        }
    }

    fn fill_to_go(&mut self, goal_m: DVec2) {
        for (step_m, &clearance_m) in self.step_m.iter_mut().zip(&self.clearance_m) {
            *step_m = CELL_M * cost(clearance_m);
        }
        self.to_go_m.fill(UNREACHED_M);
        let goal_cell = (goal_m - self.origin_m) / CELL_M;
        let last = SIDE as f64 - 1.0;
        if goal_cell.min_element() >= 0.0 && goal_cell.max_element() <= last {
            let (column, row) = (goal_cell.x.round() as usize, goal_cell.y.round() as usize);
            self.to_go_m[index(column, row)] = 0.0;
        } else {
            // The goal is outside the grid: leave over an edge on the goal's side, then fly straight.
            for along in 0..SIDE {
                let edges = [
                    (goal_cell.x < 0.0, 0, along),
                    (goal_cell.x > last, SIDE - 1, along),
                    (goal_cell.y < 0.0, along, 0),
                    (goal_cell.y > last, along, SIDE - 1),
                ];
                for (faces_goal, column, row) in edges {
                    let at = index(column, row);
                    if faces_goal && self.clearance_m[at] > TOUCH_M {
                        self.to_go_m[at] = self.centre_m(column, row).distance(goal_m);
                    }
                }
            }
        }
        // Each round sweeps in all four diagonal directions. Each additional bend of a path needs another round.
        for _ in 0..MAX_ROUNDS {
            let change_m = [(false, false), (true, false), (true, true), (false, true)]
                .into_iter()
                .map(|(leftward, downward)| self.sweep(leftward, downward))
                .fold(0.0, f64::max);
            if change_m < SETTLED_M {
                break;
            }
        }
    }

    /// Updates every cell from its neighbours in one order. Returns the largest change. [m]
    fn sweep(&mut self, leftward: bool, downward: bool) -> f64 {
        let mut greatest_m = 0.0_f64;
        for i in 0..SIDE {
            let row = if downward { SIDE - 1 - i } else { i };
            for j in 0..SIDE {
                let column = if leftward { SIDE - 1 - j } else { j };
                let at = index(column, row);
                let old_m = self.to_go_m[at];
                let x_m = least(self.to_go_m[at - 1], self.to_go_m[at + 1]);
                let y_m = least(self.to_go_m[at - PITCH], self.to_go_m[at + PITCH]);
                // Most visits change nothing, because no way over these neighbours can be shorter.
                let step_m = self.step_m[at];
                if least(x_m, y_m) + step_m * MIN_STEP >= old_m {
                    continue;
                }
                // Solves (T - x)^2 + (T - y)^2 = step^2, upwind: from only one neighbour if the other one is too far.
                let new_m = if (x_m - y_m).abs() >= step_m {
                    least(x_m, y_m) + step_m
                } else {
                    let gap_m = x_m - y_m;
                    0.5 * (x_m + y_m + (2.0 * step_m * step_m - gap_m * gap_m).sqrt())
                };
                if new_m < old_m {
                    self.to_go_m[at] = new_m;
                    greatest_m = greatest_m.max(old_m - new_m);
                }
            }
        }
        greatest_m
    }

    fn centre_m(&self, column: usize, row: usize) -> DVec2 {
        self.origin_m + DVec2::new(column as f64, row as f64) * CELL_M
    }

    /// Interpolates bilinearly; constant outside the grid.
    fn interpolate(&self, values: &[f64], p_m: DVec2) -> f64 {
        let last = SIDE as f64 - 1.0;
        let cell = ((p_m - self.origin_m) / CELL_M).clamp(DVec2::ZERO, DVec2::splat(last));
        let (column, row) = ((cell.x as usize).min(SIDE - 2), (cell.y as usize).min(SIDE - 2));
        let (fx, fy) = (cell.x - column as f64, cell.y - row as f64);
        let (at, above) = (index(column, row), index(column, row + 1));
        let low = values[at] + fx * (values[at + 1] - values[at]);
        let high = values[above] + fx * (values[above + 1] - values[above]);
        low + fy * (high - low)
    }
}

/// Returns the index of a cell.
fn index(column: usize, row: usize) -> usize {
    (row + 1) * PITCH + column + 1
}

/// Returns the smaller number. One instruction, while `f64::min` needs four because of NaN, which does not occur here.
fn least(a: f64, b: f64) -> f64 {
    if a < b { a } else { b }
}

/// Returns the cost of one metre at a clearance. [m]
fn cost(clearance_m: f64) -> f64 {
    if clearance_m < TOUCH_M {
        return COST_OF_TOUCH;
    }
    let discomfort = (1.0 - clearance_m / COMFORT_M).max(0.0);
    1.0 + COST_OF_DISCOMFORT * discomfort * discomfort
}

/// Returns the cells of the grid between two positions on an axis. [cells]
fn cells(low: f64, high: f64) -> std::ops::Range<usize> {
    let bound = |cell: f64| cell.clamp(0.0, SIDE as f64) as usize;
    bound(low.ceil())..bound(high.floor() + 1.0)
}

/// Size of a grid cell. Distances are interpolated between centres. At 0.35 m from a point, the maximum error is cell^2
/// / (8 * distance) = 2.2 cm. [m]
const CELL_M: f64 = 0.25;
/// Cells per side: 8 m in each direction is 1.6 s at 5 m/s, more than the time to stop.
const SIDE: usize = 64;
/// Cells from one row to the next: one side and the border.
const PITCH: usize = SIDE + 2;
/// More clearance than this has no benefit: half of the forest's narrowest gap (1.4 m), minus the body. [m]
pub const COMFORT_M: f64 = 0.7;
/// Distances to a remembered point below this count as a collision: 5 cm for the blur of a splat's surface and 3 cm for
/// the pose. [m]
pub const TOUCH_M: f64 = 0.08;
/// The fence counts as this much nearer, to stay clear of the guard's limit. [m]
const FENCE_MARGIN_M: f64 = 0.3;
/// A metre at touching distance counts as five metres: a detour of that length is accepted for more clearance.
const COST_OF_DISCOMFORT: f64 = 4.0;
/// Large but finite cost of a cell inside an obstacle, so that a field that starts inside leads out.
const COST_OF_TOUCH: f64 = 60.0;
/// With two equal neighbours, a step adds 1 / sqrt(2) of its length, and never less.
const MIN_STEP: f64 = std::f64::consts::FRAC_1_SQRT_2;
/// Longer than any way through the grid.
const UNREACHED_M: f64 = 1e6;
/// Sweeping ends when no cell changes by more: 1 % of a candidate's gain. [m]
const SETTLED_M: f64 = 0.02;
/// Limits the computation; forests converge in two to four rounds.
const MAX_ROUNDS: usize = 8;

#[cfg(test)]
mod tests;
