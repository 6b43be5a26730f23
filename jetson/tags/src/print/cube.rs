//! Cube of tags on the vehicle.

use glam::{DMat3, DQuat, DVec3};
use vizflyt_protocol::geometry::{Body, Pose};

use super::sheet::{FOOT_MM, MARGIN_MM, Sheet};
use super::{Paper, PrintError, Printed, check_ids, check_positive, check_rim, scale};
use crate::family::TagFamily;
use crate::layout::{LayoutFrame, Square, Tag, TagLayout};

/// A cube of tags on the vehicle, with faces along the body's axes.
#[derive(Clone, Debug, PartialEq)]
pub struct Cube {
    pub family: TagFamily,
    /// Id of the front face; the other faces follow in the order of [`CUBE_FACES`].
    pub first_id: u32,
    /// Number of faces, 1 to 6; 5 omits the bottom.
    pub faces: u32,
    /// Edge of the cube. [mm]
    pub face_mm: f64,
    /// Edge of a tag's black square. [mm]
    pub tag_mm: f64,
    /// Middle of the cube. [m, body]
    pub middle_m: DVec3,
    pub paper: Paper,
    /// Measured length of the printed scale bar. [mm]
    pub bar_mm: f64,
}

/// Name of each face, its normal, and the direction of its tag's upper edge. [body]
pub const CUBE_FACES: [(&str, DVec3, DVec3); 6] = [
    ("front", DVec3::X, DVec3::Z),
    ("left", DVec3::Y, DVec3::Z),
    ("back", DVec3::NEG_X, DVec3::Z),
    ("right", DVec3::NEG_Y, DVec3::Z),
    ("top", DVec3::Z, DVec3::X),
    ("bottom", DVec3::NEG_Z, DVec3::X),
];

impl Cube {
    /// Returns the sheets and the layout.
    ///
    /// # Errors
    /// [`PrintError`] for values that do not fit or are out of range.
    pub fn print(&self) -> Result<Printed, PrintError> {
        check_positive("face_mm", self.face_mm)?;
        check_positive("tag_mm", self.tag_mm)?;
        if !(1..=6).contains(&self.faces) {
            let value = f64::from(self.faces);
            return Err(PrintError::Invalid { name: "faces", value, advice: "give 1 to 6" });
        }
        if !(self.middle_m.is_finite() && self.middle_m.abs().max_element() <= 2.0) {
            let advice = "the cube's middle lies within 2 m of the body's";
            return Err(PrintError::Invalid {
                name: "middle_m",
                value: self.middle_m.length(),
                advice,
            });
        }
        check_ids(self.family, self.first_id, self.faces.into())?;
        check_rim(self.family, "a face", self.tag_mm, self.face_mm)?;
        let scale = scale(self.bar_mm)?;
        let pitch = self.face_mm + 2.0 * FLAP_MM;
        let [width, height] = self.paper.room_mm();
        if pitch > width.min(height) {
            let room_mm = width.min(height) - 2.0 * FLAP_MM;
            let (what, size_mm) = ("a cube's face", self.face_mm);
            return Err(PrintError::TooLarge { what, size_mm, paper: self.paper, room_mm });
        }
        let columns = (width / pitch) as u32;
        let per_sheet = columns * (height / pitch) as u32;
        let mut sheets: Vec<Sheet> = Vec::new();
        for index in 0..self.faces {
            let place = index % per_sheet;
            if place == 0 {
                let number = index / per_sheet + 1;
                let of = self.faces.div_ceil(per_sheet);
                let title = format!("cube of {:.0} mm, sheet {number} of {of}", self.face_mm);
                sheets.push(Sheet::new(self.paper, &title));
            }
            let Some(sheet) = sheets.last_mut() else { break };
            let left = MARGIN_MM + FLAP_MM + pitch * f64::from(place % columns);
            let low = MARGIN_MM + FOOT_MM + FLAP_MM + pitch * f64::from(place / columns);
            self.draw_face(sheet, index, [left, low]);
        }
        let tags = (0..self.faces)
            .map(|index| {
                let (_, out, up) = CUBE_FACES[index as usize];
                let axes = DMat3::from_cols(up.cross(out), up, out);
                let middle_m = self.middle_m + out * (self.face_mm * scale / 2000.0);
                let pose: Pose<Body, Square> =
                    Pose::new(middle_m, DQuat::from_mat3(&axes).normalize());
                Tag::new(self.family, self.first_id + index, self.tag_mm * scale / 1000.0, pose)
            })
            .collect();
        Ok(Printed { sheets, layout: TagLayout { frame: LayoutFrame::Body, tags } })
    }

    fn draw_face(&self, sheet: &mut Sheet, index: u32, [left, low]: [f64; 2]) {
        let (right, top) = (left + self.face_mm, low + self.face_mm);
        let id = self.first_id + index;
        let middle = [f64::midpoint(left, right), f64::midpoint(low, top)];
        sheet.tag(self.family, id, middle, self.tag_mm);
        // Fold lines along the face, with glue flaps around it, bevelled at 45 degrees.
        let corners = [[left, low], [right, low], [right, top], [left, top]];
        let out = [[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]];
        for side in 0..4 {
            let (from, to) = (corners[side], corners[(side + 1) % 4]);
            sheet.line(from, to, true);
            let along = [(to[0] - from[0]) / self.face_mm, (to[1] - from[1]) / self.face_mm];
            let outer = |p: [f64; 2], sign: f64| {
                [0, 1].map(|i| p[i] + FLAP_MM * (out[side][i] + sign * along[i]))
            };
            let (a, b) = (outer(from, 1.0), outer(to, -1.0));
            sheet.line(from, a, false);
            sheet.line(a, b, false);
            sheet.line(b, to, false);
        }
        let (name, _, _) = CUBE_FACES[index as usize];
        let up = if index < 4 { "this edge up" } else { "this edge to the nose" };
        let text = format!("{name}   {} {id}   {up}", self.family);
        // On the upper flap, which is hidden after assembly.
        sheet.text([left + FLAP_MM + 2.0, top + 2.5], 2.6, &text);
    }
}

/// Width of the glue flaps. [mm]
const FLAP_MM: f64 = 8.0;
