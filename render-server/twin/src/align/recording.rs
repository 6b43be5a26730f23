//! Reads recordings of a motion capture: CSV with a header (ours, EuRoC's), TUM, exports of Motive and Vicon.
//!
//! ```text
//! text -> header row: columns and units -> rows -> Tracked, ascending in time
//! ```
//! A row without a position means that the tracked point was lost; it is skipped. An invalid row is an error with its
//! line: guessing would put walls in wrong places.

use glam::DVec3;

use super::track::Tracked;

/// Why a recording cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RecordingError {
    /// No row names the columns.
    #[error(
        "no row names its columns; give a CSV with a header such as t,x,y,z (seconds and metres), or TUM's 8 numbers a line: \
         stamp tx ty tz qx qy qz qw"
    )]
    NoHeader,
    /// The header has no time column.
    #[error("line {line}: the header names no time; call a column t [s], or stamp_ns")]
    NoTime {
        /// Line number, from 1.
        line: usize,
    },
    /// Invalid row.
    #[error("line {line}: {what}")]
    Row {
        /// Line number, from 1.
        line: usize,
        /// Fault.
        what: String,
    },
    /// Frame numbers without a frame rate.
    #[error(
        "the recording has frame numbers but no frame rate; export the frame rate too, or a column t"
    )]
    NoRate,
    /// Too few poses.
    #[error("{0} poses are too few for a track; is the right object exported?")]
    TooFew(usize),
}

/// Reads the track of a recording: of several objects, the first.
///
/// # Errors
/// [`RecordingError`], with the line.
pub fn parse(text: &str) -> Result<Vec<Tracked>, RecordingError> {
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let mut found = Vec::new();
    if is_tum(text) {
        for (line, row) in rows(text) {
            let cells: Vec<&str> = row.split_whitespace().collect();
            push(&mut found, line, &cells, &Columns::TUM)?;
        }
    } else {
        let (first, columns) = header(text)?;
        for (line, row) in rows(text).filter(|(line, _)| *line >= first) {
            let cells: Vec<&str> = row.split(',').map(str::trim).collect();
            push(&mut found, line, &cells, &columns)?;
        }
    }
    if found.len() < 2 {
        return Err(RecordingError::TooFew(found.len()));
    }
    Ok(found)
}

/// Indices of the columns, and their units.
#[derive(Clone, Debug, PartialEq)]
struct Columns {
    time: usize,
    /// [s]
    time_unit: f64,
    position: [usize; 3],
    /// [m]
    unit_m: f64,
}

impl Columns {
    const TUM: Self = Self { time: 0, time_unit: 1.0, position: [1, 2, 3], unit_m: 1.0 };
}

fn rows(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let numbered = text.lines().enumerate().map(|(k, row)| (k + 1, row.trim()));
    numbered.filter(|(_, row)| !row.is_empty() && !row.starts_with('#'))
}

/// Returns whether the first row consists of numbers separated by spaces.
fn is_tum(text: &str) -> bool {
    let Some((_, first)) = rows(text).next() else { return false };
    let mut cells = first.split_whitespace();
    let numbers = cells.by_ref().take_while(|cell| cell.parse::<f64>().is_ok()).count();
    (4..=8).contains(&numbers) && cells.next().is_none()
}

fn push(
    found: &mut Vec<Tracked>,
    line: usize,
    cells: &[&str],
    columns: &Columns,
) -> Result<(), RecordingError> {
    let row = |what: String| RecordingError::Row { line, what };
    let position = columns.position.map(|k| cells.get(k).copied().unwrap_or(""));
    if position.iter().all(|cell| cell.is_empty() || cell.eq_ignore_ascii_case("nan")) {
        return Ok(());
    }
    let number = |cell: &str| match cell.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => Err(row(format!("'{cell}' is not a number"))),
    };
    let time = cells.get(columns.time).ok_or_else(|| row("the row has no time".to_owned()))?;
    let at_s = number(time)? * columns.time_unit;
    let [x, y, z] = position;
    let position_m = DVec3::new(number(x)?, number(y)?, number(z)?) * columns.unit_m;
    if position_m.abs().max_element() > FARTHEST_M {
        let what = format!("{position_m:.0} m is out of range; are these metres?");
        return Err(row(what));
    }
    match found.last() {
        Some(last) if at_s == last.at_s => return Ok(()),
        Some(last) if at_s < last.at_s => {
            let what =
                format!("time goes back, from {} to {at_s} s; is it one recording?", last.at_s);
            return Err(row(what));
        }
        _ => {}
    }
    found.push(Tracked { at_s, position_m });
    Ok(())
}

