//! Printable tags as PDF and layout: cubes with fold marks, and mats over several sheets. Also checkerboards.
//!
//! ```text
//! Cube, Mat or Floor -> sheets of shapes in millimetres -> PDF
//!                    -> TagLayout of a perfect assembly; a survey measures the real one
//! ```
//!
//! Printers may scale. Each sheet has a scale bar of [`BAR_MM`]. Its length as measured with a ruler is the setting
//! `bar_mm`, which scales all sizes in the layout.

// Why: paper is sold, cut and measured in millimetres, so lengths of sheets and shapes end in `_mm`.

mod checkerboard;
mod cube;
mod floor;
mod mat;
mod pdf;
mod sheet;

pub use checkerboard::checkerboard;
pub use cube::{CUBE_FACES, Cube};
pub use floor::{Floor, Pad};
pub use mat::Mat;
pub use pdf::pdf;
pub use sheet::{Paper, Shape, Sheet};

use glam::DVec3;

use crate::family::TagFamily;
use crate::layout::TagLayout;

/// Printable sheets, and the layout of their tags.
#[derive(Clone, Debug, PartialEq)]
pub struct Printed {
    pub sheets: Vec<Sheet>,
    /// Tags in their printed size.
    pub layout: TagLayout,
}

/// Nominal length of the scale bar. [mm]
pub const BAR_MM: f64 = 100.0;

/// Why an object cannot be printed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PrintError {
    /// The object does not fit on the paper.
    #[error(
        "{what} of {size_mm:.0} mm does not fit on {paper}, which has room for {room_mm:.0} mm; take larger paper, or \
         make it smaller"
    )]
    TooLarge {
        /// Object: a face, or a tag with its gap.
        what: &'static str,
        /// Size of the object. [mm]
        size_mm: f64,
        paper: Paper,
        /// Available size. [mm]
        room_mm: f64,
    },
    /// The tag has no space for its white rim.
    #[error(
        "a tag of {size_mm:.1} mm needs {needed_mm:.1} mm with its white rim, but {what} has {room_mm:.1} mm"
    )]
    NoRim {
        /// Limiting object: a face, or the distance between tags.
        what: &'static str,
        /// Edge of the black square. [mm]
        size_mm: f64,
        /// Size with the rim. [mm]
        needed_mm: f64,
        /// Available size. [mm]
        room_mm: f64,
    },
    /// The family has too few tags.
    #[error("{family} has ids 0 to {last}; {count} tags from id {first} on are too many")]
    Ids {
        family: TagFamily,
        /// Last id of the family.
        last: u32,
        /// First requested id.
        first: u32,
        /// Number of requested tags.
        count: u64,
    },
    /// A number out of range.
    #[error("{name} = {value}: {advice}")]
    Invalid {
        /// Name of the setting.
        name: &'static str,
        /// Value of the setting.
        value: f64,
        /// Correction.
        advice: &'static str,
    },
}

/// Checks that a family contains these ids.
fn check_ids(family: TagFamily, first: u32, count: u64) -> Result<(), PrintError> {
    let ids = family.ids();
    if u64::from(first) + count > u64::from(ids) || count > TagLayout::MAX_TAGS as u64 {
        return Err(PrintError::Ids { family, last: ids - 1, first, count });
    }
    Ok(())
}

/// Checks that a tag with its white rim fits into `room_mm`.
fn check_rim(
    family: TagFamily,
    what: &'static str,
    size_mm: f64,
    room_mm: f64,
) -> Result<(), PrintError> {
    let Some(cells) = family.cells(0) else { return Ok(()) };
    let needed_mm = size_mm * f64::from(cells.across()) / f64::from(cells.border());
    if !(needed_mm <= room_mm + 1e-9) {
        return Err(PrintError::NoRim { what, size_mm, needed_mm, room_mm });
    }
    Ok(())
}

/// Returns the scale of all lengths from the measured scale bar.
fn scale(bar_mm: f64) -> Result<f64, PrintError> {
    // A deviation of more than 10 % is a measurement of another length.
    if !(90.0..=110.0).contains(&bar_mm) {
        let advice = "measure the scale bar from its first mark to its last, in mm: 90 to 110";
        return Err(PrintError::Invalid { name: "bar_mm", value: bar_mm, advice });
    }
    Ok(bar_mm / BAR_MM)
}

/// Checks that the middle of a mat is within a room. [m, world]
fn check_middle(middle_m: DVec3) -> Result<(), PrintError> {
    if !(middle_m.is_finite() && middle_m.abs().max_element() <= 900.0) {
        let (name, value) = ("middle_m", middle_m.length());
        return Err(PrintError::Invalid { name, value, advice: "give metres within the room" });
    }
    Ok(())
}

fn check_positive(name: &'static str, value_mm: f64) -> Result<(), PrintError> {
    if !(5.0..=1000.0).contains(&value_mm) {
        let advice = "give 5 to 1000 mm";
        return Err(PrintError::Invalid { name, value: value_mm, advice });
    }
    Ok(())
}

#[cfg(test)]
mod tests;
