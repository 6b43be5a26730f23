//! A vertical obstacle with an opening, a window's frame or a wall, as a grid of solid and free cells.
//!
//! Each image shows for each cell either a surface or free space behind the cell. Free cells with the frame around them
//! are an opening. The vehicle flies through the point with the largest distance from everything solid, so an unknown
//! shape works as well as a square.

use std::ops::Range;

use vizflyt_sdk::glam::{DVec2, DVec3};

use crate::color_class::ColorClass;
use crate::sampling::{PixelGrid, Sample};

/// Kind of an obstacle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ObstacleKind {
    /// A frame of bars of this colour.
    Window(ColorClass),
    /// A wall with a gap.
    Wall,
}

impl ObstacleKind {
    /// Returns a name for messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Window(ColorClass::Red) => "the red window",
            Self::Window(ColorClass::Blue) => "the blue window",
            Self::Window(ColorClass::Magenta) => "the magenta window",
            Self::Window(ColorClass::Orange) => "the window with the hand",
            Self::Window(ColorClass::Teal) => "a teal window",
            Self::Wall => "the gap",
        }
    }
}

/// A vertical plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// Point of the plane; its z is not used. [m, home]
    pub origin_m: DVec3,
    /// Direction of passage: angle of the normal from home x. [rad]
    pub yaw_rad: f64,
}

impl Plane {
    /// Returns the direction of passage. [home]
    pub fn normal(&self) -> DVec3 {
        DVec2::from_angle(self.yaw_rad).extend(0.0)
    }

    /// Returns the horizontal direction in the plane, to the left in the direction of passage. [home]
    pub fn left(&self) -> DVec3 {
        DVec3::Z.cross(self.normal())
    }

    /// Returns the distance of a point behind the plane; negative in front of it. [m]
    pub fn behind_m(&self, p_m: DVec3) -> f64 {
        self.normal().dot(p_m - self.origin_m)
    }

    /// Returns the coordinates of a point in the plane: left of the origin, and up from the floor. [m]
    pub fn within_m(&self, p_m: DVec3) -> DVec2 {
        DVec2::new(self.left().dot(p_m - self.origin_m), p_m.z)
    }

    /// Returns the point with these coordinates in the plane. [m, home]
    pub fn point_m(&self, within_m: DVec2) -> DVec3 {
        self.origin_m.with_z(within_m.y) + self.left() * within_m.x
    }
}

/// State of one cell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Cell {
    /// Seen through (negative) or surface (positive); recent images count most.
    evidence: i8,
    /// Number of surface samples with the colour of the window's bars.
    colored: u8,
}

impl Cell {
    /// Returns whether the cell is solid.
    pub fn is_solid(self) -> bool {
        self.evidence >= SURE
    }

    /// Returns whether the cell is free.
    pub fn is_open(self) -> bool {
        self.evidence <= -SURE
    }

    fn is_bar(self) -> bool {
        self.is_solid() && self.colored >= 2
    }

    fn meet(&mut self, colored: bool) {
        self.evidence = (self.evidence + 1).min(MAX_EVIDENCE);
        self.colored = self.colored.saturating_add(u8::from(colored));
    }

    fn look_through(&mut self) {
        self.evidence = (self.evidence - 1).max(-MAX_EVIDENCE);
    }
}

/// A place to fly through.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Opening {
    /// Point to pass. [m, home]
    pub center_m: DVec3,
    /// Radius of free space around it. [m]
    pub radius_m: f64,
}

/// An obstacle and its observed cells.
#[derive(Clone, Debug)]
pub struct PlanarObstacle {
    /// Kind of the obstacle.
    pub kind: ObstacleKind,
    /// Plane of the obstacle.
    pub plane: Plane,
    /// Range from which the plane was measured. [m]
    pub range_m: f64,
    /// Best place to pass, if one is known.
    pub opening: Option<Opening>,
    /// Time of creation or of the last observation, on the clock of [`Self::update`]. [s]
    pub seen_s: f64,
    cells: Vec<Cell>,
    room_m: Vec<f32>,
}

