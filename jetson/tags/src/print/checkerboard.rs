//! A checkerboard on one sheet.

use super::sheet::{FOOT_MM, MARGIN_MM, Sheet};
use super::{Paper, PrintError, check_positive, scale};
use crate::checkerboard::Checkerboard;

/// Returns a sheet filled with squares of this edge, and the printed board; `bar_mm` is the measured length of the
/// printed scale bar.
///
/// The numbers of columns and rows of squares are odd and even, so that the board has no rotational symmetry.
///
/// # Errors
/// [`PrintError`] for squares that are too large or out of range.
pub fn checkerboard(
    paper: Paper,
    square_mm: f64,
    bar_mm: f64,
) -> Result<(Sheet, Checkerboard), PrintError> {
    check_positive("square_mm", square_mm)?;
    let scale = scale(bar_mm)?;
    // A white rim around the board makes its outermost corners detectable.
    let [width, height] = paper.room_mm().map(|room| room - 2.0 * RIM_MM);
    let [columns, rows] = [width, height].map(|room| (room / square_mm) as u32);
    let rows = if (columns + rows).is_multiple_of(2) { rows.saturating_sub(1) } else { rows };
    if columns.min(rows) < MIN_SQUARES {
        let (what, room_mm) = ("a board of four squares", width.min(height));
        let size_mm = square_mm * f64::from(MIN_SQUARES);
        return Err(PrintError::TooLarge { what, size_mm, paper, room_mm });
    }
    let title = format!("{} x {} inner corners", columns - 1, rows - 1);
    let mut sheet = Sheet::new(paper, &title);
    let left = (paper.size_mm()[0] - f64::from(columns) * square_mm) / 2.0;
    let low = MARGIN_MM + FOOT_MM + RIM_MM;
    let dark = (0..rows).flat_map(|row| {
        let first = row % 2;
        (first..columns).step_by(2).map(move |column| {
            let at = |edge: f64, index: u32| edge + f64::from(index) * square_mm;
            [at(left, column), at(low, row), square_mm, square_mm]
        })
    });
    sheet.boxes(dark.collect());
    let square_m = square_mm * scale / 1000.0;
    Ok((sheet, Checkerboard { columns: columns - 1, rows: rows - 1, square_m }))
}

/// White rim around the board. [mm]
const RIM_MM: f64 = 5.0;
/// Minimum number of squares in a direction, for three inner corners.
const MIN_SQUARES: u32 = 4;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::print::{BAR_MM, Shape};

    #[test]
    fn fills_a_sheet_within_its_margins() {
        for (paper, square_mm) in [(Paper::A4, 25.0), (Paper::Letter, 20.0), (Paper::A3, 30.0)] {
            let (sheet, board) = checkerboard(paper, square_mm, BAR_MM).unwrap();
            assert_eq!(Checkerboard::parse(&board.to_toml().unwrap()).unwrap(), board);
            assert!((board.columns + board.rows) % 2 == 1, "{board:?}");
            let [width, height] = paper.size_mm();
            let squares: Vec<[f64; 4]> = sheet
                .shapes
                .iter()
                .filter_map(|shape| match shape {
                    Shape::Boxes(boxes) => Some(boxes),
                    _ => None,
                })
                .flatten()
                .filter(|[_, _, w, h]| *w == square_mm && *h == square_mm)
                .copied()
                .collect();
            let all = (board.columns + 1) * (board.rows + 1);
            assert_eq!(squares.len() as u32, all.div_ceil(2));
            for [x, y, w, h] in squares {
                assert!(x >= MARGIN_MM && x + w <= width - MARGIN_MM, "{x} {w}");
                assert!(y >= MARGIN_MM + FOOT_MM && y + h <= height - MARGIN_MM, "{y} {h}");
            }
        }
        // A printer that scales to 97 %.
        let (_, board) = checkerboard(Paper::A4, 25.0, 97.0).unwrap();
        assert!((board.square_m - 0.02425).abs() < 1e-12);
        let error = checkerboard(Paper::A4, 80.0, BAR_MM).unwrap_err().to_string();
        assert!(error.contains("a board of four squares of 320 mm does not fit on A4"), "{error}");
        assert!(checkerboard(Paper::A4, f64::NAN, BAR_MM).is_err());
    }
}
