//! Summary of a grade as text, and output as a file or JSON.

use anyhow::{Context, Result};
use vizflyt_process::print_line;
use vizflyt_protocol::messages::OutcomeKind;

use super::args::ResultArgs;
use super::document::{Grade, PartPoints, Run, VariantSummary};

/// Maximum number of flights that are listed.
pub(super) const NAMED: usize = 5;

/// Writes a grade to the requested file, and prints it as JSON or text.
pub(super) fn hand_over(grade: &Grade, args: &ResultArgs) -> Result<()> {
    if let Some(path) = &args.output {
        let text = grade.to_text()?;
        std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))?;
    }
    if args.json {
        print_line(grade.to_text()?.trim_end());
    } else {
        print(grade);
    }
    Ok(())
}

/// Prints the results over all flights, the points, and why flights did not finish.
pub(super) fn print(grade: &Grade) {
    let summary = &grade.summary;
    print_line(format!(
        "score       {:.1} (95 %: {:.1} to {:.1})",
        summary.score.value, summary.score.low, summary.score.high
    ));
    print_line(format!(
        "finished    {} of {} (95 %: {:.0} to {:.0} %)",
        summary.finished,
        summary.runs,
        summary.finish_share.low * 100.0,
        summary.finish_share.high * 100.0
    ));
    for VariantSummary { variant, summary } in &grade.by_variant {
        print_line(format!(
            "  {variant:<12}{:.1} (95 %: {:.1} to {:.1}), finished {} of {}",
            summary.score.value,
            summary.score.low,
            summary.score.high,
            summary.finished,
            summary.runs
        ));
    }
    if let Some(mean_s) = summary.mean_finish_s {
        print_line(format!("time        {mean_s:.1} s to the finish, mean"));
    }
    if let Some((run, clearance_m)) = nearest(grade) {
        print_line(format!("clearance   {clearance_m:.2} m minimum, {}", flight(grade, run)));
    }
    if let Some((points, most)) = grade.all_points() {
        print_line(format!("points      {points:.1} of {most:.0}"));
    }
    for line in points(grade) {
        print_line(format!("  {line}"));
    }
    let failed: Vec<&Run> =
        grade.runs.iter().filter(|run| run.outcome != OutcomeKind::Finished).collect();
    for run in failed.iter().take(NAMED) {
        let why = run.cause.as_deref().unwrap_or(&run.reason);
        print_line(format!("  {}: {}; {why}", flight(grade, run), outcome(run)));
    }
    if failed.len() > NAMED {
        print_line(format!("  and {} more did not finish", failed.len() - NAMED));
    }
    print_line(format!("hash        {}", grade.hash));
}

/// Returns one line for each part of the points: points, figure, and what is missing for more.
pub(super) fn points(grade: &Grade) -> Vec<String> {
    let line = |part: &PartPoints| {
        let name = name_of(&part.part);
        let figure =
            part.value.map_or(String::new(), |value| format!("   {}", figure(&part.part, value)));
        let missing = part.missing.as_ref().map_or(String::new(), |why| format!("; {why}"));
        format!("{name:<10}{:.1} of {:.0}{figure}{missing}", part.points, part.of)
    };
    grade.points.iter().map(line).collect()
}

/// Returns the name of a row of a table of points.
pub(super) fn name_of(part: &str) -> &str {
    part.rsplit_once('_').map_or(part, |(name, _)| name)
}

/// Returns the figure of a row of a table of points, with its unit.
pub(super) fn figure(part: &str, value: f64) -> String {
    match part {
        "time_s" => format!("{value:.1} s"),
        "clearance_m" => format!("{value:.2} m"),
        "speed_mps" => format!("{value:.2} m/s"),
        _ => format!("{value:.1}"),
    }
}

/// Returns the name of a flight: its seed, and its variant if there are several.
pub(super) fn flight(grade: &Grade, run: &Run) -> String {
    match &grade.subject.variants[..] {
        [_, _, ..] => format!("seed {}, {}", run.seed, run.variant),
        _ => format!("seed {}", run.seed),
    }
}

/// Returns the outcome of a flight, and the next stage if it did not finish.
pub(super) fn outcome(run: &Run) -> String {
    let name = run.outcome.name().replace('_', " ");
    let next = run.stages.iter().find(|stage| stage.passed_s.is_none());
    match next {
        Some(stage) if run.outcome != OutcomeKind::Finished => {
            format!("{name} before {}", stage.name)
        }
        _ => name,
    }
}

/// Returns the flight with the least clearance, and that clearance. [m]
fn nearest(grade: &Grade) -> Option<(&Run, f64)> {
    let near = grade.runs.iter().filter_map(|run| Some((run, run.min_clearance_m?)));
    near.min_by(|a, b| a.1.total_cmp(&b.1))
}
