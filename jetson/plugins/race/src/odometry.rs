//! Estimates the camera's position from depth: each image is registered to a key image.
//!
//! The attitude is known except for a fraction of a degree, so the unknowns are the position and a small rotation. Each
//! sample of the new image is projected into the key image. The registration minimizes its distance to the surface
//! there, along that surface's normal (point to plane: Y. Chen and G. Medioni, "Object modelling by registration of
//! multiple range images", Image and Vision Computing 10(3), 1992). It also minimizes the difference in brightness,
//! which measures motion along a flat wall (F. Steinbrücker, J. Sturm and D. Cremers, "Real-time visual odometry from
//! dense RGB-D images", ICCV Workshops, 2011). In directions without information in the image, it uses the vehicle's
//! velocity. The floor gives the height without drift.

use vizflyt_sdk::glam::{DQuat, DVec2, DVec3};

use crate::sampling::{PixelGrid, Sample, SampleCamera};

/// Position and velocity of the camera.
#[derive(Clone, Debug, Default)]
pub struct Odometry {
    /// Position of the camera. [m, home]
    pub p_m: DVec3,
    /// Velocity of the camera. [m/s, home]
    pub v_mps: DVec3,
    /// Estimated error of the attitude. [rad, home axes]
    turn_rad: DVec3,
    last_s: Option<f64>,
    key: Option<Key>,
}

/// Reference image for the registration: every second sample of its grid.
#[derive(Clone, Debug)]
struct Key {
    camera: SampleCamera,
    camera_m: DVec3,
    columns: usize,
    rows: usize,
    cells: Vec<Cell>,
    /// Number of cells with a surface.
    surfaces: usize,
}

/// A cell of the key image.
#[derive(Clone, Copy, Debug, Default)]
struct Cell {
    /// Vector from the key's camera. [m, home axes]
    offset_m: DVec3,
    normal: Option<DVec3>,
    grey: f64,
    /// Gradient of the brightness, per cell.
    slope: DVec2,
}

/// Result of registering an image to the key image.
#[derive(Clone, Copy, Debug)]
struct Alignment {
    p_m: DVec3,
    turn_rad: DVec3,
    /// Fraction of the samples with a match in the key image.
    overlap: f64,
}

/// Normal equations for three numbers of position and three of rotation.
#[derive(Clone, Copy, Debug, Default)]
struct NormalEquations {
    matrix: [[f64; 6]; 6],
    right: [f64; 6],
}

impl NormalEquations {
    fn add(&mut self, slope: &[f64; 6], residual: f64, weight: f64) {
        for (row, (line, right)) in self.matrix.iter_mut().zip(&mut self.right).enumerate() {
            let weighted = slope[row] * weight;
            for (sum, other) in line.iter_mut().zip(slope) {
                *sum += weighted * other;
            }
            *right += weighted * residual;
        }
    }

    /// Adds the measurement of a point `offset_m` from the camera along `slope`.
    fn add_point(&mut self, slope: DVec3, offset_m: DVec3, residual: f64, weight: f64) {
        let lever = offset_m.cross(slope);
        self.add(&[slope.x, slope.y, slope.z, lever.x, lever.y, lever.z], residual, weight);
    }

    /// Solves by Cholesky's L L^T; `None` if the result is not finite.
    fn solve(&self) -> Option<[f64; 6]> {
        let mut l = [[0.0; 6]; 6];
        for row in 0..6 {
            for column in 0..=row {
                let known: f64 = (0..column).map(|k| l[row][k] * l[column][k]).sum();
                let rest = self.matrix[row][column] - known;
                l[row][column] = if row == column { rest.sqrt() } else { rest / l[column][column] };
            }
        }
        let mut y = [0.0; 6];
        for row in 0..6 {
            let known: f64 = (0..row).map(|k| l[row][k] * y[k]).sum();
            y[row] = (self.right[row] - known) / l[row][row];
        }
        let mut x = [0.0; 6];
        for row in (0..6).rev() {
            let known: f64 = (row + 1..6).map(|k| l[k][row] * x[k]).sum();
            x[row] = (y[row] - known) / l[row][row];
        }
        x.iter().all(|value| value.is_finite()).then_some(x)
    }
}

