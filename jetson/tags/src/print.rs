//! Tags on paper: cubes with fold marks, mats over several sheets, as a PDF and a layout; and checkerboards.
//!
//! ```text
//! Cube, Mat or Floor -> sheets of shapes in millimetres -> PDF
//!             -> TagLayout, as if everything were glued without a fault; a survey measures the rest
//! ```
//!
//! Printers scale. Every sheet carries a bar of [`BAR_MM`] to be measured with a ruler; what it
//! measures goes into `bar_mm`, and every size of the layout follows.

// Why: paper is sold, cut and measured in millimetres; lengths of sheets and shapes end in `_mm`.

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

/// What is printed, and where its tags then are.
#[derive(Clone, Debug, PartialEq)]
pub struct Printed {
    /// The sheets.
    pub sheets: Vec<Sheet>,
    /// The tags, measured as printed.
    pub layout: TagLayout,
}

/// Length that the scale bar has when the printer does not scale. [mm]
pub const BAR_MM: f64 = 100.0;

/// Why something cannot be printed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PrintError {
    /// It does not fit on the paper.
    #[error(
        "{what} of {size_mm:.0} mm does not fit on {paper}, which has room for {room_mm:.0} mm; take larger paper, or \
         make it smaller"
    )]
    TooLarge {
        /// A face, a tag with its gap.
        what: &'static str,
        /// How large. [mm]
        size_mm: f64,
        /// Which paper.
        paper: Paper,
        /// What fits. [mm]
        room_mm: f64,
    },
    /// The tag does not leave itself a white rim.
    #[error(
        "a tag of {size_mm:.1} mm needs {needed_mm:.1} mm with its white rim, but {what} has {room_mm:.1} mm"
    )]
    NoRim {
        /// A face, the distance from tag to tag.
        what: &'static str,
        /// Edge of the black square. [mm]
        size_mm: f64,
        /// With the rim. [mm]
        needed_mm: f64,
        /// What there is. [mm]
        room_mm: f64,
    },
    /// The family has not enough tags.
    #[error("{family} has ids 0 to {last}; {count} tags from id {first} on are too many")]
    Ids {
        /// Which family.
        family: TagFamily,
        /// Its last id.
        last: u32,
        /// The first asked for.
        first: u32,
        /// How many.
        count: u64,
    },
    /// A number that makes no sense.
    #[error("{name} = {value}: {advice}")]
    Invalid {
        /// The name.
        name: &'static str,
        /// What it is.
        value: f64,
        /// What to give.
        advice: &'static str,
    },
}

/// Checks that a family has these ids.
fn check_ids(family: TagFamily, first: u32, count: u64) -> Result<(), PrintError> {
    let ids = family.ids();
    if u64::from(first) + count > u64::from(ids) || count > TagLayout::MAX_TAGS as u64 {
        return Err(PrintError::Ids { family, last: ids - 1, first, count });
    }
    Ok(())
}

/// Checks that a tag and its white rim fit into this much.
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

/// Returns the scale of all lengths from a measured bar.
fn scale(bar_mm: f64) -> Result<f64, PrintError> {
    // Beyond 10 % the wrong thing was measured.
    if !(90.0..=110.0).contains(&bar_mm) {
        let advice = "measure the scale bar from its first mark to its last, in mm: 90 to 110";
        return Err(PrintError::Invalid { name: "bar_mm", value: bar_mm, advice });
    }
    Ok(bar_mm / BAR_MM)
}

/// Checks that a mat lies in a room. [m, world]
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
