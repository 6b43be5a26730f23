//! Check of tags: each has one position, which agrees with the images and with the other tags.

use glam::{DVec2, DVec3};

use super::walk::Walk;
use super::{Check, Finding, Severity, Verdict};
use crate::adjust::{Adjusted, TagResult};
use crate::align::corners::Ray;

/// Adds tags that contradict the images or each other.
pub(super) fn check(walk: &Walk<'_>, verdict: &mut Verdict) {
    let Ok(adjusted) = walk.evidence.adjusted else { return };
    let tags = &walk.evidence.capture.tags;
    if tags.is_empty() {
        return;
    }
    for tag in 0..tags.len() {
        match &adjusted.tags[tag] {
            Some(result) => somewhere_else(walk, tag, result, verdict),
            None => nowhere(walk, tag, verdict),
        }
    }
    held_out(walk, adjusted, verdict);
    in_one_place(walk, adjusted, verdict);
}

fn images_of(walk: &Walk<'_>, tag: usize) -> Vec<usize> {
    let images = walk.evidence.capture.images.iter().enumerate();
    let sees = images.filter(|(_, image)| image.tags.iter().any(|seen| seen.tag == tag));
    sees.map(|(index, _)| index).collect()
}

fn add(walk: &Walk<'_>, verdict: &mut Verdict, tags: &[usize], what: &str, remedy: &str) {
    let images = walk.runs(tags.iter().flat_map(|tag| images_of(walk, *tag)));
    verdict.findings.push(Finding {
        severity: Severity::Refused,
        check: Check::Tags,
        what: format!("{what}: {}", walk.spans(&images)),
        remedy: remedy.to_owned(),
        images,
    });
}

fn somewhere_else(walk: &Walk<'_>, tag: usize, result: &TagResult, verdict: &mut Verdict) {
    let TagResult { sightings, contradicting, .. } = *result;
    if contradicting < CONTRADICTING || (contradicting as f64) < SHARE * sightings as f64 {
        return;
    }
    let name = &walk.evidence.capture.tags[tag].name;
    let what = if contradicting == sightings {
        format!("{name} is not where it was measured to be, in all {sightings} images that show it")
    } else {
        format!("{name} is in two places: {contradicting} of {sightings} images see it elsewhere")
    };
    let remedy = "if it hangs where the layout says and no other tag has its number, these images are in the wrong \
                  place: film there again, with more of what is particular to the place in view";
    add(walk, verdict, &[tag], &what, remedy);
}

/// Adds a finding if a tag's rays do not meet although they should.
fn nowhere(walk: &Walk<'_>, tag: usize, verdict: &mut Verdict) {
    let images = images_of(walk, tag);
    let rays: Vec<Ray> = images
        .iter()
        .filter_map(|&image| {
            let seen =
                walk.evidence.capture.images[image].tags.iter().find(|seen| seen.tag == tag)?;
            let middle_px = seen.corners_px.iter().sum::<DVec2>() / 4.0;
            let slope = walk.lens.slope(middle_px)?;
            let pose = &walk.poses[image];
            let direction = (pose.rotation * slope.extend(1.0)).normalize();
            Some(Ray { origin: pose.translation_m, direction })
        })
        .collect();
    let (mut meet, mut pass) = (0usize, 0usize);
    for (i, a) in rays.iter().enumerate() {
        for b in &rays[i + 1..] {
            match passes_by(a, b) {
                Some(true) => pass += 1,
                Some(false) => meet += 1,
                None => {}
            }
        }
    }
    if images.len() < CONTRADICTING || pass == 0 || pass < meet / 4 {
        return;
    }
    let name = &walk.evidence.capture.tags[tag].name;
    let what = format!(
        "{name} has no position: the {} images that show it point to different places",
        images.len()
    );
    let remedy = "look for another tag of the same number; if there is none, these images are in the wrong place: \
                  film there again, with more of what is particular to the place in view";
    add(walk, verdict, &[tag], &what, remedy);
}

/// Returns whether two rays miss each other, or would meet behind a camera; `None` if they are too parallel.
fn passes_by(a: &Ray, b: &Ray) -> Option<bool> {
    let across = a.direction.cross(b.direction);
    let sine2 = across.length_squared();
    if sine2 < PARALLEL * PARALLEL {
        return None;
    }
    let between = b.origin - a.origin;
    // Distance along each ray at which it is nearest to the other.
    let along_a = between.cross(b.direction).dot(across) / sine2;
    let along_b = between.cross(a.direction).dot(across) / sine2;
    let apart = between.dot(across).abs() / sine2.sqrt();
    Some(along_a <= 0.0 || along_b <= 0.0 || apart > PASSES_BY * along_a.max(along_b))
}