impl Odometry {
    /// Processes the image of time `now_s` on any steady clock, and rotates it by the estimated error of the attitude.
    /// Without depth, the velocity is assumed to be constant.
    pub fn update(&mut self, now_s: f64, grid: &mut PixelGrid) {
        let Some(camera) = grid.camera else { return };
        let dt_s = self.last_s.map_or(0.0, |last_s| now_s - last_s).clamp(0.0, MAX_DT_S);
        self.last_s = Some(now_s);
        let expected_m = self.p_m + self.v_mps * dt_s;
        let Some(key) = &self.key else {
            if let Some(height_m) = height_over_floor_m(grid) {
                self.p_m = DVec3::new(0.0, 0.0, height_m);
                self.key = Some(Key::new(&camera, self.p_m, grid));
            }
            return;
        };
        self.turn_rad *= STEADY;
        grid.turn(DQuat::from_scaled_axis(self.turn_rad));
        let Alignment { mut p_m, turn_rad, overlap } = key.locate(expected_m, grid);
        grid.turn(DQuat::from_scaled_axis(turn_rad));
        self.turn_rad = (self.turn_rad + turn_rad).clamp_length_max(MAX_TURN_RAD);
        p_m.z -= floor_error_m(grid, p_m.z);
        if dt_s > 0.0 {
            let v_mps = ((p_m - self.p_m) / dt_s).clamp_length_max(MAX_SPEED_MPS);
            self.v_mps += (v_mps - self.v_mps) * (dt_s / (dt_s + VELOCITY_LAG_S));
        }
        self.p_m = p_m;
        let turned_rad = key.camera.home_from_cam.angle_between(camera.home_from_cam);
        if overlap < OVERLAP || turned_rad > TURN_RAD || key.camera_m.distance(p_m) > REACH_M {
            self.key = Some(Key::new(&camera, p_m, grid));
        }
    }
}

impl Key {
    fn new(camera: &SampleCamera, camera_m: DVec3, grid: &PixelGrid) -> Self {
        let (columns, rows) = (grid.columns / SKIP, grid.rows / SKIP);
        let mut cells = Vec::with_capacity(columns * rows);
        for row in 0..rows {
            for column in 0..columns {
                let grey = |across: isize, down: isize| {
                    let (column, row) =
                        (column.checked_add_signed(across)?, row.checked_add_signed(down)?);
                    (column < columns && row < rows).then(|| grey_of(grid, column, row))
                };
                let slope = |high: Option<f64>, low: Option<f64>| {
                    high.zip(low).map_or(0.0, |(high, low)| (high - low) / 2.0)
                };
                cells.push(Cell {
                    offset_m: sample_of(grid, column, row).offset_m,
                    normal: normal(grid, SKIP * column + 1, SKIP * row + 1),
                    grey: grey_of(grid, column, row),
                    slope: DVec2::new(
                        slope(grey(1, 0), grey(-1, 0)),
                        slope(grey(0, 1), grey(0, -1)),
                    ),
                });
            }
        }
        let surfaces = cells.iter().filter(|cell| cell.normal.is_some()).count();
        Self {
            camera: SampleCamera { stride: SKIP * camera.stride, ..*camera },
            camera_m,
            columns,
            rows,
            cells,
            surfaces,
        }
    }

