//! Scale and vertical: whether anything tells them, and how well.

use super::{Check, Evidence, Finding, Severity, Verdict};

/// Adds what is not known, or not well enough.
pub(super) fn check(evidence: &Evidence<'_>, verdict: &mut Verdict) {
    let refuse = |verdict: &mut Verdict, severity, what: String, remedy: &str| {
        let images = Vec::new();
        let remedy = remedy.to_owned();
        verdict.findings.push(Finding { severity, check: Check::Metric, what, remedy, images });
    };
    let adjusted = match evidence.adjusted {
        Ok(adjusted) => adjusted,
        Err(error) => {
            let remedy = "measure again where the tags stand, and look for two with one number; or film again";
            refuse(
                verdict,
                Severity::Refused,
                format!("it cannot be made metric: {error}"),
                remedy,
            );
            return;
        }
    };
    let aligned = evidence.aligned;
    let scale_sigma = adjusted.scale_sigma.or(aligned.map(|fit| fit.scale_sigma));
    let tilt_sigma_rad = adjusted.tilt_sigma_rad.or(aligned.map(|fit| fit.tilt_sigma_rad));
    let Some(scale) = scale_sigma else {
        verdict.checked.push("metric: nothing in it has a known length".to_owned());
        let what = "it has no metres: nothing in it has a known length";
        return refuse(verdict, Severity::Refused, what.to_owned(), PUT_UP_TAGS);
    };
    let has_tags = !evidence.capture.tags.is_empty();
    let scale = 3.0 * scale;
    verdict.checked.push(format!("metric: scale known to {:.2} % (three sigmas)", 100.0 * scale));
    if scale > MOST_SCALE {
        let what = format!("its scale is known to no better than {:.1} %", 100.0 * scale);
        let remedy = if has_tags {
            "put up more tags, far apart from each other, and film each from several sides"
        } else {
            PUT_UP_TAGS
        };
        refuse(verdict, Severity::Refused, what, remedy);
    }
    let Some(tilt) = tilt_sigma_rad.map(|sigma| (3.0 * sigma).to_degrees()) else {
        verdict.checked.push("metric: nothing tells which way is up".to_owned());
        let remedy = "measure where the tags stand, or pick three points of the floor (`vizflyt scene align`)";
        let what = "it may lie on its side: nothing tells which way is up";
        return refuse(verdict, Severity::Refused, what.to_owned(), remedy);
    };
    verdict.checked.push(format!("metric: up known to {tilt:.2} degrees (three sigmas)"));
    if tilt > MOST_TILT_DEG {
        let what = format!("which way is up is known to no better than {tilt:.1} degrees");
        let remedy = if has_tags {
            "put tags farther apart, or measure their places again"
        } else {
            "measure where tags stand, or pick three points of the floor (`vizflyt scene align`)"
        };
        refuse(verdict, Severity::Refused, what, remedy);
    }
}

const PUT_UP_TAGS: &str = "put up printed tags (`vizflyt tags print`) and film again, give the camera's track \
                           (--track), or give a length that you measure";
/// 15 cm of error across a room of 10 m: more than a vehicle keeps clear of a wall by.
const MOST_SCALE: f64 = 0.015;
/// The same on its height.
const MOST_TILT_DEG: f64 = 0.9;
