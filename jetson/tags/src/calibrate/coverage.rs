//! Coverage of the image and of board tilts.

use glam::{DVec2, DVec3};

/// Distribution of corners in the image, and tilts of the board.
#[derive(Clone, Debug, PartialEq)]
pub struct Coverage {
    size_px: [u32; 2],
    /// Number of corners in each part of the image, row by row.
    counts: [u32; COLUMNS * ROWS],
    /// Maximum tilt towards left, right, up, and down. [rad]
    tilts_rad: [f64; 4],
}

impl Coverage {
    pub(super) fn new(size_px: [u32; 2]) -> Self {
        Self { size_px, counts: [0; COLUMNS * ROWS], tilts_rad: [0.0; 4] }
    }

    pub(super) fn corners(&mut self, pixels: impl Iterator<Item = DVec2>) {
        let [width, height] = self.size_px.map(f64::from);
        for pixel in pixels {
            let part = |x: f64, size: f64, parts: usize| {
                ((x / size * parts as f64) as usize).min(parts - 1)
            };
            self.counts[part(pixel.y, height, ROWS) * COLUMNS + part(pixel.x, width, COLUMNS)] += 1;
        }
    }

    /// Adds the board's normal in `cam`; it points to the camera.
    pub(super) fn tilt(&mut self, normal: DVec3) {
        let towards = -normal.z;
        let sides = [-normal.x, normal.x, -normal.y, normal.y];
        for (most, side) in self.tilts_rad.iter_mut().zip(sides) {
            *most = most.max(side.atan2(towards));
        }
    }

    /// Returns the covered share of the image, 0 to 1.
    pub fn share(&self) -> f64 {
        let seen = self.counts.iter().filter(|&&count| count >= ENOUGH).count();
        seen as f64 / self.counts.len() as f64
    }

    /// Returns the parts of the image, row by row: `#` if covered, `.` if not.
    pub fn map(&self) -> Vec<String> {
        self.counts
            .chunks(COLUMNS)
            .map(|row| row.iter().map(|&count| if count >= ENOUGH { '#' } else { '.' }).collect())
            .collect()
    }

    /// Returns instructions for missing views.
    pub fn wanted(&self) -> Vec<String> {
        let mut wanted = Vec::new();
        let missing = |rows: std::ops::Range<usize>, columns: std::ops::Range<usize>| {
            rows.flat_map(|row| columns.clone().map(move |column| row * COLUMNS + column))
                .any(|part| self.counts[part] < ENOUGH)
        };
        // Edges before the centre, corners first: they are hardest to reach and constrain the lens most.
        let [low, mid, high] = [0..1, 1..ROWS - 1, ROWS - 1..ROWS];
        let [left, middle, right] = [0..1, 1..COLUMNS - 1, COLUMNS - 1..COLUMNS];
        for (name, rows, columns) in [
            ("in the upper left corner", low.clone(), left.clone()),
            ("in the upper right corner", low.clone(), right.clone()),
            ("in the lower left corner", high.clone(), left.clone()),
            ("in the lower right corner", high.clone(), right.clone()),
            ("at the left edge", mid.clone(), left),
            ("at the right edge", mid.clone(), right),
            ("at the upper edge", low, middle.clone()),
            ("at the lower edge", high, middle.clone()),
            ("in the middle", mid, middle),
        ] {
            if missing(rows, columns) {
                wanted.push(format!("hold the board {name} of the image"));
            }
        }
        let names = ["to the left", "to the right", "upwards", "downwards"];
        for (tilt_rad, name) in self.tilts_rad.iter().zip(names) {
            if *tilt_rad < MIN_TILT_RAD {
                wanted.push(format!("turn the board to face {name} by 30 degrees"));
            }
        }
        wanted
    }
}

/// Number of parts of the image, horizontally and vertically.
const COLUMNS: usize = 5;
const ROWS: usize = 4;
/// Minimum number of corners in a part of the image.
const ENOUGH: u32 = 4;
/// Minimum tilt: boards that face the camera give little information about the focal length. 18 degrees. [rad]
const MIN_TILT_RAD: f64 = 0.314;
