//! Sheets of paper and their shapes.

use std::fmt;

use super::BAR_MM;
use crate::family::TagFamily;

/// Paper sizes, in portrait orientation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Paper {
    /// 210 x 297 mm.
    #[default]
    A4,
    /// 215.9 x 279.4 mm.
    Letter,
    /// 297 x 420 mm.
    A3,
}

impl Paper {
    /// Returns width and height. [mm]
    pub fn size_mm(self) -> [f64; 2] {
        match self {
            Self::A4 => [210.0, 297.0],
            Self::Letter => [215.9, 279.4],
            Self::A3 => [297.0, 420.0],
        }
    }

    /// Returns width and height of the printable area: within the margins of printers, and above the foot. [mm]
    pub fn room_mm(self) -> [f64; 2] {
        let [width, height] = self.size_mm();
        [width - 2.0 * MARGIN_MM, height - 2.0 * MARGIN_MM - FOOT_MM]
    }
}

impl fmt::Display for Paper {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::A4 => "A4",
            Self::Letter => "Letter",
            Self::A3 => "A3",
        })
    }
}

/// A shape. Coordinates are relative to the sheet's lower left corner, x right, y up. [mm]
#[derive(Clone, Debug, PartialEq)]
pub enum Shape {
    /// Black cells of a tag: boxes of left edge, lower edge, width, height. They are drawn together, to avoid seams
    /// between neighbours.
    Boxes(Vec<[f64; 4]>),
    /// A thin grey line for cutting, or a dashed line for folding.
    Line {
        from: [f64; 2],
        to: [f64; 2],
        /// Whether the line is for folding.
        fold: bool,
    },
    /// A line of text.
    Text {
        /// Start of the base line.
        at: [f64; 2],
        /// Height of the capitals.
        size: f64,
        /// Latin text.
        text: String,
    },
}

/// A sheet of paper.
#[derive(Clone, Debug, PartialEq)]
pub struct Sheet {
    pub paper: Paper,
    /// Shapes on the sheet.
    pub shapes: Vec<Shape>,
}

impl Sheet {
    /// Makes a sheet with its foot: scale bar, title, and printing instruction.
    pub(super) fn new(paper: Paper, title: &str) -> Self {
        let mut sheet = Self { paper, shapes: Vec::new() };
        let [left, low] = [MARGIN_MM + 2.0, MARGIN_MM + 7.0];
        // The bar ends at the outer edges of its end marks, which are easy to measure with a ruler.
        let mut boxes = vec![[left, low, BAR_MM, 0.5]];
        for i in 0..=10 {
            let high = if i % 5 == 0 { 4.0 } else { 2.5 };
            // Marks are inside the bar's ends.
            let x = match i {
                0 => left,
                10 => left + BAR_MM - 0.3,
                _ => left + f64::from(i) * BAR_MM / 10.0 - 0.15,
            };
            boxes.push([x, low, 0.3, high]);
        }
        sheet.shapes.push(Shape::Boxes(boxes));
        sheet.text(
            [left, low - 4.0],
            2.6,
            "This bar must measure 100.0 mm, end to end. Print at 100 %, not 'fit to page'.",
        );
        sheet.text([left + BAR_MM + 6.0, low], 3.2, title);
        sheet
    }

    pub(super) fn boxes(&mut self, boxes: Vec<[f64; 4]>) {
        self.shapes.push(Shape::Boxes(boxes));
    }

    pub(super) fn text(&mut self, at: [f64; 2], size: f64, text: &str) {
        self.shapes.push(Shape::Text { at, size, text: text.to_owned() });
    }

    pub(super) fn line(&mut self, from: [f64; 2], to: [f64; 2], fold: bool) {
        self.shapes.push(Shape::Line { from, to, fold });
    }

    /// Draws an upright tag around its middle.
    pub(super) fn tag(&mut self, family: TagFamily, id: u32, middle: [f64; 2], size_mm: f64) {
        let Some(cells) = family.cells(id) else { return };
        let cell = size_mm / f64::from(cells.border());
        let half = f64::from(cells.across()) * cell / 2.0;
        let mut boxes = Vec::new();
        for row in 0..cells.across() {
            let mut column = 0;
            while column < cells.across() {
                let start = column;
                while column < cells.across() && !cells.is_white(column, row) {
                    column += 1;
                }
                if column > start {
                    let left = middle[0] - half + f64::from(start) * cell;
                    let low = middle[1] + half - f64::from(row + 1) * cell;
                    boxes.push([left, low, f64::from(column - start) * cell, cell]);
                }
                column += 1;
            }
        }
        self.shapes.push(Shape::Boxes(boxes));
    }

    /// Draws crop marks outside the corners of a box.
    pub(super) fn crop_marks(&mut self, [left, low, width, height]: [f64; 4]) {
        let (right, top) = (left + width, low + height);
        let [paper_width, paper_height] = self.paper.size_mm();
        for x in [left, right] {
            self.line([x, low], [x, low - MARK_MM], false);
            self.line([x, top], [x, (top + MARK_MM).min(paper_height - 2.0)], false);
        }
        for y in [low, top] {
            self.line([left, y], [(left - MARK_MM).max(2.0), y], false);
            self.line([right, y], [(right + MARK_MM).min(paper_width - 2.0), y], false);
        }
    }
}

/// Unprintable margin of printers on every side. [mm]
pub(super) const MARGIN_MM: f64 = 10.0;
/// Height of the foot, with scale bar and text. [mm]
pub(super) const FOOT_MM: f64 = 18.0;
/// Length of a crop mark. [mm]
const MARK_MM: f64 = 6.0;
