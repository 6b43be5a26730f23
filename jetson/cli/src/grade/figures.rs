//! A grade as figures for people, on standard output, and as a file.

use std::path::Path;

use anyhow::{Context, Result};

use super::args::ResultArgs;
use super::document::{Grade, VariantSummary};
use crate::terminal::print_line;

/// Prints a grade, and writes it where it was asked for.
pub(super) fn hand_over(grade: &Grade, args: &ResultArgs) -> Result<()> {
    if let Some(path) = &args.output {
        write(path, &grade.to_text()?)?;
    }
    if args.json {
        print_line(grade.to_text()?.trim_end());
        return Ok(());
    }
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
        print_line(format!("time        {mean_s:.1} s to the finish, on average"));
    }
    if let Some(clearance_m) = summary.min_clearance_m {
        print_line(format!("clearance   {clearance_m:.2} m at least"));
    }
    print_line(format!("hash        {}", grade.hash));
    Ok(())
}

fn write(path: &Path, text: &str) -> Result<()> {
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}