impl PlanarObstacle {
    /// Creates an obstacle without observations.
    pub fn new(kind: ObstacleKind, plane: Plane, range_m: f64, now_s: f64) -> Self {
        let cells = vec![Cell::default(); COLUMNS * ROWS];
        Self {
            kind,
            plane,
            range_m,
            opening: None,
            seen_s: now_s,
            cells,
            room_m: vec![0.0; COLUMNS * ROWS],
        }
    }

    /// Moves the plane to a measurement from a shorter range. If the plane moves, the cells are cleared.
    pub fn settle(&mut self, plane: Plane, range_m: f64) {
        let moved_m = self.plane.behind_m(plane.origin_m).abs();
        let turned_rad = (self.plane.yaw_rad - plane.yaw_rad).abs();
        if range_m > SETTLE_FROM_M
            && range_m < SETTLE_SHARE * self.range_m
            && (moved_m > 0.03 || turned_rad > 0.04)
        {
            self.plane = Plane {
                // Keep the position along the plane, so that the grid covers the same area.
                origin_m: self.plane.origin_m
                    + plane.normal() * plane.behind_m(self.plane.origin_m) * -1.0,
                yaw_rad: plane.yaw_rad,
            };
            self.cells.fill(Cell::default());
            self.range_m = range_m;
        }
    }

    /// Processes an image seen from `camera_m` [m, home].
    pub fn update(&mut self, now_s: f64, camera_m: DVec3, grid: &PixelGrid) {
        let before_m = -self.plane.behind_m(camera_m);
        if before_m < TOO_NEAR_M {
            return;
        }
        let (normal, left) = (self.plane.normal(), self.plane.left());
        let own_left_m = left.dot(camera_m - self.plane.origin_m);
        // Ignore the hand: moving samples carry no information on static cells.
        let still = |sample: &&Sample| sample.is_seen() && sample.color != Some(ColorClass::Teal);
        for sample in grid.samples.iter().filter(still) {
            let depth_m = normal.dot(sample.offset_m);
            let deeper_m = depth_m - before_m;
            if deeper_m < -THICK_M || depth_m < 0.05 {
                continue;
            }
            let met = deeper_m <= THICK_M;
            if !met && deeper_m < THROUGH_M {
                continue;
            }
            // Intersection of the ray with the plane; for a surface near the plane, the surface itself.
            let share = if met { 1.0 } else { before_m / depth_m };
            let across_m = own_left_m + left.dot(sample.offset_m) * share;
            let up_m = camera_m.z + sample.offset_m.z * share;
            let Some(at) = index_of(DVec2::new(across_m, up_m)) else { continue };
            if met {
                self.cells[at].meet(
                    sample.color.is_some_and(|color| self.kind == ObstacleKind::Window(color)),
                );
                self.seen_s = now_s;
            } else {
                self.cells[at].look_through();
            }
        }
        if before_m > KNOWN_M {
            self.find_opening();
        }
    }

    /// Returns the cell at a point of the plane.
    pub fn cell(&self, within_m: DVec2) -> Option<Cell> {
        index_of(within_m).map(|at| self.cells[at])
    }

    /// Returns the nearest solid point within `reach_m` of a point. [m, home]
    pub fn nearest_solid_m(&self, p_m: DVec3, reach_m: f64) -> Option<DVec3> {
        let behind_m = self.plane.behind_m(p_m);
        if behind_m.abs() > reach_m {
            return None;
        }
        let within_m = self.plane.within_m(p_m);
        let mut best: Option<(f64, DVec2)> = None;
        for row in span(within_m.y / CELL_M, reach_m, ROWS) {
            for column in span((within_m.x + HALF_M) / CELL_M, reach_m, COLUMNS) {
                let cell = self.cells[row * COLUMNS + column];
                if !cell.is_solid() {
                    continue;
                }
                let at_m = place_of(column, row);
                let apart_m = at_m.distance(within_m);
                if best.is_none_or(|(least_m, _)| apart_m < least_m) {
                    best = Some((apart_m, at_m));
                }
            }
        }
        best.filter(|(apart_m, _)| apart_m.hypot(behind_m) < reach_m)
            .map(|(_, at_m)| self.plane.point_m(at_m))
    }

