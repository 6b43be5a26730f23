//! Grade as JUnit XML, for continuous integration: one test per flight.

use std::fmt::Write;
use std::path::Path;

use anyhow::{Context, Result, ensure};
use vizflyt_protocol::messages::OutcomeKind;

use super::document::Grade;
use super::report::escape;

pub(crate) fn write(path: &Path, grade: &Grade) -> Result<()> {
    std::fs::write(path, text(grade)).with_context(|| format!("cannot write {}", path.display()))
}

/// Checks that a file is the JUnit XML of a grade, as [`write`] makes it.
///
/// # Errors
/// If it cannot be read, or differs.
pub(crate) fn verify(path: &Path, grade: &Grade) -> Result<()> {
    let found = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    ensure!(
        found == text(grade).as_bytes(),
        "{} is not the JUnit XML of this grade: it was changed, or another version wrote it",
        path.display()
    );
    Ok(())
}

/// Returns the content of the file.
pub(crate) fn text(grade: &Grade) -> String {
    let subject = &grade.subject;
    let (plugin, project) = (escape(&subject.plugin), escape(&subject.project));
    let failed = grade.summary.runs - grade.summary.finished;
    let mut text = format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<testsuites>\n<testsuite name=\"{plugin} {project}\" \
         tests=\"{}\" failures=\"{failed}\" errors=\"0\" time=\"{:.3}\">\n",
        grade.summary.runs,
        grade.runs.iter().map(|run| run.seconds).sum::<f64>()
    );
    for run in &grade.runs {
        let _ = write!(
            text,
            "<testcase classname=\"{project}.{}\" name=\"seed {}\" time=\"{:.3}\"",
            escape(&run.variant),
            run.seed,
            run.seconds
        );
        if run.outcome == OutcomeKind::Finished {
            text += "/>\n";
        } else {
            let cause = run.cause.as_deref().unwrap_or(&run.reason);
            let _ = writeln!(
                text,
                "><failure type=\"{}\" message=\"{}\">{}; {} of {} stages, score {:.0}</failure></testcase>",
                run.outcome,
                escape(cause).replace(['\n', '\t'], " "),
                escape(&run.reason),
                run.stages_passed,
                run.stages.len(),
                run.score
            );
        }
    }
    text + "</testsuite>\n</testsuites>\n"
}

#[cfg(test)]
mod tests {
    use super::super::document::tests::grade;
    use super::*;

    #[test]
    fn writes_a_test_per_flight_and_escapes_text() {
        let mut grade = grade();
        grade.runs[0].cause = Some("a < b & \"c\"\nd".to_owned());
        let text = text(&grade);
        for part in [
            "tests=\"2\" failures=\"1\"",
            "<testcase classname=\"forest.day\" name=\"seed 3\" time=\"10.300\"/>",
            "<failure type=\"collided\" message=\"a &lt; b &amp; &quot;c&quot; d\">",
        ] {
            assert!(text.contains(part), "{part} is missing in {text}");
        }
        assert_eq!(text.matches("<testcase").count(), 2);
        let file = tempfile::NamedTempFile::new().unwrap();
        write(file.path(), &grade).unwrap();
        verify(file.path(), &grade).unwrap();
        std::fs::write(file.path(), text.replace("failures=\"1\"", "failures=\"0\"")).unwrap();
        let error = verify(file.path(), &grade).unwrap_err().to_string();
        assert!(error.contains("is not the JUnit XML of this grade"), "{error}");
    }
}