    /// Returns the position of a camera with this grid, near `expected_m`. [m, home]
    fn locate(&self, expected_m: DVec3, grid: &PixelGrid) -> Alignment {
        let (mut p_m, mut turn_rad, mut overlap) = (expected_m, DVec3::ZERO, 0.0);
        for round in 0..ROUNDS {
            let gate_m = GATE_M / f64::from(1 << round.min(2));
            let turn = DQuat::from_scaled_axis(turn_rad);
            // Priors: the predicted position and the attitude, with a low weight.
            let mut sums = NormalEquations::default();
            for axis in 0..3 {
                let (mut place, mut angle) = ([0.0; 6], [0.0; 6]);
                (place[axis], angle[axis + 3]) = (1.0, 1.0);
                sums.add(&place, (expected_m - p_m)[axis], MOTION_M.powi(-2));
                sums.add(&angle, -turn_rad[axis], ATTITUDE_RAD.powi(-2));
            }
            let mut met = 0;
            for row in 0..grid.rows / SKIP {
                for column in 0..grid.columns / SKIP {
                    let sample = sample_of(grid, column, row);
                    if !sample.is_seen() {
                        continue;
                    }
                    let offset_m = turn * sample.offset_m;
                    let from_key_m = p_m + offset_m - self.camera_m;
                    let Some((cell, aside)) = self.cell_at(from_key_m) else { continue };
                    let range_m = offset_m.length();
                    let apart_m = (cell.offset_m.length() - from_key_m.length()).abs();
                    if !(apart_m < gate_m + 0.1 * range_m) {
                        continue;
                    }
                    if let Some(n) = cell.normal {
                        let residual_m = n.dot(cell.offset_m - from_key_m);
                        let sigma_m = SIGMA_M + SIGMA_RATIO * range_m;
                        if residual_m.abs() < gate_m + 0.02 * range_m {
                            met += 1;
                            let weight = huber(residual_m / sigma_m) / (sigma_m * sigma_m);
                            sums.add_point(n, offset_m, residual_m, weight);
                        }
                    }
                    let dimmer = cell.grey + cell.slope.dot(aside) - grey_of(grid, column, row);
                    if dimmer.abs() < GREY_GATE {
                        let slope = self.camera.slope_along(from_key_m, cell.slope);
                        let weight = huber(dimmer / GREY) / (GREY * GREY);
                        sums.add_point(slope, offset_m, -dimmer, weight);
                    }
                }
            }
            overlap = f64::from(met) / self.surfaces.max(1) as f64;
            let Some(x) = sums.solve() else {
                return Alignment { p_m: expected_m, turn_rad: DVec3::ZERO, overlap: 0.0 };
            };
            let move_m = DVec3::new(x[0], x[1], x[2]);
            p_m += move_m;
            turn_rad += DVec3::new(x[3], x[4], x[5]);
            if move_m.length() < 2e-4 {
                break;
            }
        }
        Alignment { p_m, turn_rad, overlap }
    }

    /// Returns the cell of a point [m, home axes, from the key's camera], and the offset from the cell's middle.
    fn cell_at(&self, from_key_m: DVec3) -> Option<(&Cell, DVec2)> {
        let at = self.camera.sample_at(from_key_m)?;
        let (column, row) = (at.x as usize, at.y as usize);
        if column >= self.columns || row >= self.rows {
            return None;
        }
        let cell = &self.cells[row * self.columns + column];
        (cell.offset_m != DVec3::ZERO).then(|| (cell, at.fract() - 0.5))
    }
}

/// Returns the sample in the middle of a cell of two by two samples.
fn sample_of(grid: &PixelGrid, column: usize, row: usize) -> Sample {
    grid.at(SKIP * column + 1, SKIP * row + 1).copied().unwrap_or_default()
}

/// Returns the brightness of a cell.
fn grey_of(grid: &PixelGrid, column: usize, row: usize) -> f64 {
    let at = SKIP * row * grid.columns + SKIP * column;
    let (upper, lower) = (&grid.samples[at..], &grid.samples[at + grid.columns..]);
    0.25 * f64::from(upper[0].grey + upper[1].grey + lower[0].grey + lower[1].grey)
}

/// Returns the weight of a residual, in standard deviations. Beyond two of them, only its sign counts (P. Huber, Ann.
/// Math. Statist. 35(1), 1964). Errors of neighbours are correlated.
fn huber(deviations: f64) -> f64 {
    1.0 / ((deviations.abs() / 2.0).max(1.0) * CORRELATED)
}