/// Returns the first line of the data, and its columns.
fn header(text: &str) -> Result<(usize, Columns), RecordingError> {
    // Comments may be headers: EuRoC's begins with #.
    let lines: Vec<Vec<Name>> = text.lines().take(HEAD).map(names).collect();
    for (k, cells) in lines.iter().enumerate() {
        let above = k.checked_sub(1).map(|above| lines[above].as_slice());
        let Some(position) = position(cells, above.unwrap_or_default()) else { continue };
        let line = k + 1;
        let time = cells.iter().position(|cell| TIMES.contains(&cell.word.as_str()));
        let frame = cells.iter().position(|cell| cell.word == "frame");
        let (time, time_unit) = match (time, frame) {
            (Some(time), _) => (time, time_unit(&cells[time].unit)),
            (None, Some(frame)) => (frame, 1.0 / rate_hz(&lines[..k])?),
            (None, None) => return Err(RecordingError::NoTime { line }),
        };
        // Units are in the header, below it, or, for the whole file, in its first line.
        let below = lines.get(line).and_then(|row| row.get(position[0]));
        let below = below.and_then(|cell| length_m(&cell.word));
        let unit_m = length_m(&cells[position[0]].unit).or(below).or_else(|| whole_m(&lines[0]));
        let first = if below.is_some() { line + 2 } else { line + 1 };
        return Ok((first, Columns { time, time_unit, position, unit_m: unit_m.unwrap_or(1.0) }));
    }
    Err(RecordingError::NoHeader)
}

/// A cell of a header: name and unit.
#[derive(Clone, Debug, Default, PartialEq)]
struct Name {
    word: String,
    unit: String,
}

/// Splits a header row. Accepts `#timestamp [ns]`, `p_x (mm)`, `stamp_ns` and `x_m`.
fn names(row: &str) -> Vec<Name> {
    let cell = |cell: &str| {
        let lower =
            cell.trim().trim_start_matches('#').trim().trim_matches('"').to_ascii_lowercase();
        if let Some((word, unit)) = lower.split_once(['[', '(']) {
            let unit = unit.trim_end_matches([']', ')']).trim().to_owned();
            return Name { word: word.trim().to_owned(), unit };
        }
        match lower.rsplit_once('_') {
            Some((word, unit)) if UNITS.contains(&unit) && !word.is_empty() => {
                Name { word: word.to_owned(), unit: unit.to_owned() }
            }
            _ => Name { word: lower, unit: String::new() },
        }
    };
    row.split(',').map(cell).collect()
}

/// Returns the first three adjacent columns that name a position. If the row above marks columns as rotation or
/// position, only positions count.
fn position(cells: &[Name], above: &[Name]) -> Option<[usize; 3]> {
    let axis = |k: usize, axis: &str| {
        let word = cells.get(k).map_or("", |cell| cell.word.as_str());
        let prefix = word.strip_suffix(axis)?;
        PREFIXES.contains(&prefix.trim_end_matches(['_', '.', ' '])).then_some(())
    };
    let says = above.iter().any(|cell| cell.word == "position");
    (0..cells.len()).find_map(|k| {
        axis(k, "x").and(axis(k + 1, "y")).and(axis(k + 2, "z"))?;
        let is_place = !says || above.get(k).is_some_and(|cell| cell.word == "position");
        is_place.then_some([k, k + 1, k + 2])
    })
}

fn time_unit(unit: &str) -> f64 {
    match unit {
        "ns" => 1e-9,
        "us" => 1e-6,
        "ms" => 1e-3,
        _ => 1.0,
    }
}

fn length_m(unit: &str) -> Option<f64> {
    match unit {
        "m" | "meters" | "metres" => Some(1.0),
        "cm" | "centimeters" | "centimetres" => Some(1e-2),
        "mm" | "millimeters" | "millimetres" => Some(1e-3),
        _ => None,
    }
}

/// Reads the unit from Motive's first line: `..., Length Units, Millimeters, ...`.
fn whole_m(first: &[Name]) -> Option<f64> {
    let key = first.iter().position(|cell| cell.word == "length units")?;
    length_m(&first.get(key + 1)?.word)
}

/// Returns the frame rate: Motive's `Export Frame Rate`, or the single number in a row of Vicon's header.
fn rate_hz(above: &[Vec<Name>]) -> Result<f64, RecordingError> {
    let number = |cell: &Name| cell.word.parse::<f64>().ok().filter(|hz| (1.0..=1e5).contains(hz));
    let named = above.iter().find_map(|row| {
        let key = row.iter().position(|cell| cell.word.ends_with("frame rate"))?;
        number(row.get(key + 1)?)
    });
    let alone = above.iter().find_map(|row| {
        let rest = row.get(1..)?.iter().all(|cell| cell.word.is_empty());
        if rest { number(row.first()?) } else { None }
    });
    named.or(alone).ok_or(RecordingError::NoRate)
}

