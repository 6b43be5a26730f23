//! Changes since an earlier attempt: compares flights with the same seed and variant.

use std::collections::HashMap;
use std::path::Path;

use anyhow::{Context, Result, ensure};
use vizflyt_protocol::messages::OutcomeKind;

use super::args::FlyArgs;
use super::document::{Grade, Run, Subject, Summary};
use super::figures::{NAMED, flight, outcome};
use super::folder::GRADE;

/// Minimum score difference that counts as a change.
const SAME_SCORE: f64 = 0.5;
/// Minimum time difference that counts as a change. [s]
const SAME_S: f64 = 0.5;

/// Returns the grade to compare with: that of `--since`, or of the report that `--report` replaces;
/// `None` if there is none.
///
/// # Errors
/// If `--since` is not a grade.
pub(super) fn earlier(args: &FlyArgs) -> Result<Option<Grade>> {
    if let Some(path) = &args.since {
        return read(path).map(Some).context("--since");
    }
    let report = args.report.as_deref().filter(|_| !args.resume);
    // An unreadable grade there is ignored: opening the report's folder reports it.
    Ok(report.and_then(|folder| Grade::read(&folder.join(GRADE)).ok()))
}

fn read(path: &Path) -> Result<Grade> {
    let file = if path.is_dir() { path.join(GRADE) } else { path.to_owned() };
    Grade::read(&file)
}

/// Checks that two grades can be compared.
///
/// # Errors
/// The first difference.
pub(super) fn check(earlier: &Subject, now: &Subject) -> Result<()> {
    let differs = |what: &str, earlier: &str, now: &str| {
        ensure!(earlier == now, "the earlier attempt is of {what} {earlier}, this one of {now}");
        Ok(())
    };
    let team = |subject: &Subject| subject.team.clone().unwrap_or("no team".to_owned());
    differs("team", &team(earlier), &team(now))?;
    differs("project", &earlier.project, &now.project)?;
    differs("level", &earlier.level, &now.level)?;
    let courses = |subject: &Subject| subject.courses.clone().unwrap_or("public".to_owned());
    differs("courses", &courses(earlier), &courses(now))
}

