//! Tag families, and the black and white cells of each tag.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::ffi;

/// A set of tags that are told apart by their cells.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize,
)]
pub enum TagFamily {
    /// 587 tags of 36 bits, Hamming distance at least 11. Recommended.
    #[default]
    #[serde(rename = "tag36h11")]
    Tag36h11,
    /// 35 tags of 25 bits, Hamming distance 9: readable from further away, confused more often.
    #[serde(rename = "tag25h9")]
    Tag25h9,
    /// 30 tags of 16 bits, Hamming distance 5: often confused; for tests.
    #[serde(rename = "tag16h5")]
    Tag16h5,
    /// 2115 tags of 41 bits, Hamming distance 12; data also outside the border.
    #[serde(rename = "tagStandard41h12")]
    TagStandard41h12,
    /// 48714 tags of 52 bits, Hamming distance 13; data also outside the border.
    #[serde(rename = "tagStandard52h13")]
    TagStandard52h13,
}

impl TagFamily {
    pub const ALL: [Self; 5] = [
        Self::Tag36h11,
        Self::Tag25h9,
        Self::Tag16h5,
        Self::TagStandard41h12,
        Self::TagStandard52h13,
    ];

    /// Returns the name that files and the C library use.
    pub fn name(self) -> &'static str {
        match self {
            Self::Tag36h11 => "tag36h11",
            Self::Tag25h9 => "tag25h9",
            Self::Tag16h5 => "tag16h5",
            Self::TagStandard41h12 => "tagStandard41h12",
            Self::TagStandard52h13 => "tagStandard52h13",
        }
    }

    /// Returns the family of this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|family| family.name().eq_ignore_ascii_case(name))
    }

    /// Returns the number of tags; ids count up from 0.
    pub fn ids(self) -> u32 {
        ffi::ids(self)
    }

    /// Returns the cells of a tag; `None` if the family does not have this id.
    ///
    /// ```
    /// use vizflyt_tags::family::TagFamily;
    /// let cells = TagFamily::Tag36h11.cells(0).unwrap();
    /// // A white rim of one cell, then the black square of eight.
    /// assert_eq!((cells.across(), cells.border()), (10, 8));
    /// assert!(cells.is_white(0, 0) && !cells.is_white(1, 1));
    /// ```
    pub fn cells(self, id: u32) -> Option<Cells> {
        ffi::cells(self, id)
    }
}

impl fmt::Display for TagFamily {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Cells of an upright tag: column 0 on the left, row 0 on top.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Cells {
    across: u32,
    border: u32,
    white: Vec<bool>,
}

impl Cells {
    /// Makes a tag from rows of cells, `across` wide and high.
    ///
    /// # Panics
    /// If `white` does not have `across` x `across` cells.
    pub(crate) fn new(across: u32, border: u32, white: Vec<bool>) -> Self {
        assert_eq!(white.len(), (across * across) as usize);
        Self { across, border, white }
    }

    /// Returns the width and height of the printed tag [cells], with the white rim.
    pub fn across(&self) -> u32 {
        self.across
    }

    /// Returns the width of the detected square, in cells. Its corners are detected, and its edge is a layout's
    /// `size_m`. It is centred in the tag.
    pub fn border(&self) -> u32 {
        self.border
    }

    /// Returns whether a cell is white.
    ///
    /// # Panics
    /// If the cell is outside the tag.
    pub fn is_white(&self, column: u32, row: u32) -> bool {
        assert!(column < self.across && row < self.across);
        self.white[(row * self.across + column) as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn families_have_the_published_sizes() {
        let sizes = TagFamily::ALL.map(|family| {
            let cells = family.cells(0).unwrap();
            (family.ids(), cells.across(), cells.border())
        });
        assert_eq!(sizes, [(587, 10, 8), (35, 9, 7), (30, 8, 6), (2115, 9, 5), (48714, 10, 6)]);
        for family in TagFamily::ALL {
            assert!(family.cells(family.ids() - 1).is_some());
            assert!(family.cells(family.ids()).is_none());
            assert_eq!(TagFamily::from_name(family.name()), Some(family));
        }
    }

    #[test]
    fn tags_of_a_family_differ_in_every_rotation() {
        let family = TagFamily::Tag36h11;
        let turn = |cells: &Cells| {
            let n = cells.across();
            let white = (0..n * n).map(|i| cells.is_white(i / n, n - 1 - i % n)).collect();
            Cells::new(n, cells.border(), white)
        };
        let all: Vec<Cells> = (0..60).map(|id| family.cells(id).unwrap()).collect();
        for (i, one) in all.iter().enumerate() {
            let mut turned = one.clone();
            for quarter in 0..4 {
                for (j, other) in all.iter().enumerate() {
                    let apart = turned.white.iter().zip(&other.white).filter(|(a, b)| a != b);
                    let same = i == j && quarter == 0;
                    assert!(same || apart.count() >= 11, "{i} and {j}, {quarter} quarters");
                }
                turned = turn(&turned);
            }
        }
    }
}
