//! Names and times of images, as people find them in a video.

use std::ops::Range;

use super::Given;

/// Returns the ranges of consecutive numbers.
pub(super) fn runs(ascending: &[usize]) -> Vec<Range<usize>> {
    let mut runs: Vec<Range<usize>> = Vec::new();
    for &index in ascending {
        match runs.last_mut() {
            Some(run) if run.end == index => run.end += 1,
            _ => runs.push(index..index + 1),
        }
    }
    runs
}

/// Formats ranges of images, with times if available: "12 to 20 (7.4 s to 12.4 s), 31 (19.2 s)".
pub(super) fn spans(given: &[Given], runs: &[Range<usize>]) -> String {
    let one = |run: &Range<usize>| {
        let (first, last) = (&given[run.start], &given[run.end - 1]);
        let names = match run.len() {
            1 => first.name.clone(),
            _ => format!("{} to {}", first.name, last.name),
        };
        match (first.at_s, last.at_s) {
            (Some(at_s), _) if run.len() == 1 => format!("{names} ({at_s:.1} s)"),
            (Some(from_s), Some(to_s)) => format!("{names} ({from_s:.1} s to {to_s:.1} s)"),
            _ => names,
        }
    };
    let mut longest: Vec<&Range<usize>> = runs.iter().collect();
    longest.sort_by_key(|run| std::cmp::Reverse(run.len()));
    longest.truncate(MANY);
    longest.sort_by_key(|run| run.start);
    let mut words: Vec<String> = longest.into_iter().map(one).collect();
    if runs.len() > MANY {
        let rest: usize = runs.iter().map(ExactSizeIterator::len).sum();
        words.push(format!("and more, {rest} images in all"));
    }
    words.join(", ")
}

/// Maximum number of ranges in a message.
const MANY: usize = 5;
