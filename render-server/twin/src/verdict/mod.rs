//! Verdict about a capture: checks that do not rely on structure from motion's own residuals.
//!
//! "All images placed, 0.4 pixels" is also reported for models with errors of metres. The checks use evidence that such
//! a model cannot fake: possible motion of a hand between two images, held-out tags, a second model, the number of
//! points that connect the parts of a walk, and points that should be visible but are not.

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

/// Input of the verdict.
#[derive(Clone, Copy, Debug)]
pub struct Evidence<'a> {
    /// All images given to structure from motion, in the order of time.
    pub given: &'a [Given],
    /// Images with poses.
    pub capture: &'a Capture,
    /// The adjusted capture in metres; `Err` is the reason why it could not be adjusted.
    pub adjusted: Result<&'a Adjusted, &'a crate::adjust::AdjustError>,
    /// Other models of the same images: further models of structure from motion, or of another program.
    pub others: &'a [Capture],
    /// Manual alignment, which gives scale and vertical if the capture does not determine them.
    pub aligned: Option<&'a Fit>,
}

/// An image given to structure from motion.
#[derive(Clone, Debug, PartialEq)]
pub struct Given {
    /// File name.
    pub name: String,
    /// Time from the start of the video; `None` for photos. [s]
    pub at_s: Option<f64>,
}

/// Result of the checks.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Verdict {
    /// Findings, the worst first; empty if there are none.
    pub findings: Vec<Finding>,
    /// Results of all checks, one line each with its figure, for a report.
    pub checked: Vec<String>,
}

/// A problem of a capture.
#[derive(Clone, Debug, PartialEq)]
pub struct Finding {
    pub severity: Severity,
    /// Check that found it.
    pub check: Check,
    /// Problem, with its figure.
    pub what: String,
    /// Remedy: what to film again, or to do.
    pub remedy: String,
    /// Ranges of the images concerned, as indices into the given images.
    pub images: Vec<Range<usize>>,
}

/// Severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// The capture must not be flown.
    Refused,
    /// The capture may be flown.
    Warning,
}

/// Kind of check.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Check {
    /// Accuracy of scale and vertical.
    Metric,
    /// Agreement of tags with the images.
    Tags,
    /// Continuity of the path from image to image.
    Continuity,
    /// Images without a pose.
    Placed,
    /// Connection of the parts.
    Connected,
    /// One place that consists of two.
    Doubled,
    /// Agreement with other models.
    SecondModel,
}

impl Verdict {
    /// Returns whether the capture may be flown.
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
