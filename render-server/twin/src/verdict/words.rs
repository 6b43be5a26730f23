//! Images as people find them in a video.

use std::ops::Range;

use super::Given;

/// Returns runs of ascending numbers.
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

/// Returns runs of images with their times: "12 to 20 (7.4 s to 12.4 s), 31 (19.2 s)".
pub(super) fn spans(given: &[Given], runs: &[Range<usize>]) -> String {
    let one = |run: &Range<usize>| {
        let (first, last) = (&given[run.start], &given[run.end - 1]);
        if run.len() == 1 {
            format!("{} ({:.1} s)", first.name, first.at_s)
        } else {
            format!("{} to {} ({:.1} s to {:.1} s)", first.name, last.name, first.at_s, last.at_s)
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

/// More than this nobody reads.
const MANY: usize = 5;