    /// Returns the hand's points in an image seen from `camera_m` [m, home]. [m, plane]
    pub fn hand_m(&self, camera_m: DVec3, grid: &PixelGrid) -> Vec<DVec2> {
        let teal = |sample: &&Sample| sample.color == Some(ColorClass::Teal) && sample.is_seen();
        let points_m = grid.samples.iter().filter(teal).map(|sample| camera_m + sample.offset_m);
        points_m
            .filter(|p_m| self.plane.behind_m(*p_m).abs() < HAND_M)
            .map(|p_m| self.plane.within_m(p_m))
            .collect()
    }

    fn find_opening(&mut self) {
        self.measure_room();
        // The framed cell with the largest distance to everything solid.
        let mut best: Option<(f32, usize)> = None;
        for row in 0..ROWS {
            for column in 0..COLUMNS {
                let at = row * COLUMNS + column;
                let room_m = self.room_m[at];
                if room_m > MIN_M
                    && best.is_none_or(|(most_m, _)| room_m > most_m)
                    && self.is_framed(column, row)
                {
                    best = Some((room_m, at));
                }
            }
        }
        let Some((room_m, at)) = best else {
            // Keep the last opening, visible or not, until its cell is solid.
            let is_solid = |opening: &Opening| {
                self.cell(self.plane.within_m(opening.center_m)).is_some_and(Cell::is_solid)
            };
            self.opening = self.opening.filter(|opening| !is_solid(opening));
            return;
        };
        // The mean of all cells that are nearly as good, because a long opening has a line of best cells.
        let top = place_of(at % COLUMNS, at / COLUMNS);
        let (mut sum_m, mut count) = (DVec2::ZERO, 0.0);
        for (near, &near_room_m) in self.room_m.iter().enumerate() {
            let place_m = place_of(near % COLUMNS, near / COLUMNS);
            if near_room_m > 0.93 * room_m && place_m.distance(top) < 0.3 {
                sum_m += place_m;
                count += 1.0;
            }
        }
        let center_m = self.plane.point_m(sum_m / count);
        self.opening = Some(Opening { center_m, radius_m: f64::from(room_m) });
    }

    /// Fills `room_m` with the distance from each free cell to the nearest cell that is not free, by two sweeps over
    /// the neighbours (chamfer distance: at most 4 % too small).
    fn measure_room(&mut self) {
        let (straight, diagonal) = (CELL_M as f32 * 0.96, CELL_M as f32 * 1.36);
        for (room_m, cell) in self.room_m.iter_mut().zip(&self.cells) {
            *room_m = if cell.is_open() { f32::MAX } else { 0.0 };
        }
        let room_m = &mut self.room_m;
        let mut relax = |at: usize, beside: [(usize, f32); 4]| {
            for (other, step_m) in beside {
                room_m[at] = room_m[at].min(room_m[other] + step_m);
            }
        };
        let edge = |row: usize, column: usize| {
            row == 0 || column == 0 || row == ROWS - 1 || column == COLUMNS - 1
        };
        for row in 0..ROWS {
            for column in 0..COLUMNS {
                let at = row * COLUMNS + column;
                if edge(row, column) {
                    relax(at, [(at, 0.0); 4]);
                    continue;
                }
                relax(
                    at,
                    [
                        (at - 1, straight),
                        (at - COLUMNS, straight),
                        (at - COLUMNS - 1, diagonal),
                        (at - COLUMNS + 1, diagonal),
                    ],
                );
            }
        }
        for row in (1..ROWS - 1).rev() {
            for column in (1..COLUMNS - 1).rev() {
                let at = row * COLUMNS + column;
                relax(
                    at,
                    [
                        (at + 1, straight),
                        (at + COLUMNS, straight),
                        (at + COLUMNS + 1, diagonal),
                        (at + COLUMNS - 1, diagonal),
                    ],
                );
            }
        }
    }