/// Returns the changes, one line each; empty if no flight was flown both times.
pub(super) fn lines(earlier: &Grade, now: &Grade) -> Vec<String> {
    let key = |run: &Run| (run.variant.clone(), run.seed);
    let before: HashMap<(String, u64), &Run> =
        earlier.runs.iter().map(|run| (key(run), run)).collect();
    let both: Vec<(&Run, &Run)> =
        now.runs.iter().filter_map(|run| Some((*before.get(&key(run))?, run))).collect();
    if both.is_empty() {
        return Vec::new();
    }
    if both.iter().all(|(before, after)| before.hash == after.hash) {
        return vec![format!("nothing changed: {} flights went as before", both.len())];
    }
    let of =
        |pick: fn(&(&Run, &Run)) -> Run| Summary::of(&both.iter().map(pick).collect::<Vec<_>>());
    let (old, new) = (of(|both| both.0.clone()), of(|both| both.1.clone()));
    let optional = |value: Option<f64>, unit: &str, digits: usize| {
        value.map_or("-".to_owned(), |value| format!("{value:.digits$} {unit}"))
    };
    let mut lines = vec![format!(
        "score {:.1} -> {:.1}, finished {} -> {} of {}, time {} -> {}, clearance {} -> {}",
        old.score.value,
        new.score.value,
        old.finished,
        new.finished,
        both.len(),
        optional(old.mean_finish_s, "s", 1),
        optional(new.mean_finish_s, "s", 1),
        optional(old.min_clearance_m, "m", 2),
        optional(new.min_clearance_m, "m", 2),
    )];
    let is = |better: bool| {
        both.iter().filter(move |(before, after)| {
            step(before, after) == if better { Trend::Better } else { Trend::Worse }
        })
    };
    for (word, better) in [("better", true), ("worse", false)] {
        let all = is(better).count();
        for (before, after) in is(better).take(NAMED) {
            lines.push(format!("{word}: {}", told(now, before, after)));
        }
        if all > NAMED {
            lines.push(format!("{word}: {} more", all - NAMED));
        }
    }
    lines
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Trend {
    Better,
    Worse,
    Alike,
}

/// Compares scores, then the times of two finished flights.
fn step(before: &Run, after: &Run) -> Trend {
    let finished = [before, after].iter().all(|run| run.outcome == OutcomeKind::Finished);
    let seconds = |run: &Run| run.seconds + run.penalty_s;
    match (after.score - before.score, seconds(after) - seconds(before)) {
        (more, _) if more > SAME_SCORE => Trend::Better,
        (more, _) if more < -SAME_SCORE => Trend::Worse,
        (_, longer) if finished && longer < -SAME_S => Trend::Better,
        (_, longer) if finished && longer > SAME_S => Trend::Worse,
        _ => Trend::Alike,
    }
}

fn told(grade: &Grade, before: &Run, after: &Run) -> String {
    let ended = |run: &Run| match run.outcome {
        OutcomeKind::Finished => format!("finished in {:.1} s", run.seconds + run.penalty_s),
        _ => outcome(run),
    };
    let why = match &after.cause {
        Some(cause) => format!("; {cause}"),
        None => String::new(),
    };
    format!("{}: {} -> {}{why}", flight(grade, after), ended(before), ended(after))
}

#[cfg(test)]
mod tests {
    use super::super::document::tests::{run, subject};
    use super::*;

    fn grade(runs: Vec<Run>) -> Grade {
        Grade::new(subject(), None, runs)
    }

    fn flown(seed: u64, outcome: OutcomeKind, score: f64, seconds: f64) -> Run {
        let hash = format!("{seed}-{outcome}-{score}-{seconds}");
        Run { score, seconds, penalty_s: 0.0, hash, ..run(seed, outcome) }
    }

    #[test]
    fn compares_flights_by_seed_and_variant() {
        use OutcomeKind::{Collided, Finished};
        let earlier = grade(vec![
            flown(1, Collided, 50.0, 8.0),
            flown(2, Finished, 100.0, 20.0),
            flown(3, Finished, 100.0, 20.0),
            flown(9, Collided, 0.0, 1.0),
        ]);
        let now = grade(vec![
            flown(1, Finished, 100.0, 21.0),
            flown(2, Collided, 25.0, 5.0),
            flown(3, Finished, 100.0, 18.0),
            flown(4, Finished, 100.0, 18.0),
        ]);
        let lines = lines(&earlier, &now);
        assert!(
            lines[0].contains("finished 2 -> 2 of 3"),
            "seeds 4 and 9 were flown once: {lines:?}"
        );
        assert!(lines[0].contains("score 83.3 -> 75.0"), "{lines:?}");
        assert!(lines[1].starts_with("better: seed 1: collided"), "{lines:?}");
        assert!(lines[1].contains("-> finished in 21.0 s"), "{lines:?}");
        assert!(lines[2].starts_with("better: seed 3: finished in 20.0 s -> "), "{lines:?}");
        assert!(lines[3].starts_with("worse: seed 2: finished in 20.0 s -> collided"), "{lines:?}");
        assert_eq!(lines.len(), 4);
    }

    #[test]
    fn reports_unchanged_flights_and_ignores_others() {
        let one = grade(vec![flown(1, OutcomeKind::Finished, 100.0, 9.0)]);
        assert_eq!(lines(&one, &one), ["nothing changed: 1 flights went as before"]);
        let other = grade(vec![flown(2, OutcomeKind::Finished, 100.0, 9.0)]);
        assert_eq!(lines(&one, &other), Vec::<String>::new());
    }

    #[test]
    fn counts_many_flights() {
        let all =
            |score| (1..=9).map(|seed| flown(seed, OutcomeKind::Collided, score, 9.0)).collect();
        let lines = lines(&grade(all(10.0)), &grade(all(20.0)));
        assert_eq!(lines.len(), 1 + NAMED + 1, "{lines:?}");
        assert_eq!(lines[NAMED + 1], "better: 4 more");
    }

    #[test]
    fn rejects_another_course_or_team() {
        let p4 = subject();
        let p5 = Subject { project: "p5-other".into(), ..subject() };
        let error = check(&p4, &p5).unwrap_err().to_string();
        assert!(error.contains("of project") && error.contains("p5-other"), "{error}");
        let red = Subject { team: Some("red".into()), ..subject() };
        let error = check(&p4, &red).unwrap_err().to_string();
        assert!(error.contains("of team no team, this one of red"), "{error}");
        assert!(check(&p4, &Subject { plugin_sha256: "00".into(), ..subject() }).is_ok());
    }
}
