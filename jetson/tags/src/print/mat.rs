//! A mat of tags on the floor or a wall, over one or more sheets; and the calibration board, a mat on one sheet.

use glam::{DQuat, DVec3};
use vizflyt_protocol::geometry::{Pose, World};

use super::sheet::{FOOT_MM, MARGIN_MM, Sheet};
use super::{
    Paper, PrintError, Printed, check_ids, check_middle, check_positive, check_rim, scale,
};
use crate::family::TagFamily;
use crate::layout::{LayoutFrame, Square, Tag, TagLayout};

/// A flat grid of tags: columns to the east, rows to the north, the middle at `middle_m`.
#[derive(Clone, Debug, PartialEq)]
pub struct Mat {
    pub family: TagFamily,
    /// Id of the lower left tag; ids count to the right, then up.
    pub first_id: u32,
    /// Number of columns.
    pub columns: u32,
    /// Number of rows.
    pub rows: u32,
    /// Spacing between the middles of neighbouring tags. [mm]
    pub pitch_mm: f64,
    /// Edge of a tag's black square. [mm]
    pub tag_mm: f64,
    /// Middle of the grid. [m, world]
    pub middle_m: DVec3,
    pub paper: Paper,
    /// Measured length of the printed scale bar. [mm]
    pub bar_mm: f64,
}

impl Mat {
    /// Returns the calibration board: as many tags of this size as fit on one sheet, starting with `first_id`. Their
    /// gap is half a white cell more than required.
    ///
    /// # Errors
    /// [`PrintError`] for values that do not fit or are out of range.
    pub fn board(
        family: TagFamily,
        first_id: u32,
        tag_mm: f64,
        paper: Paper,
        bar_mm: f64,
    ) -> Result<Self, PrintError> {
        check_positive("tag_mm", tag_mm)?;
        let needed = family
            .cells(0)
            .map_or(1.25, |cells| (f64::from(cells.across()) + 0.5) / f64::from(cells.border()));
        let pitch_mm = tag_mm * needed;
        let [width, height] = paper.room_mm();
        let (columns, rows) = ((width / pitch_mm) as u32, (height / pitch_mm) as u32);
        if columns == 0 || rows == 0 {
            let (what, room_mm) = ("a tag with its rim", width);
            return Err(PrintError::TooLarge { what, size_mm: pitch_mm, paper, room_mm });
        }
        let middle_m = DVec3::ZERO;
        Ok(Self { family, first_id, columns, rows, pitch_mm, tag_mm, middle_m, paper, bar_mm })
    }

    /// Returns the mat to survey webcams in the upper corners of a hall, placed in its middle, and the size of its tags
    /// in the image [px]. It has two by four tags, large enough for these webcams, but at most as large as A3 allows.
    ///
    /// # Errors
    /// [`PrintError::Invalid`] for an invalid hall size.
    pub fn for_hall(
        hall_m: DVec3,
        family: TagFamily,
        first_id: u32,
        middle_m: DVec3,
        bar_mm: f64,
    ) -> Result<(Self, f64), PrintError> {
        if !(hall_m.cmpge(DVec3::ONE).all() && hall_m.cmple(DVec3::splat(100.0)).all()) {
            let (name, value) = ("for_hall", hall_m.max_element());
            let advice = "give length, width and height in metres, 1 to 100 each: 11x4.5x3.65";
            return Err(PrintError::Invalid { name, value, advice });
        }
        let away_m = (hall_m * DVec3::new(0.5, 0.5, 1.0)).length();
        let wanted_mm = 1e3 * WELL_SEEN_PX * away_m / WEBCAM_FOCAL_PX;
        // Rounded up to whole centimetres.
        let tag_mm = ((wanted_mm / 10.0).ceil() * 10.0).clamp(70.0, A3_TAG_MM);
        let mat = Self {
            family,
            first_id,
            columns: 2,
            rows: 4,
            pitch_mm: HALL_PITCH * tag_mm,
            tag_mm,
            middle_m,
            paper: if tag_mm > A4_TAG_MM { Paper::A3 } else { Paper::A4 },
            bar_mm,
        };
        Ok((mat, 1e-3 * tag_mm / away_m * WEBCAM_FOCAL_PX))
    }

