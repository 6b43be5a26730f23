//! Compares the table of `docs/guides/failsafe.md` with the flights, or writes it.

use std::fmt::Write as _;
use std::fs;

use super::loss::Row;

const BEGIN: &str = "<!-- losses: begin -->\n";
const END: &str = "<!-- losses: end -->";
const HEAD: &str = "\
| loss | reaction | at | stands after | LAND after | down after | drift |
|---|---|---|---|---|---|---|
";

/// Asserts that the guide has exactly these rows; `VIZFLYT_FAILSAFE=write` writes them.
pub(crate) fn check(rows: &[Row]) {
    let mut table = HEAD.to_owned();
    for row in rows {
        writeln!(table, "{}", row.line()).expect("a string takes all");
    }
    let path = vizflyt_e2e::root().join("docs/guides/failsafe.md");
    let text = fs::read_to_string(&path).expect("the guide is there");
    let (before, rest) = text.split_once(BEGIN).expect("the guide has the table's beginning");
    let (found, after) = rest.split_once(END).expect("the guide has the table's end");
    if std::env::var("VIZFLYT_FAILSAFE").is_ok_and(|what| what == "write") {
        fs::write(&path, format!("{before}{BEGIN}{table}{END}{after}")).expect("it can be written");
    } else {
        assert_eq!(
            found, table,
            "the guide has other figures: VIZFLYT_FAILSAFE=write cargo test -p vizflyt-e2e --test tables failsafe"
        );
    }
}
