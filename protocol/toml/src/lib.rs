//! Strict parser for TOML files that users write. Unknown keys are rejected. All errors are reported at once, each with
//! its line, its key and the most similar known key.
//!
//! [`parse`] returns a value or [`TomlErrors`]. Serde stops at the first error. Therefore the faulty entry is removed
//! from the parsed table, and the rest is parsed again, until it is valid or nothing can be removed.

use std::collections::BTreeSet;
use std::fmt;
use std::ops::Range;

use serde::de::DeserializeOwned;
use toml::Spanned;
use toml::de::{DeArray, DeTable, DeValue, Deserializer, Error};

/// Maximum number of reported errors; more do not help.
const MAX_ERRORS: usize = 20;

/// Error at a position, with one sentence.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line}, column {column}: {what}")]
pub struct TomlError {
    /// Line, from 1.
    pub line: usize,
    /// Column, from 1, in characters.
    pub column: usize,
    /// Description of the error, with a remedy.
    pub what: String,
}

/// All errors of a text, in its order; at least one. Printed one per line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TomlErrors(pub Vec<TomlError>);

impl fmt::Display for TomlErrors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, error) in self.0.iter().enumerate() {
            let separator = if index == 0 { "" } else { "\n" };
            write!(f, "{separator}{error}")?;
        }
        Ok(())
    }
}

impl std::error::Error for TomlErrors {}

impl TomlErrors {
    /// Sorts the errors by position and removes duplicates.
    pub fn in_order(mut errors: Vec<TomlError>) -> Self {
        errors.sort_by_key(|error| (error.line, error.column));
        errors.dedup();
        Self(errors)
    }
}

/// Joins the results of checks. A single error is returned unchanged; more are combined by `several`, in their order.
///
/// # Errors
/// Returns the errors of the checks.
pub fn join_errors<E>(
    checks: impl IntoIterator<Item = Result<(), E>>,
    several: impl FnOnce(Vec<E>) -> E,
) -> Result<(), E> {
    let mut errors: Vec<E> = checks.into_iter().filter_map(Result::err).collect();
    match errors.pop() {
        None => Ok(()),
        Some(only) if errors.is_empty() => Err(only),
        Some(last) => {
            errors.push(last);
            Err(several(errors))
        }
    }
}

/// Returns an error at byte `at` of a text.
pub fn error_at(text: &str, at: usize, what: String) -> TomlError {
    let before = text.get(..at).unwrap_or(text);
    let start_of_line = before.rfind('\n').map_or(0, |newline| newline + 1);
    let line = before.matches('\n').count() + 1;
    TomlError { line, column: before[start_of_line..].chars().count() + 1, what }
}

/// Parses `text` as a `T`, which should use `serde(deny_unknown_fields)` in all its tables.
///
/// # Errors
/// Returns all errors. Of missing keys, only the first of each table.
pub fn parse<T: DeserializeOwned>(text: &str) -> Result<T, TomlErrors> {
    let (mut table, syntax) = DeTable::parse_recoverable(text);
    let mut errors: Vec<_> = syntax.iter().map(|error| describe(text, error, None)).collect();
    if !errors.is_empty() {
        errors.truncate(MAX_ERRORS);
        return Err(TomlErrors::in_order(errors));
    }
    let mut removed = BTreeSet::new();
    loop {
        let error = match T::deserialize(Deserializer::from(table.clone())) {
            Ok(value) if errors.is_empty() => return Ok(value),
            Ok(_) => break,
            Err(error) => error,
        };
        // A key is not reported as missing if it was removed after an error, or if it was misspelt. Its table is
        // removed instead: all its other keys were already checked.
        let is_said = missing_key(&error).is_some_and(|key| {
            let meant = format!("did you mean '{key}'");
            removed.contains(key) || errors.iter().any(|error| error.what.contains(&meant))
        });
        let key = error.span().and_then(|span| remove(table.get_mut(), &span));
        if !is_said {
            errors.push(describe(text, &error, key.as_deref()));
        }
        match key {
            Some(key) if errors.len() < MAX_ERRORS => removed.insert(key),
            _ => break,
        };
    }
    Err(TomlErrors::in_order(errors))
}

