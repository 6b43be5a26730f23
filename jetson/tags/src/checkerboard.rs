//! Checkerboards: file format, and detection of inner corners in an image.
//!
//! ```text
//! image -> corners where four squares meet (samples on a ring change twice between dark and bright)
//!       -> subpixel refinement (each gradient near a corner is perpendicular to the direction to the corner)
//!       -> grid: from corner to neighbour along edges, until no more are found
//!       -> columns x rows corners, the lower left first; or none
//! ```
//! The ring is from Bennett and Lasenby 2014, "ChESS - Quick and robust detection of chess-board features", section 3.
//! The image must show the whole board, because a part of it is ambiguous. Takes 50 ms for 1280 x 720.

mod corners;
mod grid;

use std::path::Path;

use glam::DVec2;
use serde::{Deserialize, Serialize};

use crate::file::{self, FileError, check_number, invalid};
use crate::image::Gray;

/// A checkerboard, described by its inner corners, where four squares meet.
///
/// ```
/// let text = "[checkerboard]\ncolumns = 9\nrows = 6\nsquare_m = 0.025\n";
/// let board = vizflyt_tags::checkerboard::Checkerboard::parse(text).unwrap();
/// assert_eq!(board.corners_m().len(), 54);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Checkerboard {
    /// Number of inner corners in a row: the number of squares minus one.
    pub columns: u32,
    /// Number of rows of inner corners.
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
    /// Parses a checkerboard from TOML.
    ///
    /// # Errors
    /// [`FileError::Toml`] if the text does not match the format, [`FileError::Invalid`] for a value out of range.
    pub fn parse(text: &str) -> Result<Self, FileError> {
        let CheckerboardFile { checkerboard } = vizflyt_toml::parse(text)?;
        checkerboard.validate()?;
        Ok(checkerboard)
    }

    /// Returns the checkerboard as TOML.
    ///
    /// # Errors
    /// [`FileError::Unwritable`], if a number is NaN.
    pub fn to_toml(&self) -> Result<String, FileError> {
        Ok(toml::to_string(&CheckerboardFile { checkerboard: *self })?)
    }

    /// Reads a checkerboard file.
    ///
    /// # Errors
    /// As [`Self::parse`], and [`FileError::Io`]; the error contains the path.
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

    /// Returns the number of inner corners.
    pub fn count(&self) -> usize {
        self.columns as usize * self.rows as usize
    }

    /// Returns the corners relative to the board's middle, x to the right and y up. The order is lower left first, then
    /// to the right, then up. [m, board]
    pub fn corners_m(&self) -> Vec<DVec2> {
        let middle = DVec2::new(f64::from(self.columns - 1), f64::from(self.rows - 1)) / 2.0;
        (0..self.rows)
            .flat_map(|row| {
                (0..self.columns).map(move |column| DVec2::new(column.into(), row.into()))
            })
            .map(|at| (at - middle) * self.square_m)
            .collect()
    }

    /// Returns the corners in an image, in the order of [`Self::corners_m`]; `None` unless all are found. If several
    /// orientations match, returns the one whose rows run most to the right in the image. [px]
    pub fn find(&self, image: &Gray) -> Option<Vec<DVec2>> {
        let found = corners::candidates(image);
        let grid = grid::grow(image, &found, self)?;
        let spacing_px = grid::least_spacing_px(&grid, self.columns as usize);
        let half_px = (0.3 * spacing_px).clamp(2.0, MAX_HALF_PX) as i32;
        grid.into_iter().map(|corner| corners::refine(image, corner, half_px)).collect()
    }

    /// Returns the numbers of inner corners, the smaller first, of a complete checkerboard in an image whose numbers
    /// differ from this one's.
    pub fn find_another(&self, image: &Gray) -> Option<(u32, u32)> {
        let own = (self.columns.min(self.rows), self.columns.max(self.rows));
        grid::count(image, &corners::candidates(image)).filter(|counted| *counted != own)
    }
}

/// Minimum number of corners in a direction, to distinguish a grid from clutter.
const MIN_CORNERS: u32 = 3;
/// Maximum number of corners in a direction, which a camera can still resolve.
const MAX_CORNERS: u32 = 100;
/// Maximum half width of the refinement window; further out the lens bends the edges. [px]
const MAX_HALF_PX: f64 = 8.0;

#[cfg(test)]
pub(crate) mod tests;