/// Maximum number of header rows.
const HEAD: usize = 40;
/// Names of time columns.
const TIMES: [&str; 6] = ["t", "time", "timestamp", "stamp", "time_stamp", "sec"];
/// Prefixes of x, y and z of a position.
const PREFIXES: [&str; 9] = [
    "",
    "t",
    "p",
    "pos",
    "position",
    "p_rs_r",
    "field.pose.position",
    "pose.position",
    "translation",
];
const UNITS: [&str; 7] = ["s", "ms", "us", "ns", "m", "cm", "mm"];
/// Maximum coordinate, the limit of an arena's positions. [m]
const FARTHEST_M: f64 = 1e5;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn check(text: &str, expected: &[(f64, [f64; 3])]) {
        let found = parse(text).unwrap_or_else(|error| panic!("{error}: {text}"));
        let expected = expected.iter().map(|&(at_s, p)| (at_s, DVec3::from_array(p)));
        assert_eq!(found.len(), expected.len(), "{found:?}");
        for (tracked, (at_s, p)) in found.iter().zip(expected) {
            assert!((tracked.at_s - at_s).abs() < 1e-6, "{tracked:?}");
            assert!(tracked.position_m.distance(p) < 1e-9, "{tracked:?}");
        }
    }

    const TWO: [(f64, [f64; 3]); 2] = [(0.5, [1.0, 2.0, 3.0]), (0.51, [1.5, 2.0, -3.0])];

    #[test]
    fn reads_the_same_track_from_all_formats() {
        check("t,x,y,z\n0.5,1,2,3\n0.51,1.5,2,-3\n", &TWO);
        check(
            "stamp_ns,x_m,y_m,z_m,qx,qy,qz,qw\n500000000,1,2,3,0,0,0,1\n510000000,1.5,2,-3,0,0,0,1",
            &TWO,
        );
        // EuRoC's ground truth.
        check(
            "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w []\r\n\
             500000000,1,2,3,1\r\n510000000,1.5,2,-3,1\r\n",
            &TWO,
        );
        // TUM's format, with its comments.
        check(
            "# ground truth\n# timestamp tx ty tz qx qy qz qw\n0.5 1 2 3 0 0 0 1\n0.51 1.5 2 -3 0 0 0 1\n",
            &TWO,
        );
        // Motive's export; the point is lost in between.
        check(
            "Format Version,1.23,Take Name,a,Capture Frame Rate,100.000000,Export Frame Rate,100.000000,Rotation Type,\
             Quaternion,Length Units,Millimeters,Coordinate Space,Global\n\n\
             ,Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body\n\
             ,Name,Cam,Cam,Cam,Cam,Cam,Cam,Cam\n,ID,1,1,1,1,1,1,1\n\
             ,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position\n\
             Frame,Time (Seconds),X,Y,Z,W,X,Y,Z\n\
             50,0.5,0.1,0.2,0.3,0.9,1000,2000,3000\n51,0.505,,,,,,,\n51,0.51,0.1,0.2,0.3,0.9,1500,2000,-3000\n",
            &TWO,
        );
        // Vicon's export, without a time: 100 Hz, in millimetres.
        check(
            "Objects\n100\n,,Cam,,,,,\nFrame,Sub Frame,RX,RY,RZ,TX,TY,TZ\n,,rad,rad,rad,mm,mm,mm\n\
             50,0,0.1,0,0,1000,2000,3000\n51,0,0.1,0,0,1500,2000,-3000\n",
            &TWO,
        );
    }

    #[test]
    fn error_names_the_fault_and_its_line() {
        let refused = |text: &str, expected: &str| {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.contains(expected), "'{error}' lacks '{expected}'");
        };
        refused("", "no row names its columns");
        refused("<html>", "no row names its columns");
        refused("x,y,z\n1,2,3\n", "names no time");
        refused("frame,x,y,z\n1,1,2,3\n", "frame rate");
        refused("t,x,y,z\n1,2,3,4\n2,3,oops,4\n", "line 3: 'oops' is not a number");
        refused("t,x,y,z\n1,2,3,4\n0.5,2,3,4\n", "line 3: time goes back");
        refused("t,x,y,z\n1,2,3,inf\n", "line 2: 'inf'");
        refused("t,x,y,z\n1,2e9,3,4\n", "line 2");
        refused("t,x,y,z\n1,2,3,4\n", "1 poses are too few for a track");
        refused("0 1 2 3\n1 2\n", "line 2");
    }

    proptest! {
        #[test]
        fn reads_back_a_written_track(
            points in prop::collection::vec((0.001..1.0f64, prop::array::uniform3(-50.0..50.0f64)), 2..40),
            tum in any::<bool>(),
        ) {
            let mut at_s = 0.0;
            let track: Vec<_> = points.iter().map(|(step_s, p)| { at_s += step_s; (at_s, *p) }).collect();
            let line = |(at_s, [x, y, z]): &(f64, [f64; 3])| {
                if tum { format!("{at_s} {x} {y} {z} 0 0 0 1\n") } else { format!("{at_s},{x},{y},{z}\n") }
            };
            let head = if tum { "" } else { "t,x,y,z\n" };
            let text: String = std::iter::once(head.to_owned()).chain(track.iter().map(line)).collect();
            check(&text, &track);
        }

        #[test]
        fn does_not_panic_on_any_text(text in "(t|x|y|z|,|\n|[0-9.]|#|frame|Position|mm|\\(| |-|nan){0,80}") {
            if let Ok(track) = parse(&text) {
                prop_assert!(track.iter().all(|t| t.at_s.is_finite() && t.position_m.is_finite()));
                prop_assert!(track.windows(2).all(|two| two[0].at_s < two[1].at_s));
            }
        }
    }
}