/// Removes the innermost entry at the span from a table. Returns its key.
fn remove(table: &mut DeTable<'_>, span: &Range<usize>) -> Option<String> {
    for (key, value) in table.iter_mut() {
        match value.get_mut() {
            DeValue::Table(inner) => {
                if let Some(key) = remove(inner, span) {
                    return Some(key);
                }
            }
            DeValue::Array(array) => {
                if let Some(key) = remove_in_array(key.get_ref(), array, span) {
                    return Some(key);
                }
            }
            _ => {}
        }
    }
    let is_here = |part: Range<usize>| part.contains(&span.start);
    let mut entries = table.iter();
    let (key, _) = entries.find(|(key, value)| is_here(key.span()) || is_here(value.span()))?;
    let key = key.clone();
    table.remove(&key);
    Some(key.into_inner().into_owned())
}

/// Like [`remove`], for an array of tables with this name. If a whole table is removed, the name is its key.
fn remove_in_array(name: &str, array: &mut DeArray<'_>, span: &Range<usize>) -> Option<String> {
    for element in array.iter_mut() {
        if let DeValue::Table(inner) = element.get_mut()
            && let Some(key) = remove(inner, span)
        {
            return Some(key);
        }
    }
    let is_it = |element: &Spanned<DeValue<'_>>| {
        element.get_ref().is_table() && element.span().contains(&span.start)
    };
    let at = array.iter().position(is_it)?;
    let mut rest = DeArray::new();
    for (index, element) in array.iter().enumerate() {
        if index != at {
            rest.push(element.clone());
        }
    }
    *array = rest;
    Some(name.to_owned())
}

fn describe(text: &str, error: &Error, key: Option<&str>) -> TomlError {
    let what = unknown_key(error.message()).unwrap_or_else(|| {
        let message = error.message().trim().replace('\n', "; ");
        // A missing key is already in the message, and the entry is only its table.
        let key = key.filter(|_| missing_key(error).is_none());
        key.map_or_else(|| message.clone(), |key| format!("{key}: {message}"))
    });
    error_at(text, error.span().map_or(0, |span| span.start), what)
}

/// Returns the key of a "missing field" error, in serde's wording.
fn missing_key(error: &Error) -> Option<&str> {
    error.message().strip_prefix("missing field `")?.split('`').next()
}

/// Returns a better sentence for an unknown key. serde's message contains the unknown key and then the known keys, each
/// in backquotes. If serde changes its wording, a test fails, and users see serde's own sentence.
fn unknown_key(message: &str) -> Option<String> {
    let (unknown, rest) = message.strip_prefix("unknown field `")?.split_once("`, expected ")?;
    // Parts between backquotes: every second one.
    let known: Vec<&str> = rest.split('`').skip(1).step_by(2).collect();
    Some(unknown_among(unknown, &known))
}

/// Returns the error message for an unknown key, with the most similar known key.
pub fn unknown_among(unknown: &str, known: &[&str]) -> String {
    let nearest = known.iter().min_by_key(|name| distance(unknown, name));
    let known_all = known.join(", ");
    match nearest {
        // If more than half of the letters differ, it is a different word.
        Some(nearest) if distance(unknown, nearest) <= nearest.chars().count().div_ceil(2) => {
            format!("unknown key '{unknown}'; did you mean '{nearest}'? known here: {known_all}")
        }
        _ => format!("unknown key '{unknown}'; known here: {known_all}"),
    }
}

