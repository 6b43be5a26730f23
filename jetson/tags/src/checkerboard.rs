//! A checkerboard: its file, and its inner corners in an image.
//!
//! ```text
//! image -> corners wherever four squares meet (a ring of samples changes twice between dark and bright)
//!       -> to a fraction of a pixel (every gradient around a corner is perpendicular to the way there)
//!       -> grid: from corner to neighbour along edges, until there are no more
//!       -> columns x rows of them, lower left first; or nothing
//! ```
//! The ring is that of Bennett and Lasenby 2014, "ChESS - Quick and robust detection of chess-board features", section
//! 3. The board must be in the image as a whole: a part of it is ambiguous. 50 ms for 1280 x 720.

mod corners;
mod grid;

use std::path::Path;

use glam::DVec2;
use serde::{Deserialize, Serialize};

use crate::file::{self, FileError, check_number, invalid};
use crate::image::Gray;

/// A checkerboard by its inner corners: those where four squares meet.
///
/// ```
/// let text = "[checkerboard]\ncolumns = 9\nrows = 6\nsquare_m = 0.025\n";
/// let board = vizflyt_tags::checkerboard::Checkerboard::parse(text).unwrap();
/// assert_eq!(board.corners_m().len(), 54);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Checkerboard {
    /// Inner corners side by side; one fewer than squares.
    pub columns: u32,
    /// Inner corners above one another.
    pub rows: u32,
    /// Edge of a square. [m]
    pub square_m: f64,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CheckerboardFile {
    checkerboard: Checkerboard,
}

impl Checkerboard {
    /// Reads it from TOML.
    ///
    /// # Errors
    /// [`FileError::Toml`] for what is none, [`FileError::Invalid`] for a value that cannot work.
    pub fn parse(text: &str) -> Result<Self, FileError> {
        let CheckerboardFile { checkerboard } = vizflyt_toml::parse(text)?;
        checkerboard.validate()?;
        Ok(checkerboard)
    }

    /// Returns it as TOML.
    ///
    /// # Errors
    /// [`FileError::Unwritable`], if a number is none.
    pub fn to_toml(&self) -> Result<String, FileError> {
        Ok(toml::to_string(&CheckerboardFile { checkerboard: *self })?)
    }

    /// Reads its file.
    ///
    /// # Errors
    /// As [`Self::parse`], and [`FileError::Io`]; the file is named.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        file::read(path, Self::parse)
    }

    fn validate(&self) -> Result<(), FileError> {
        for (key, count) in [("columns", self.columns), ("rows", self.rows)] {
            if !(MIN_CORNERS..=MAX_CORNERS).contains(&count) {
                let advice = format!(
                    "count the corners where four squares meet: {MIN_CORNERS} to {MAX_CORNERS}"
                );
                return Err(invalid(format!("checkerboard.{key}"), count, advice));
            }
        }
        check_number("checkerboard.square_m", self.square_m, "m", 0.002..=1.0)
    }

    /// Returns how many corners it has.
    pub fn count(&self) -> usize {
        self.columns as usize * self.rows as usize
    }

    /// Returns its corners from the board's middle, x to the right and y up: lower left first, then to the right, then
    /// up. [m, board]
    pub fn corners_m(&self) -> Vec<DVec2> {
        let middle = DVec2::new(f64::from(self.columns - 1), f64::from(self.rows - 1)) / 2.0;
        (0..self.rows)
            .flat_map(|row| {
                (0..self.columns).map(move |column| DVec2::new(column.into(), row.into()))
            })
            .map(|at| (at - middle) * self.square_m)
            .collect()
    }

    /// Returns where its corners are in an image, in the order of [`Self::corners_m`]; `None` unless all are there. Of
    /// the ways to hold it that look alike, the one whose columns run most to the right in the image. [px]
    pub fn find(&self, image: &Gray) -> Option<Vec<DVec2>> {
        let found = corners::candidates(image);
        let grid = grid::grow(image, &found, self)?;
        let spacing_px = grid::least_spacing_px(&grid, self.columns as usize);
        let half_px = (0.3 * spacing_px).clamp(2.0, MAX_HALF_PX) as i32;
        grid.into_iter().map(|corner| corners::refine(image, corner, half_px)).collect()
    }

    /// Returns the inner corners, the fewer first, of a whole checkerboard in an image that has other numbers of them
    /// than this one.
    pub fn find_another(&self, image: &Gray) -> Option<(u32, u32)> {
        let own = (self.columns.min(self.rows), self.columns.max(self.rows));
        grid::count(image, &corners::candidates(image)).filter(|counted| *counted != own)
    }
}

/// Fewer corners make no grid that can be distinguished from clutter.
const MIN_CORNERS: u32 = 3;
/// More are smaller than any camera sees.
const MAX_CORNERS: u32 = 100;
/// A corner is measured within so many pixels to each side; further out the lens bends its edges. [px]
const MAX_HALF_PX: f64 = 8.0;

#[cfg(test)]
pub(crate) mod tests;