fn held_out(walk: &Walk<'_>, adjusted: &Adjusted, verdict: &mut Verdict) {
    let results = || {
        adjusted
            .tags
            .iter()
            .enumerate()
            .filter_map(|(tag, result)| Some((tag, (*result)?.held_out?)))
    };
    let off_m: Vec<f64> = results().filter_map(|(_, held)| held.off_m).collect();
    let size: Vec<f64> = results().map(|(_, held)| held.size_error).collect();
    let rms = |values: &[f64]| {
        (values.iter().map(|x| x * x).sum::<f64>() / values.len().max(1) as f64).sqrt()
    };
    let (line, wrong): (String, Vec<usize>) = if off_m.is_empty() {
        if size.is_empty() {
            verdict.checked.push("tags: fewer than two could be held out".to_owned());
            return;
        }
        let line = format!("tags held out: {} edges, {:.2} % rms", size.len(), 100.0 * rms(&size));
        let is_wrong = |held: &crate::adjust::HeldOut| held.size_error.abs() > MOST_SIZE;
        (line, results().filter(|(_, held)| is_wrong(held)).map(|(tag, _)| tag).collect())
    } else {
        let line = format!(
            "tags held out: {} are off by {:.1} cm rms, {:.1} cm at worst",
            off_m.len(),
            100.0 * rms(&off_m),
            100.0 * off_m.iter().copied().fold(0.0, f64::max)
        );
        let is_off = |held: &crate::adjust::HeldOut| held.off_m.is_some_and(|m| m > MOST_OFF_M);
        // Rays to a tag seen at a flat angle, seldom, or from one side meet far from its true position.
        let is_wrong = |held: &crate::adjust::HeldOut| {
            let doubt_m = (DOUBT_PX * held.by_pixel_m).min(MOST_DOUBT_M);
            is_off(held) && held.rms_px > MOST_OFF_PX && held.off_m.is_some_and(|m| m > doubt_m)
        };
        let unclear: Vec<&str> = results()
            .filter(|(_, held)| is_off(held) && !is_wrong(held))
            .map(|(tag, _)| walk.evidence.capture.tags[tag].name.as_str())
            .collect();
        if !unclear.is_empty() {
            verdict.checked.push(format!(
                "tags held out: {} were seen too seldom, or from too few sides, to determine their positions",
                unclear.join(", ")
            ));
        }
        (line, results().filter(|(_, held)| is_wrong(held)).map(|(tag, _)| tag).collect())
    };
    verdict.checked.push(line.clone());
    let inset_px = adjusted.inset_px;
    if inset_px.abs() > MOST_INSET_PX {
        let how = if inset_px > 0.0 { "smaller" } else { "larger" };
        let what = format!(
            "tags are {how} than they should be for the distances between them: their corners are found {:.1} px {} \
             where they belong",
            inset_px.abs(),
            if inset_px > 0.0 { "inside" } else { "outside" }
        );
        let remedy = "measure the black edge of a print, and the distance between two tags: a printer that fits to the \
                      page makes tags smaller";
        add(walk, verdict, &results().map(|(tag, _)| tag).collect::<Vec<_>>(), &what, remedy);
    }
    if wrong.is_empty() {
        return;
    }
    let names: Vec<&str> =
        wrong.iter().map(|tag| walk.evidence.capture.tags[*tag].name.as_str()).collect();
    let what = format!("{line}; {} contradict the other tags", names.join(", "));
    let remedy = "measure again where these tags stand; if that is right, the images around them are in the wrong \
                  place: film there again, each tag from several sides";
    add(walk, verdict, &wrong, &what, remedy);
}

/// Adds a finding for each two tags at the same position.
fn in_one_place(walk: &Walk<'_>, adjusted: &Adjusted, verdict: &mut Verdict) {
    let tags = &walk.evidence.capture.tags;
    let found: Vec<(usize, DVec3)> = adjusted
        .tags
        .iter()
        .enumerate()
        .filter_map(|(tag, result)| Some((tag, (*result)?.corners_m.iter().sum::<DVec3>() / 4.0)))
        .collect();
    for (i, &(a, at_a)) in found.iter().enumerate() {
        for &(b, at_b) in &found[i + 1..] {
            let size_m = tags[a].size_m.min(tags[b].size_m);
            if at_a.distance(at_b) < ONE_PLACE * size_m {
                let what = format!("{} and {} are in one place", tags[a].name, tags[b].name);
                let remedy = "two places that look alike were merged; film both again, and the path from one to \
                              the other in one go, with what differs between them in view";
                add(walk, verdict, &[a, b], &what, remedy);
            }
        }
    }
}

/// Minimum number of contradicting images; a misread tag occurs in one image.
const CONTRADICTING: usize = 3;
/// Minimum fraction of contradicting images.
const SHARE: f64 = 0.25;
/// Minimum sine of the angle between rays, five degrees: more parallel rays do not determine an intersection.
const PARALLEL: f64 = 0.09;
/// Maximum distance between rays relative to their length; poses of good captures are ten times more accurate.
const PASSES_BY: f64 = 0.05;
/// Maximum error of a held-out tag; good captures have a few centimetres. [m]
const MOST_OFF_M: f64 = 0.15;
/// Maximum reprojection error of a held-out tag: blur and rolling shutter cause less; a tag that is 15 cm off is 20 px
/// off at 4 m. [px]
const MOST_OFF_PX: f64 = 4.0;
/// Assumed combined error of corners and of the poses around a held-out tag. [px]
const DOUBT_PX: f64 = 4.0;
/// Maximum tolerated position error by such uncertainty. [m]
const MOST_DOUBT_M: f64 = 0.4;
/// Maximum relative error of a tag's edge length.
const MOST_SIZE: f64 = 0.1;
/// Maximum inset; in images of our own captures, white bleeds into black by 0.1 to 0.2. [px]
const MOST_INSET_PX: f64 = 0.6;
/// Minimum distance of two tags, in edge lengths.
const ONE_PLACE: f64 = 0.7;
