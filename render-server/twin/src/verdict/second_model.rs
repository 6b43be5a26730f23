//! Comparison with other models of the same images: if two programs, or two runs of one, disagree, one is wrong.

use std::collections::HashMap;

use super::walk::Walk;
use super::{Check, Finding, Severity, Verdict};
use crate::align::points::{self, Pair};

/// Adds disagreements with other models.
pub(super) fn check(walk: &Walk<'_>, verdict: &mut Verdict) {
    for (number, other) in walk.evidence.others.iter().enumerate() {
        let number = number + 2;
        let here: HashMap<&str, usize> = walk
            .evidence
            .capture
            .images
            .iter()
            .enumerate()
            .map(|(index, image)| (image.name.as_str(), index))
            .collect();
        // (image index, pair of positions).
        let common: Vec<(usize, Pair)> = other
            .images
            .iter()
            .filter_map(|image| {
                let index = *here.get(image.name.as_str())?;
                let world_m = walk.poses[index].translation_m;
                Some((index, Pair { scene: image.scene_from_cam.translation_m, world_m }))
            })
            .collect();
        if common.len() < FEW {
            verdict.checked.push(format!(
                "model {number}: {} images, {} of them in the first: too few to compare",
                other.images.len(),
                common.len()
            ));
            continue;
        }
        let pairs: Vec<Pair> = common.iter().map(|(_, pair)| *pair).collect();
        let middle =
            pairs.iter().map(|pair| pair.world_m).sum::<glam::DVec3>() / pairs.len() as f64;
        let spread2: f64 = pairs.iter().map(|pair| pair.world_m.distance_squared(middle)).sum();
        let limit = DISAGREES * (spread2 / pairs.len() as f64).sqrt();
        let fit = points::fit(&pairs, limit / 3.0);
        let wrong: Vec<usize> = match &fit {
            Ok(fit) => common
                .iter()
                .filter(|(_, pair)| {
                    fit.world_from_scene.transform_point(pair.scene).distance(pair.world_m) > limit
                })
                .map(|(index, _)| *index)
                .collect(),
            Err(_) => common.iter().map(|(index, _)| *index).collect(),
        };
        let share = wrong.len() as f64 / common.len() as f64;
        verdict.checked.push(format!(
            "model {number}: {} images, {} of them in the first, of which {} have other positions",
            other.images.len(),
            common.len(),
            wrong.len()
        ));
        if wrong.is_empty() {
            continue;
        }
        let runs = walk.runs(wrong.iter().copied());
        let severity = if share > MANY { Severity::Refused } else { Severity::Warning };
        verdict.findings.push(Finding {
            severity,
            check: Check::SecondModel,
            what: format!(
                "another model of the same images has other positions for {} of {} images: {}",
                wrong.len(),
                common.len(),
                walk.spans(&runs)
            ),
            remedy: "one of the two is wrong, and it is unknown which; film that part again, slowly, with more of what \
                     is particular to the place in view"
                .to_owned(),
            images: runs,
        });
    }
}

/// Minimum number of common images: three fix a similarity transform.
const FEW: usize = 6;
/// Maximum difference relative to the spread of the walk; models of one walk agree within 1 %.
const DISAGREES: f64 = 0.04;
/// Limit for refusal: one image in twenty may be wrong in only one model.
const MANY: f64 = 0.05;
