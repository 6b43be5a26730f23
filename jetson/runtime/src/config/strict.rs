//! TOML that refuses what it does not know, and says what may have been meant.

use serde::de::DeserializeOwned;

/// Why a file is refused: a place and one sentence.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line}, column {column}: {what}")]
pub struct StrictError {
    /// From 1.
    pub line: usize,
    /// From 1, in characters.
    pub column: usize,
    /// What is wrong, and what to do.
    pub what: String,
}

/// Returns `text` as a `T`, which is to carry `serde(deny_unknown_fields)` throughout. An unknown key
/// is answered with the nearest known one.
///
/// # Errors
/// The first thing that is wrong.
pub fn parse_strict<T: DeserializeOwned>(text: &str) -> Result<T, StrictError> {
    toml::from_str(text).map_err(|error| {
        let before = text.get(..error.span().map_or(0, |span| span.start)).unwrap_or(text);
        let start_of_line = before.rfind('\n').map_or(0, |newline| newline + 1);
        StrictError {
            line: before.matches('\n').count() + 1,
            column: before[start_of_line..].chars().count() + 1,
            what: unknown_key(error.message())
                .unwrap_or_else(|| error.message().trim().replace('\n', "; ")),
        }
    })
}

/// Returns a better sentence for an unknown key. serde names it and then the known ones, each in
/// backquotes; should its wording change, a test fails and people read serde's own sentence.
fn unknown_key(message: &str) -> Option<String> {
    let (unknown, rest) = message.strip_prefix("unknown field `")?.split_once("`, expected ")?;
    // Between backquotes: every second part.
    let known: Vec<&str> = rest.split('`').skip(1).step_by(2).collect();
    let nearest = known.iter().min_by_key(|name| distance(unknown, name))?;
    let known_all = known.join(", ");
    // Farther than half of its letters it is another word.
    if distance(unknown, nearest) <= nearest.chars().count().div_ceil(2) {
        Some(format!("unknown key '{unknown}'; did you mean '{nearest}'? known here: {known_all}"))
    } else {
        Some(format!("unknown key '{unknown}'; known here: {known_all}"))
    }
}

/// Returns how many letters must be changed, added or left out to make `a` of `b` (Levenshtein).
pub(super) fn distance(a: &str, b: &str) -> usize {
    // A key of a megabyte must not cost its square.
    let a: Vec<char> = a.chars().take(64).collect();
    let mut row: Vec<usize> = (0..=a.len()).collect();
    for (j, letter) in b.chars().take(64).enumerate() {
        let mut diagonal = row[0];
        row[0] = j + 1;
        for (i, other) in a.iter().enumerate() {
            let change = diagonal + usize::from(*other != letter);
            diagonal = row[i + 1];
            row[i + 1] = change.min(diagonal + 1).min(row[i] + 1);
        }
    }
    row[a.len()]
}