    /// Returns the sheets, row by row from the lower left, and the layout.
    ///
    /// # Errors
    /// [`PrintError`] for values that do not fit or are out of range.
    pub fn print(&self) -> Result<Printed, PrintError> {
        check_positive("pitch_mm", self.pitch_mm)?;
        check_positive("tag_mm", self.tag_mm)?;
        if self.columns == 0 || self.rows == 0 {
            let advice = "give 1 or more";
            return Err(PrintError::Invalid { name: "columns, rows", value: 0.0, advice });
        }
        check_middle(self.middle_m)?;
        let count = u64::from(self.columns) * u64::from(self.rows);
        check_ids(self.family, self.first_id, count)?;
        check_rim(self.family, "the distance from tag to tag", self.tag_mm, self.pitch_mm)?;
        let scale = scale(self.bar_mm)?;
        let [width, height] = self.paper.room_mm();
        // Complete tags on each sheet.
        let (across, up) = ((width / self.pitch_mm) as u32, (height / self.pitch_mm) as u32);
        if across == 0 || up == 0 {
            let (what, size_mm, room_mm) = ("a tag with its gap", self.pitch_mm, width.min(height));
            return Err(PrintError::TooLarge { what, size_mm, paper: self.paper, room_mm });
        }
        let (sheets_across, sheets_up) = (self.columns.div_ceil(across), self.rows.div_ceil(up));
        let mut sheets = Vec::new();
        for sheet_row in 0..sheets_up {
            for sheet_column in 0..sheets_across {
                let column = sheet_column * across;
                let row = sheet_row * up;
                let title = format!(
                    "row {} of {sheets_up}, column {} of {sheets_across}",
                    sheet_row + 1,
                    sheet_column + 1
                );
                let mut sheet = Sheet::new(self.paper, &title);
                let columns = across.min(self.columns - column);
                let rows = up.min(self.rows - row);
                self.draw(&mut sheet, [column, row], [columns, rows]);
                sheets.push(sheet);
            }
        }
        Ok(Printed { sheets, layout: self.layout(scale) })
    }

    fn draw(&self, sheet: &mut Sheet, first: [u32; 2], count: [u32; 2]) {
        let [left, low] = [MARGIN_MM, MARGIN_MM + FOOT_MM];
        for row in 0..count[1] {
            for column in 0..count[0] {
                let at = |i: u32| (f64::from(i) + 0.5) * self.pitch_mm;
                let id = self.id(first[0] + column, first[1] + row);
                sheet.tag(self.family, id, [left + at(column), low + at(row)], self.tag_mm);
            }
        }
        let [width, height] = count.map(|n| f64::from(n) * self.pitch_mm);
        sheet.crop_marks([left, low, width, height]);
        let text = self.caption(first, count);
        let top = (low + height + 1.5).min(self.paper.size_mm()[1] - 4.0);
        sheet.text([left + 8.0, top], 2.4, &text);
    }

    /// Returns the caption at a sheet's upper edge, short enough to fit between the marks.
    fn caption(&self, first: [u32; 2], count: [u32; 2]) -> String {
        let row =
            |row: u32| [first[0], first[0] + count[0] - 1].map(|c| self.id(c, first[1] + row));
        let [[from, to], [last_from, last]] = [row(0), row(count[1] - 1)];
        let ids = if count[0] == self.columns || count[1] == 1 {
            // Consecutive ids over all rows.
            format!("{from} to {last}")
        } else {
            format!("{from} to {to}, ..., {last_from} to {last}")
        };
        let join = if count == [self.columns, self.rows] {
            ""
        } else {
            " cut along the marks, join edge to edge;"
        };
        format!("{} {ids};{join} this edge is north", self.family)
    }

    fn id(&self, column: u32, row: u32) -> u32 {
        self.first_id + row * self.columns + column
    }

    fn layout(&self, scale: f64) -> TagLayout {
        let mut tags = Vec::new();
        for row in 0..self.rows {
            for column in 0..self.columns {
                // Offset from the grid's middle.
                let along = |i: u32, n: u32| {
                    (f64::from(i) - (f64::from(n) - 1.0) / 2.0) * self.pitch_mm * scale / 1000.0
                };
                let offset = DVec3::new(along(column, self.columns), along(row, self.rows), 0.0);
                let pose: Pose<World, Square> = Pose::new(self.middle_m + offset, DQuat::IDENTITY);
                let size_m = self.tag_mm * scale / 1000.0;
                tags.push(Tag::new(self.family, self.id(column, row), size_m, pose));
            }
        }
        TagLayout { frame: LayoutFrame::World, tags }
    }
}

/// Tag size in the image for the survey: tags on the floor are seen at an angle, and are readable from 20 px. [px]
const WELL_SEEN_PX: f64 = 25.0;
/// Focal length of a webcam of 70 degrees at 1280 x 720. [px]
const WEBCAM_FOCAL_PX: f64 = 900.0;
/// Spacing of tags relative to their edge: white rims, and a margin for cutting.
const HALL_PITCH: f64 = 1.375;
/// Largest tags of which one fits on a sheet at this spacing. [mm]
const A3_TAG_MM: f64 = 200.0;
const A4_TAG_MM: f64 = 130.0;
