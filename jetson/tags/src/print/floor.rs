//! A mat for flights with a camera under the vehicle. Large tags cover the area and are visible from above. Pads of
//! small tags lie where the vehicle stands, with its camera a hand's breadth above them.
//!
//! Each large tag has its own sheet. These sheets are laid out separately, and their positions are measured with a
//! tape. Pads are joined edge to edge, and replace the large tags at their position.

use glam::{DQuat, DVec2, DVec3};
use vizflyt_protocol::geometry::{Pose, World};

use super::sheet::{FOOT_MM, MARGIN_MM, Sheet};
use super::{Mat, Paper, PrintError, Printed, check_ids, check_middle, scale};
use crate::family::TagFamily;
use crate::layout::{LayoutFrame, Square, Tag, TagLayout};

/// Pad for take-off or landing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pad {
    /// Middle of the pad. [m, world]
    pub middle_m: DVec2,
    /// Minimum extent, east and north. [m]
    pub size_m: DVec2,
}

impl Pad {
    /// Size of a pad of two sheets side by side, for a vehicle that is placed by hand.
    pub const SIZE_M: DVec2 = DVec2::new(0.5, 0.35);
}

/// A mat with tags of two sizes, printed on A3.
#[derive(Clone, Debug, PartialEq)]
pub struct Floor {
    pub family: TagFamily,
    /// Id of the first large tag, in the south-west. Large tags count east, then north; the pads' small tags follow.
    pub first_id: u32,
    /// Extent of the flight area, east and north. [m]
    pub size_m: DVec2,
    /// Middle of the flight area. [m, world]
    pub middle_m: DVec3,
    /// Pads at which the vehicle stands.
    pub pads: Vec<Pad>,
    /// Measured length of the printed scale bar. [mm]
    pub bar_mm: f64,
}

impl Floor {
    /// Returns the sheets, those of the large tags first, and the layout.
    ///
    /// # Errors
    /// [`PrintError`] for values that do not fit or are out of range.
    pub fn print(&self) -> Result<Printed, PrintError> {
        let (least_m, most_m) = (self.size_m.min_element(), self.size_m.max_element());
        if !(least_m >= LARGE_PITCH_M && most_m <= MOST_M) {
            let advice = "give length and width in metres, 0.5 to 50 each: 11x4.5";
            return Err(PrintError::Invalid { name: "fly_over", value: least_m, advice });
        }
        check_middle(self.middle_m)?;
        let scale = scale(self.bar_mm)?;
        let large = self.large_m();
        check_ids(self.family, self.first_id, large.len() as u64)?;
        let mut sheets = Vec::new();
        let mut tags = Vec::new();
        for (id, at_m) in (self.first_id..).zip(large) {
            sheets.push(self.large_sheet(id, at_m));
            let pose: Pose<World, Square> =
                Pose::new(at_m.extend(self.middle_m.z), DQuat::IDENTITY);
            tags.push(Tag::new(self.family, id, 1e-3 * LARGE_MM * scale, pose));
        }
        for pad in &self.pads {
            let first_id = self.first_id + tags.len() as u32;
            let printed = self.pad(pad, first_id).print()?;
            sheets.extend(printed.sheets);
            tags.extend(printed.layout.tags);
        }
        Ok(Printed { sheets, layout: TagLayout { frame: LayoutFrame::World, tags } })
    }

    /// Returns the pads as mats with their ids in this floor.
    pub fn pads(&self) -> Vec<Mat> {
        let mut first_id = self.first_id + self.large_m().len() as u32;
        let mats = self.pads.iter().map(|pad| {
            let mat = self.pad(pad, first_id);
            first_id += mat.columns * mat.rows;
            mat
        });
        mats.collect()
    }

    fn pad(&self, pad: &Pad, first_id: u32) -> Mat {
        // Whole sheets only: a part of a sheet is as much work.
        let [across, up] = sheet_tags();
        let sheets = (pad.size_m * 1e3 / SMALL_PITCH_MM / DVec2::new(across.into(), up.into()))
            .round()
            .clamp(DVec2::ONE, DVec2::splat(1e3));
        Mat {
            family: self.family,
            first_id,
            columns: across * sheets.x as u32,
            rows: up * sheets.y as u32,
            pitch_mm: SMALL_PITCH_MM,
            tag_mm: SMALL_MM,
            middle_m: pad.middle_m.extend(self.middle_m.z),
            paper: Paper::A3,
            bar_mm: self.bar_mm,
        }
    }

    /// Returns the positions of the large tags: in rows and columns around the middle, except under pads. [m, world]
    fn large_m(&self) -> Vec<DVec2> {
        let count = (self.size_m / LARGE_PITCH_M + 1e-9).floor();
        let pads: Vec<(DVec2, DVec2)> = self
            .pads
            .iter()
            .map(|pad| {
                let mat = self.pad(pad, 0);
                let cells = DVec2::new(mat.columns.into(), mat.rows.into());
                (pad.middle_m, cells * SMALL_PITCH_MM * 5e-4)
            })
            .collect();
        let mut places = Vec::new();
        for row in 0..count.y as u32 {
            for column in 0..count.x as u32 {
                let cell = DVec2::new(column.into(), row.into()) - (count - 1.0) / 2.0;
                let at_m = self.middle_m.truncate() + cell * LARGE_PITCH_M;
                let covers = |&(middle_m, half_m): &(DVec2, DVec2)| {
                    let gap_m = (at_m - middle_m).abs() - half_m - 5e-4 * LARGE_PAPER_MM;
                    gap_m.max_element() < 0.0
                };
                if !pads.iter().any(covers) {
                    places.push(at_m);
                }
            }
        }
        places
    }

    fn large_sheet(&self, id: u32, at_m: DVec2) -> Sheet {
        let place = format!("tag {id}: {:.3} m east, {:.3} m north", at_m.x, at_m.y);
        let mut sheet = Sheet::new(Paper::A3, &place);
        let [left, low] = [MARGIN_MM, MARGIN_MM + FOOT_MM];
        let middle = [left + LARGE_PAPER_MM / 2.0, low + LARGE_PAPER_MM / 2.0];
        sheet.tag(self.family, id, middle, LARGE_MM);
        sheet.crop_marks([left, low, LARGE_PAPER_MM, LARGE_PAPER_MM]);
        let text = format!("{} {id}; cut along the marks; this edge is north", self.family);
        sheet.text([left + 8.0, low + LARGE_PAPER_MM + 1.5], 2.4, &text);
        sheet
    }
}

/// Returns the number of columns and rows of small tags on a sheet.
fn sheet_tags() -> [u32; 2] {
    Paper::A3.room_mm().map(|room_mm| (room_mm / SMALL_PITCH_MM) as u32)
}

/// Edge of a large tag: 20 px from a height of 2.7 m for a lens of 100 degrees at 640 px. [mm]
const LARGE_MM: f64 = 200.0;
/// Edge of a large tag with its white rim. [mm]
const LARGE_PAPER_MM: f64 = 255.0;
/// Spacing of large tags: from a height of 0.4 m, such a lens always sees one. [m]
const LARGE_PITCH_M: f64 = 0.5;
/// Edge of a small tag: from a height of 60 mm, such a lens sees one at any position and orientation on a pad. [mm]
const SMALL_MM: f64 = 42.0;
/// Spacing of small tags. [mm]
const SMALL_PITCH_MM: f64 = 53.0;
/// Maximum extent of a flight area. [m]
const MOST_M: f64 = 50.0;