    /// Returns whether the frame surrounds a cell: solid cells on both sides and above or below, in a window with its
    /// colour. The space between a window's legs is not framed.
    fn is_framed(&self, column: usize, row: usize) -> bool {
        let look = |along: &mut dyn Iterator<Item = usize>| self.is_met(along);
        let sides = look(&mut (0..column).rev().map(|c| row * COLUMNS + c))
            && look(&mut (column + 1..COLUMNS).map(|c| row * COLUMNS + c));
        if !sides {
            return false;
        }
        let below = look(&mut (0..row).rev().map(|r| r * COLUMNS + column));
        let above = look(&mut (row + 1..ROWS).map(|r| r * COLUMNS + column));
        match self.kind {
            ObstacleKind::Window(_) => below || above,
            ObstacleKind::Wall => below && above,
        }
    }

    /// Returns whether a line of cells meets the frame.
    fn is_met(&self, along: &mut dyn Iterator<Item = usize>) -> bool {
        let along = along.take(REACH).skip_while(|&at| !self.cells[at].is_solid());
        match self.kind {
            ObstacleKind::Window(_) => along.take(BAR).any(|at| self.cells[at].is_bar()),
            ObstacleKind::Wall => {
                along.take(BAR).filter(|&at| self.cells[at].is_solid()).count() >= 2
            }
        }
    }
}

fn index_of(within_m: DVec2) -> Option<usize> {
    let (x, y) = ((within_m.x + HALF_M) / CELL_M, within_m.y / CELL_M);
    let inside = x >= 0.0 && y >= 0.0 && x < COLUMNS as f64 && y < ROWS as f64;
    inside.then(|| y as usize * COLUMNS + x as usize)
}

fn place_of(column: usize, row: usize) -> DVec2 {
    DVec2::new((column as f64 + 0.5) * CELL_M - HALF_M, (row as f64 + 0.5) * CELL_M)
}

fn span(at: f64, reach_m: f64, count: usize) -> Range<usize> {
    let reach = reach_m / CELL_M + 1.0;
    let low = (at - reach).max(0.0) as usize;
    low..((at + reach).max(0.0) as usize).min(count)
}

/// Side of a cell: a quarter of a bar's width. [m]
pub const CELL_M: f64 = 0.04;
const COLUMNS: usize = 120;
const ROWS: usize = 84;
/// Half of the grid's width: all of the net's 4.5 m. [m]
const HALF_M: f64 = 0.5 * CELL_M * COLUMNS as f64;
/// Maximum distance of a surface from the plane: half of a bar's thickness plus the odometry's error. [m]
const THICK_M: f64 = 0.1;
/// A ray that ends this far behind the plane has passed through it: more than a wall's thickness and the blur of its
/// edge. [m]
const THROUGH_M: f64 = 0.25;
/// At a smaller distance, the rays graze the bars. [m]
const TOO_NEAR_M: f64 = 0.25;
/// Evidence that makes a cell solid or free, and its limit.
const SURE: i8 = 2;
const MAX_EVIDENCE: i8 = 5;
/// Maximum distance of the hand from its window's plane. [m]
const HAND_M: f64 = 0.25;
/// At a smaller distance, the frame is outside the image. [m]
const SETTLE_FROM_M: f64 = 0.9;
/// At a smaller distance, the opening is not recomputed. [m]
const KNOWN_M: f64 = 0.6;
/// A new plane must be measured from at most this fraction of the previous range.
const SETTLE_SHARE: f64 = 0.8;
/// Radius of the vehicle plus a margin. [m]
const MIN_M: f32 = 0.2;
/// Maximum distance from the middle to the frame: 1.6 m. [cells]
const REACH: usize = 40;
/// Width of a bar plus one cell. [cells]
const BAR: usize = 5;

#[cfg(test)]
mod tests;