/// Returns the Levenshtein distance: the number of letters to change, add or remove.
fn distance(a: &str, b: &str) -> usize {
    // Limits the cost for very long keys, which is quadratic.
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

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use serde::Deserialize;

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Room {
        name: String,
        size_m: [f64; 3],
        #[serde(default)]
        cameras: Vec<Camera>,
        limits: Option<Limits>,
    }

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Camera {
        width_px: u32,
        height_px: u32,
    }

    #[derive(Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    #[derive(Default)]
    struct Limits {
        max_speed_mps: f64,
        max_tilt_deg: f64,
    }

    /// Parses `text`, and expects these errors, one per line.
    fn check(text: &str, expected: &[&str]) {
        let message = parse::<Room>(text).expect_err(text).to_string();
        let errors: Vec<&str> = message.lines().collect();
        assert_eq!(errors.len(), expected.len(), "{errors:#?}");
        for (error, expected) in errors.iter().zip(expected) {
            assert!(error.contains(expected), "{error:?} does not contain {expected:?}");
        }
    }

    #[test]
    fn reads_a_valid_file() {
        let text = "name = 'a'\nsize_m = [1, 2, 3]\n[[cameras]]\nwidth_px = 3\nheight_px = 2\n";
        let room = parse::<Room>(text).unwrap();
        assert_eq!((room.size_m, room.cameras.len()), ([1.0, 2.0, 3.0], 1));
    }

    #[test]
    fn reports_every_error_once_with_its_line_and_key() {
        let text = "nam = 'a'\n\
                    size_m = [1, 'x', 3]\n\
                    [limits]\n\
                    max_speed_mps = '2'\n\
                    max_tild_deg = 3\n\
                    [[cameras]]\n\
                    width_px = -1\n\
                    height_px = 2\n\
                    [[cameras]]\n\
                    widht_px = 3\n\
                    height_px = 1.5\n";
        check(
            text,
            &[
                "line 1, column 1: unknown key 'nam'; did you mean 'name'?",
                "line 2, column 14: size_m: invalid type",
                "line 4, column 17: max_speed_mps: invalid type: string \"2\"",
                "line 5, column 1: unknown key 'max_tild_deg'; did you mean 'max_tilt_deg'?",
                "line 7, column 12: width_px: invalid value: integer `-1`",
                "line 10, column 1: unknown key 'widht_px'; did you mean 'width_px'?",
                "line 11, column 13: height_px: invalid type: floating point",
            ],
        );
    }

    #[test]
    fn reports_missing_keys_of_several_tables() {
        let text = "name = 'a'\nsize_m = [1, 2, 3]\n[[cameras]]\nwidth_px = 1\n[[cameras]]\n\
                    height_px = 2\n";
        check(text, &["line 3", "line 5"]);
        let message = parse::<Room>(text).unwrap_err().to_string();
        assert!(
            message.contains("missing field `height_px`") && message.contains("`width_px`"),
            "{message}"
        );
        check("size_m = [1, 2, 3]\n", &["missing field `name`"]);
        check("", &["missing field"]);
    }

    #[test]
    fn reports_only_syntax_errors_if_there_are_any() {
        check("name = \n[limits\nx = 1\n", &["line 1, column", "line 2"]);
        check("name = 'a'\nname = 'b'\n", &["line 2, column 1: duplicate key"]);
    }

    #[test]
    fn reports_at_most_20_errors() {
        let lines: Vec<String> = (0..100).map(|n| format!("k{n} = 1")).collect();
        let text = lines.join("\n");
        assert_eq!(parse::<Room>(&text).unwrap_err().0.len(), MAX_ERRORS);
    }

    #[test]
    fn computes_the_levenshtein_distance() {
        let check = |a, b, expected| assert_eq!(distance(a, b), expected, "{a} {b}");
        check("", "", 0);
        check("kitten", "sitting", 3);
        check("abc", "", 3);
        check("", "abc", 3);
        check("flaw", "lawn", 2);
    }

    proptest! {
        #[test]
        fn accepts_or_rejects_any_text_without_a_panic(
            text in "\\PC*|((\\[\\[?(cameras|limits|[a-z]*)\\]?\\]\n)?([a-z_]+ = [0-9\"a-z.\\[\\]{}=]*\n)*)*"
        ) {
            if let Err(errors) = parse::<Room>(&text) {
                prop_assert!((1..=MAX_ERRORS).contains(&errors.0.len()));
            }
        }
    }
}