/// Returns the normal of the surface at a sample from its neighbours; `None` at an edge.
fn normal(grid: &PixelGrid, column: usize, row: usize) -> Option<DVec3> {
    let seen = |column: usize, row: usize| {
        grid.at(column, row).filter(|sample| sample.is_seen()).map(|sample| sample.offset_m)
    };
    let p_m = seen(column, row)?;
    let (left_m, right_m) = (seen(column.checked_sub(2)?, row)?, seen(column + 2, row)?);
    let (up_m, down_m) = (seen(column, row.checked_sub(2)?)?, seen(column, row + 2)?);
    let range_m = p_m.length();
    let bend_m = (left_m + right_m - 2.0 * p_m).length() + (up_m + down_m - 2.0 * p_m).length();
    if bend_m > 0.02 + 0.03 * range_m {
        return None;
    }
    let normal = (right_m - left_m).cross(down_m - up_m).try_normalize()?;
    // At an angle below 6 degrees, the depth of a surface is unreliable.
    (normal.dot(p_m).abs() > 0.1 * range_m).then_some(normal)
}

/// Returns the height of the camera above the largest level surface below it. [m]
fn height_over_floor_m(grid: &PixelGrid) -> Option<f64> {
    let mut bins = [0_u32; 200];
    for sample in grid.samples.iter().filter(|sample| sample.is_seen()) {
        let below_m = -sample.offset_m.z;
        if below_m > 0.02
            && sample.offset_m.truncate().length() < 6.0
            && let Some(bin) = bins.get_mut((below_m / BIN_M) as usize)
        {
            *bin += 1;
        }
    }
    let (most, count) = bins.iter().enumerate().max_by_key(|&(_, count)| count)?;
    let low_m = (most as f64 - 1.0) * BIN_M;
    let of_floor = |below_m: &f64| (low_m..low_m + 3.0 * BIN_M).contains(below_m);
    let all: Vec<f64> =
        grid.samples.iter().map(|sample| -sample.offset_m.z).filter(of_floor).collect();
    (*count as usize > FLOOR_SAMPLES).then(|| all.iter().sum::<f64>() / all.len() as f64)
}

/// Returns the apparent height of the floor, or 0 if too little of the floor is visible. [m]
fn floor_error_m(grid: &PixelGrid, camera_z_m: f64) -> f64 {
    let (mut sum_m, mut count) = (0.0, 0);
    for sample in grid.samples.iter().filter(|sample| sample.is_seen()) {
        let z_m = camera_z_m + sample.offset_m.z;
        if z_m.abs() < 0.06 && sample.offset_m.length() < 5.0 {
            sum_m += z_m;
            count += 1;
        }
    }
    if count > FLOOR_SAMPLES { FLOOR_TRUST * sum_m / count as f64 } else { 0.0 }
}

/// Every second sample of the grid, so every fourth pixel: 80 x 60.
const SKIP: usize = 2;
/// Gauss-Newton needs three rounds for an error of 5 cm.
const ROUNDS: u32 = 6;
/// Larger residuals belong to other or moving objects. [m]
const GATE_M: f64 = 0.2;
/// Standard deviation of a splat's depth: constant part, and part per metre of range. [m]
const SIGMA_M: f64 = 0.006;
const SIGMA_RATIO: f64 = 0.006;
/// Standard deviation of brightness, and limit for outliers.
const GREY: f64 = 0.03;
const GREY_GATE: f64 = 0.2;
/// Correlation of neighbouring samples: this number of samples counts as one.
const CORRELATED: f64 = 20.0;
/// Standard deviation of the predicted position between two images. [m]
const MOTION_M: f64 = 0.03;
/// Standard deviation of the change of the attitude's error between two images. [rad]
const ATTITUDE_RAD: f64 = 0.002;
/// Fraction of the estimated error that is kept from image to image, because the attitude is right on average.
const STEADY: f64 = 0.995;
const MAX_TURN_RAD: f64 = 0.05;
const MAX_DT_S: f64 = 0.2;
/// Time constant of the velocity filter. [s]
const VELOCITY_LAG_S: f64 = 0.08;
const MAX_SPEED_MPS: f64 = 6.0;
/// The image becomes the next key if the overlap is smaller than this, after a turn of 14 degrees, or after 0.5 m.
const OVERLAP: f64 = 0.55;
const TURN_RAD: f64 = 0.25;
const REACH_M: f64 = 0.5;
const BIN_M: f64 = 0.02;
const FLOOR_SAMPLES: usize = 150;
/// Fraction of the floor's error that one image corrects.
const FLOOR_TRUST: f64 = 0.3;

#[cfg(test)]
mod tests;
