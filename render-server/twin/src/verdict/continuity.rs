//! Continuity check: a hand-held camera neither leaps nor spins between images.
//!
//! Each step between consecutive images has a speed and a rotation rate. A value far above the usual one means that one
//! of the two images, or all following ones, have a wrong pose. The check needs no scale.

use super::walk::Walk;
use super::{Check, Finding, Severity, Verdict};

/// A step between two consecutive images.
struct WalkStep {
    /// Index of the second image.
    to: usize,
    speed: f64,
    turn_radps: f64,
    length: f64,
    turn_rad: f64,
}

/// Adds leaps and spins: first of structure from motion's poses; if those have none, of the adjusted poses.
pub(super) fn check(walk: &Walk<'_>, verdict: &mut Verdict) {
    let as_found = walk.as_found();
    if !check_one(&as_found, verdict) && walk.evidence.adjusted.is_ok() {
        verdict.checked.pop();
        check_one(walk, verdict);
    }
}

/// Returns whether there were findings.
fn check_one(walk: &Walk<'_>, verdict: &mut Verdict) -> bool {
    let before = verdict.findings.len();
    leaps(walk, verdict);
    verdict.findings.len() > before
}

fn leaps(walk: &Walk<'_>, verdict: &mut Verdict) {
    if walk.given().iter().all(|given| given.at_s.is_none()) {
        // Photos are taken anywhere and are sorted by name.
        verdict.checked.push("continuity: not checked, photos have no times".to_owned());
        return;
    }
    let steps = steps(walk);
    if steps.len() < FEW {
        verdict.checked.push("continuity: too few images with a time".to_owned());
        return;
    }
    let usual_speed = quantile(steps.iter().map(|step| step.speed), USUAL);
    let usual_turn = quantile(steps.iter().map(|step| step.turn_radps), USUAL);
    let most_turn = (TIMES * usual_turn).max(LEAST_SPIN_RADPS);
    let mut most_speed = TIMES * usual_speed;
    if walk.is_metric {
        most_speed = most_speed.clamp(LEAST_LEAP_MPS, MOST_MPS.max(LEAST_LEAP_MPS));
    }
    let (unit, per_second) = if walk.is_metric { ("m", "m/s") } else { ("units", "units/s") };
    let fastest = steps.iter().map(|step| step.speed).fold(0.0, f64::max);
    let quickest = steps.iter().map(|step| step.turn_radps).fold(0.0, f64::max);
    verdict.checked.push(format!(
        "continuity: {usual_speed:.2} {per_second} at three of four steps and {fastest:.2} at most, {:.0} and {:.0} \
         degrees/s",
        usual_turn.to_degrees(),
        quickest.to_degrees()
    ));
    let mut found: Vec<(f64, &WalkStep, bool)> = steps
        .iter()
        .filter_map(|step| {
            let leap = step.speed / most_speed;
            let spin = step.turn_radps / most_turn;
            (leap.max(spin) > 1.0).then_some((leap.max(spin), step, leap >= spin))
        })
        .collect();
    if found.is_empty() {
        return stands_out(walk, &steps, usual_speed, verdict);
    }
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    let name = |image: usize| &walk.evidence.capture.images[image].name;
    let tell = |&(_, step, is_leap): &(f64, &WalkStep, bool)| {
        let (from, to) = (name(step.to - 1), name(step.to));
        if is_leap {
            let times = step.speed / usual_speed;
            format!("{:.1} {unit} from {from} to {to}, {times:.0} times the usual", step.length)
        } else {
            format!("a turn of {:.0} degrees from {from} to {to}", step.turn_rad.to_degrees())
        }
    };
    let told: Vec<String> = found.iter().take(TOLD).map(tell).collect();
    let rest = found.len().saturating_sub(TOLD);
    let more = if rest > 0 { format!(", and {rest} more") } else { String::new() };
    let images = walk.runs(found.iter().flat_map(|(_, step, _)| [step.to - 1, step.to]));
    let when = walk.spans(&images);
    verdict.findings.push(Finding {
        severity: Severity::Refused,
        check: Check::Continuity,
        what: format!("the path of the camera has impossible jumps: {}{more}", told.join("; ")),
        remedy: format!(
            "film that part again in one go, slowly, with more of what is particular to the place in view: {when}"
        ),
        images,
    });
}

/// Warns about steps much longer than their neighbours: a model that came apart and was joined again with a small
/// error.
fn stands_out(walk: &Walk<'_>, steps: &[WalkStep], usual_speed: f64, verdict: &mut Verdict) {
    let alone: Vec<&WalkStep> = steps
        .windows(3)
        .filter(|three| {
            let around = three[0].speed.max(three[2].speed).max(usual_speed);
            three[1].speed > ALONE * around
        })
        .map(|three| &three[1])
        .collect();
    if alone.is_empty() {
        return;
    }
    let images = walk.runs(alone.iter().flat_map(|step| [step.to - 1, step.to]));
    verdict.findings.push(Finding {
        severity: Severity::Warning,
        check: Check::Continuity,
        what: format!("a step is much longer than those around it: {}", walk.spans(&images)),
        remedy: "if you did not take a longer step there, the model was split and joined again: film that part again, \
                 slowly"
            .to_owned(),
        images,
    });
}

fn steps(walk: &Walk<'_>) -> Vec<WalkStep> {
    let images = &walk.evidence.capture.images;
    (1..images.len())
        .filter_map(|to| {
            let seconds = images[to].at_s - images[to - 1].at_s;
            let (a, b) = (&walk.poses[to - 1], &walk.poses[to]);
            let length = a.translation_m.distance(b.translation_m);
            let turn_rad = 2.0 * a.rotation.dot(b.rotation).abs().min(1.0).acos();
            (seconds > 0.0).then(|| WalkStep {
                to,
                speed: length / seconds,
                turn_radps: turn_rad / seconds,
                length,
                turn_rad,
            })
        })
        .collect()
}

/// Returns a quantile.
fn quantile(values: impl Iterator<Item = f64>, share: f64) -> f64 {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_by(f64::total_cmp);
    sorted[((sorted.len() - 1) as f64 * share) as usize]
}

/// Minimum number of steps that determine a usual speed.
const FEW: usize = 6;
/// Quantile of the usual speed: in a walk with stops to look around, half of the steps are short.
const USUAL: f64 = 0.75;
/// Maximum ratio to the usual speed.
const TIMES: f64 = 4.0;
/// Maximum ratio to the speed of the neighbouring steps.
const ALONE: f64 = 1.6;
/// Minimum speed of a leap: people who film slowly may still take a quick step. [m/s]
const LEAST_LEAP_MPS: f64 = 1.5;
/// Maximum speed: people do not film while running. [m/s]
const MOST_MPS: f64 = 5.0;
/// Minimum rate of a spin: faster rotation blurs all images. [rad/s]
const LEAST_SPIN_RADPS: f64 = 2.5;
/// Maximum number of leaps in a message.
const TOLD: usize = 3;
