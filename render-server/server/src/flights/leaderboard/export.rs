//! Export of runs as CSV (RFC 4180), for a spreadsheet.

use std::io::Write;

use super::Run;

/// Writes the runs with a header line. Text that a spreadsheet would treat as a formula gets an apostrophe in
/// front, as in spreadsheets: teams choose their names.
///
/// # Errors
/// Errors of `out`.
pub fn write_csv(runs: &[Run], out: impl Write) -> Result<(), csv::Error> {
    let mut writer = csv::Writer::from_writer(out);
    writer.write_record([
        "id",
        "team",
        "course",
        "vehicle",
        "attempt",
        "state",
        "began_unix_ms",
        "ended_unix_ms",
        "outcome",
        "stages_passed",
        "stages",
        "seconds",
        "penalty_s",
        "min_clearance_m",
    ])?;
    let number = |value: Option<f64>| value.map_or_else(String::new, |value| value.to_string());
    for run in runs {
        let state = serde_json::to_value(run.state).unwrap_or_default();
        writer.write_record([
            run.id.as_str(),
            &plain(run.team.as_deref().unwrap_or("")),
            &plain(&run.course),
            &plain(&run.vehicle),
            run.attempt.name(),
            state.as_str().unwrap_or(""),
            &run.began_unix_ms.to_string(),
            &run.ended_unix_ms.map_or_else(String::new, |ms| ms.to_string()),
            &plain(&run.outcome),
            &run.stages_passed.to_string(),
            &run.stages.to_string(),
            &number(run.seconds),
            &run.penalty_s.to_string(),
            &number(run.min_clearance_m),
        ])?;
    }
    writer.flush()?;
    Ok(())
}

fn plain(text: &str) -> String {
    let is_formula = text.starts_with(['=', '+', '-', '@', '\t', '\r']);
    if is_formula { format!("'{text}") } else { text.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flights::leaderboard::tests::run;

    #[test]
    fn fields_are_quoted_and_formulas_are_text() {
        let mut hostile = run("=cmd|' /C calc'!A0", 2, 12.5);
        hostile.outcome = "said \"stop\", landed".into();
        let mut out = Vec::new();
        write_csv(&[hostile], &mut out).unwrap();
        let text = String::from_utf8(out).unwrap();
        let line = text.lines().nth(1).unwrap();
        assert!(line.contains(",'=cmd|' /C calc'!A0,race,"), "{line}");
        assert!(line.contains(",\"said \"\"stop\"\", landed\",2,5,12.5,0,"), "{line}");
    }
}
