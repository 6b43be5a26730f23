//! Calibration boards and the positions of their corners.

use std::path::Path;

use glam::{DVec2, DVec3};

use super::Refused;
use crate::checkerboard::Checkerboard;
use crate::detection::Detection;
use crate::file::{self, FileError};
use crate::layout::TagLayout;

/// A calibration board.
#[derive(Clone, Debug, PartialEq)]
pub enum Board {
    /// Tags on a plane; a view may show some of them.
    Tags(TagLayout),
    /// A checkerboard; a view must show all of it.
    Checkerboard(Checkerboard),
}

impl From<TagLayout> for Board {
    fn from(layout: TagLayout) -> Self {
        Self::Tags(layout)
    }
}

impl From<Checkerboard> for Board {
    fn from(board: Checkerboard) -> Self {
        Self::Checkerboard(board)
    }
}

impl Board {
    /// Reads a board file: a layout of tags, or a `[checkerboard]`.
    ///
    /// # Errors
    /// As [`TagLayout::read`] and [`Checkerboard::read`].
    pub fn read(path: &Path) -> Result<Self, FileError> {
        file::read(path, |text| {
            let table: toml::Table = vizflyt_toml::parse(text)?;
            if table.contains_key("checkerboard") {
                return Checkerboard::parse(text).map(Self::Checkerboard);
            }
            TagLayout::parse(text).map(Self::Tags)
        })
    }

    pub(super) fn check(&self) -> Result<(), Refused> {
        let Self::Tags(layout) = self else { return Ok(()) };
        let flat = layout
            .tags
            .iter()
            .all(|tag| tag.position_m.z.abs() < 1e-6 && (tag.normal() - DVec3::Z).length() < 1e-6);
        if flat {
            return Ok(());
        }
        let why = "the board is not flat: its tags differ in height or direction".into();
        let add = vec!["calibrate with a board of `vizflyt tags print board`".into()];
        Err(Refused { why, add })
    }

    /// Returns the minimum number of corners of a view, for a stable homography.
    pub(super) fn least_corners(&self) -> usize {
        match self {
            Self::Tags(_) => 4 * MIN_TAGS,
            Self::Checkerboard(board) => board.count(),
        }
    }

    /// Returns the corners of the board's tags, on the board and in the image. [m, board] [px]
    pub(super) fn corners_of(&self, detections: &[Detection]) -> Vec<(DVec2, DVec2)> {
        let Self::Tags(layout) = self else { return Vec::new() };
        let known = detections.iter().filter_map(|detection| {
            let tag = layout.find(detection.family, detection.id)?;
            Some(tag.corners_m().map(DVec3::truncate).into_iter().zip(detection.corners_px))
        });
        known.flatten().collect()
    }

    /// Returns the corners of a checkerboard, on the board and in the image. [m, board] [px]
    pub(super) fn checkerboard(&self, corners_px: &[DVec2]) -> Vec<(DVec2, DVec2)> {
        let Self::Checkerboard(board) = self else { return Vec::new() };
        board.corners_m().into_iter().zip(corners_px.iter().copied()).collect()
    }
}

/// Minimum number of tags in a view.
const MIN_TAGS: usize = 4;
