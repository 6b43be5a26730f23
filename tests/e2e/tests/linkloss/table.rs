//! The table of `docs/guides/failsafe.md`: printed, written there, and compared with what is there.

use std::fmt::Write as _;
use std::fs;
use std::path::PathBuf;

use super::{Left, Row, Run};

const BEGIN: &str = "<!-- linkloss: begin -->\n";
const END: &str = "<!-- linkloss: end -->";

/// Returns the rows as Markdown.
pub(crate) fn write(rows: &[Row]) -> String {
    let mut text = String::from(
        "| what is lost | who notices, and does what | at | stands after | LAND after | down after | drift |\n\
         |---|---|---|---|---|---|---|\n",
    );
    for row in rows {
        let seconds =
            |value: Option<f64>| value.map_or("-".to_owned(), |seconds| format!("{seconds:.1} s"));
        let flies_on = row.run.case.left == Left::FliesOn;
        let lands = if flies_on { "flies on".to_owned() } else { seconds(row.lands_s) };
        writeln!(
            text,
            "{} {} | {lands} | {} | {:.2} m |",
            begins(row),
            seconds(row.stands_s),
            seconds(row.down_s),
            row.drift_m
        )
        .expect("a string takes all");
    }
    text
}

/// Returns the row's first cells: what it is, not what was measured.
fn begins(row: &Row) -> String {
    let Run { case, speed_mps, .. } = row.run;
    format!("| {} | {} | {speed_mps} m/s |", case.name, case.does)
}

fn guide() -> PathBuf {
    vizflyt_e2e::root().join("docs/guides/failsafe.md")
}

fn parts(text: &str) -> (&str, &str, &str) {
    let (before, rest) = text.split_once(BEGIN).expect("the guide has the table's beginning");
    let (table, after) = rest.split_once(END).expect("the guide has the table's end");
    (before, table, after)
}

/// Writes the table into the guide.
pub(crate) fn replace(table: &str) {
    let text = fs::read_to_string(guide()).expect("the guide is there");
    let (before, _, after) = parts(&text);
    fs::write(guide(), format!("{before}{BEGIN}{table}{END}{after}")).expect("it can be written");
}

/// Checks that the guide's table has these rows: names and deeds to the letter, figures by the
/// promise that the test has checked.
pub(crate) fn compare(rows: &[Row]) {
    let text = fs::read_to_string(guide()).expect("the guide is there");
    let (_, table, _) = parts(&text);
    let lines: Vec<_> = table.lines().skip(2).collect();
    assert_eq!(lines.len(), rows.len(), "the guide has other rows; {WRITE}");
    for (line, row) in lines.iter().zip(rows) {
        let begins = begins(row);
        assert!(line.starts_with(&begins), "the guide has {line:?}, not {begins:?}; {WRITE}");
    }
}

const WRITE: &str = "run VIZFLYT_LINKLOSS=write cargo test -p vizflyt-e2e --test linkloss";
