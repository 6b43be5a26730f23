//! Whether a capture can be flown: checks that do not believe structure from motion.
//!
//! "All images placed, 0.4 pixels" is said of models that are metres wrong. What is looked at here is what such a model
//! cannot fake: how a hand can move between two images, tags that had no say, what a second model says, how many points
//! hold the parts of a walk together, and what should be seen and is not.

mod connected;
mod continuity;
mod doubled;
mod metric;
mod placed;
mod second_model;
mod tags;
mod walk;
mod words;

use std::ops::Range;

use crate::adjust::{Adjusted, Capture};
use crate::align::Fit;

/// What is judged.
#[derive(Clone, Copy, Debug)]
pub struct Evidence<'a> {
    /// Every image that was given to structure from motion, in the order of time.
    pub given: &'a [Given],
    /// Those that were placed.
    pub capture: &'a Capture,
    /// The same in metres; `Err` says why it could not be.
    pub adjusted: Result<&'a Adjusted, &'a crate::adjust::AdjustError>,
    /// Other models of the same images: further ones that structure from motion left, or another program's.
    pub others: &'a [Capture],
    /// Where a person has aligned it, which tells scale and vertical where nothing in the capture does.
    pub aligned: Option<&'a Fit>,
}

/// An image that was given to structure from motion.
#[derive(Clone, Debug, PartialEq)]
pub struct Given {
    /// Its file's name.
    pub name: String,
    /// When it was taken, from the start of the video; photos have no times. [s]
    pub at_s: Option<f64>,
}

/// What came out.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Verdict {
    /// What was found, the worst first; empty if all is well.
    pub findings: Vec<Finding>,
    /// What was looked at, a line each, with its figure: for a report.
    pub checked: Vec<String>,
}

/// Something that a person should know.
#[derive(Clone, Debug, PartialEq)]
pub struct Finding {
    /// How bad it is.
    pub severity: Severity,
    /// Which check found it.
    pub check: Check,
    /// What is wrong, with its figure.
    pub what: String,
    /// What to film again, or to do.
    pub remedy: String,
    /// Runs of the images concerned, as they were given.
    pub images: Vec<Range<usize>>,
}

/// How bad something is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// Not to be flown.
    Refused,
    /// To be known.
    Warning,
}

/// What was looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Check {
    /// Scale, vertical, and how well they are known.
    Metric,
    /// Tags against the images.
    Tags,
    /// The way from image to image.
    Continuity,
    /// Images without a place.
    Placed,
    /// What holds the parts together.
    Connected,
    /// One place that is two.
    Doubled,
    /// What other models say.
    SecondModel,
}

impl Verdict {
    /// Whether it may be flown.
    pub fn is_fit_to_fly(&self) -> bool {
        self.findings.iter().all(|finding| finding.severity != Severity::Refused)
    }
}

/// Judges a capture.
pub fn judge(evidence: &Evidence<'_>) -> Verdict {
    let mut verdict = Verdict::default();
    placed::check(evidence, &mut verdict);
    metric::check(evidence, &mut verdict);
    let walk = walk::Walk::new(evidence);
    tags::check(&walk, &mut verdict);
    continuity::check(&walk, &mut verdict);
    let shared = connected::Shared::new(&walk);
    connected::check(&walk, &shared, &mut verdict);
    doubled::check(&walk, &shared, &mut verdict);
    second_model::check(&walk, &mut verdict);
    verdict.findings.sort_by_key(|finding| (finding.severity, finding.check));
    verdict
}

#[cfg(test)]
mod tests;
