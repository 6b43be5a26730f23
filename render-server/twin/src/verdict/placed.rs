//! Check for images without a pose.

use std::collections::HashSet;

use super::{Check, Evidence, Finding, Severity, Verdict, words};

/// Adds the missing images.
pub(super) fn check(evidence: &Evidence<'_>, verdict: &mut Verdict) {
    let placed: HashSet<&str> =
        evidence.capture.images.iter().map(|image| image.name.as_str()).collect();
    let is_missing = |&index: &usize| !placed.contains(evidence.given[index].name.as_str());
    let missing: Vec<usize> = (0..evidence.given.len()).filter(is_missing).collect();
    let given = evidence.given.len();
    let share = 1.0 - missing.len() as f64 / given.max(1) as f64;
    verdict.checked.push(format!(
        "placed: {} of {given} images, {:.1} %",
        given - missing.len(),
        100.0 * share
    ));
    if missing.is_empty() {
        return;
    }
    let images = words::runs(&missing);
    let severity = if share < LEAST_PLACED { Severity::Refused } else { Severity::Warning };
    let spans = words::spans(evidence.given, &images);
    verdict.findings.push(Finding {
        severity,
        check: Check::Placed,
        what: format!("{} of {given} images were not placed: {spans}", missing.len()),
        remedy: "walk there again, slowly, with more than half of the last image still in view; the parts that \
                 only these images saw are missing"
            .to_owned(),
        images,
    });
}

/// Minimum fraction of placed images: with one image in ten missing, whole parts of a room are missing.
const LEAST_PLACED: f64 = 0.9;
