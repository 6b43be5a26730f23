//! Connection check: images must share points. Two parts joined by few points may have any relative pose, and bundle
//! adjustment does not report it.

use super::walk::Walk;
use super::{Check, Finding, Severity, Verdict};

/// Number of points that each pair of images shares.
pub(super) struct Shared {
    images: usize,
    counts: Vec<u32>,
}

impl Shared {
    pub(super) fn new(walk: &Walk<'_>) -> Self {
        let images = walk.evidence.capture.images.len();
        let mut counts = vec![0; images * images];
        for seen in by_point(walk) {
            for (i, &a) in seen.iter().enumerate() {
                for &b in &seen[i + 1..] {
                    counts[a * images + b] += 1;
                    counts[b * images + a] += 1;
                }
            }
        }
        Self { images, counts }
    }

    pub(super) fn between(&self, a: usize, b: usize) -> u32 {
        self.counts[a * self.images + b]
    }
}

/// Returns the images that saw each point, without duplicates, in ascending order.
fn by_point(walk: &Walk<'_>) -> Vec<Vec<usize>> {
    let mut seen = vec![Vec::new(); walk.points.len()];
    for (image, one) in walk.evidence.capture.images.iter().enumerate() {
        for sighting in &one.seen {
            if seen[sighting.point].last() != Some(&image) {
                seen[sighting.point].push(image);
            }
        }
    }
    seen
}

/// Adds a finding if the weakest joint is weak.
pub(super) fn check(walk: &Walk<'_>, shared: &Shared, verdict: &mut Verdict) {
    let images = shared.images;
    let least = (images / 20).max(PART);
    let Some(part) = weakest(shared, least) else {
        verdict.checked.push("connected: too few images to have parts".to_owned());
        return;
    };
    let joined = by_point(walk)
        .iter()
        .filter(|seen| {
            let inside = seen.iter().filter(|image| part[**image]).count();
            inside > 0 && inside < seen.len()
        })
        .count();
    let smaller = {
        let inside = part.iter().filter(|inside| **inside).count();
        let pick = inside * 2 <= images;
        (0..images).filter(|image| part[*image] == pick).collect::<Vec<_>>()
    };
    let count = smaller.len();
    let runs = walk.runs(smaller);
    verdict.checked.push(format!(
        "connected: the weakest joint, of {count} images with the other {}, has {joined} points",
        images - count
    ));
    let severity = match joined {
        0..FEW => Severity::Refused,
        FEW..SOME => Severity::Warning,
        _ => return,
    };
    verdict.findings.push(Finding {
        severity,
        check: Check::Connected,
        what: format!(
            "only {joined} points connect {count} images with the other {}: {}",
            images - count,
            walk.spans(&runs)
        ),
        remedy: "walk from one part into the other again, slowly and sideways, and back; or put up a tag that both see"
            .to_owned(),
        images: runs,
    });
}

/// Returns the images on one side of the weakest joint with at least `least` images on either side. This is the last
/// joint made if images with the most common points are joined first (J. Kruskal 1956).
fn weakest(shared: &Shared, least: usize) -> Option<Vec<bool>> {
    let images = shared.images;
    let mut pairs: Vec<(u32, usize, usize)> = (0..images)
        .flat_map(|a| (a + 1..images).map(move |b| (a, b)))
        .map(|(a, b)| (shared.between(a, b), a, b))
        .collect();
    pairs.sort_by(|x, y| y.0.cmp(&x.0).then((x.1, x.2).cmp(&(y.1, y.2))));
    let mut part: Vec<usize> = (0..images).collect();
    let mut weakest = None;
    for (_, a, b) in pairs {
        let (from, to) = (part[a], part[b]);
        if from == to {
            continue;
        }
        let size = |which: usize| part.iter().filter(|part| **part == which).count();
        if size(from) >= least && size(to) >= least {
            weakest = Some(part.iter().map(|part| *part == from).collect());
        }
        part.iter_mut().filter(|part| **part == from).for_each(|part| *part = to);
    }
    weakest
}

/// Minimum number of images of a part.
const PART: usize = 3;
/// Limit for refusal. Three points fix a similarity transform; several times as many fix it well despite outliers.
const FEW: usize = 20;
/// Limit for a warning: the joint is known, but less well than the parts themselves.
const SOME: usize = 60;
