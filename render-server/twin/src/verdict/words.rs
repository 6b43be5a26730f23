//! Images as people find them in a video.

use std::ops::Range;

use super::Given;

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
    let mut words: Vec<String> = runs.iter().take(MANY).map(one).collect();
    if runs.len() > MANY {
        words.push(format!("and {} more", runs.len() - MANY));
    }
    words.join(", ")
}

/// More than this nobody reads.
const MANY: usize = 6;
