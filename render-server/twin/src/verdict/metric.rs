//! Check of scale and vertical: whether they are known, and how accurately.

use super::{Check, Evidence, Finding, Severity, Verdict};

/// Adds a finding for each quantity that is unknown or inaccurate.
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
        verdict.checked.push("metric: nothing in the capture has a known length".to_owned());
        let what = "the scale is unknown: nothing in the capture has a known length";
        return refuse(verdict, Severity::Refused, what.to_owned(), PUT_UP_TAGS);
    };
    let has_tags = !evidence.capture.tags.is_empty();
    let scale = 3.0 * scale;
    verdict.checked.push(format!("metric: scale known to {:.2} % (three sigmas)", 100.0 * scale));
    if scale > MOST_SCALE {
        let what = format!("the scale is known only to {:.1} %", 100.0 * scale);
        let remedy = if has_tags {
            "put up more tags, far apart from each other, and film each from several sides"
        } else {
            PUT_UP_TAGS
        };
        refuse(verdict, Severity::Refused, what, remedy);
    }
    let Some(tilt) = tilt_sigma_rad.map(|sigma| (3.0 * sigma).to_degrees()) else {
        verdict.checked.push("metric: nothing in the capture determines the vertical".to_owned());
        let remedy = "measure where the tags stand, or pick three points of the floor (`vizflyt scene align`)";
        let what = "the vertical is unknown: nothing in the capture determines it";
        return refuse(verdict, Severity::Refused, what.to_owned(), remedy);
    };
    verdict.checked.push(format!("metric: vertical known to {tilt:.2} degrees (three sigmas)"));
    if tilt > MOST_TILT_DEG {
        let what = format!("the vertical is known only to {tilt:.1} degrees");
        let remedy = if has_tags {
            "put tags farther apart, or measure their positions again"
        } else {
            "measure where tags stand, or pick three points of the floor (`vizflyt scene align`)"
        };
        refuse(verdict, Severity::Refused, what, remedy);
    }
}

const PUT_UP_TAGS: &str = "put up printed tags (`vizflyt tags print`) and film again, give the camera's track \
                           (--track), or give a length that you measure";
/// Maximum scale error: 15 cm across a room of 10 m, more than a vehicle's distance from walls.
const MOST_SCALE: f64 = 0.015;
/// Maximum tilt: the same error in height.
const MOST_TILT_DEG: f64 = 0.9;
