//! Standings from runs, pure: most stages first, then the least time; the rule of the paper.

use std::cmp::Ordering;
use std::collections::BTreeMap;

use serde::Serialize;

use super::{Attempt, Run, RunState};

/// Place of a team.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Standing {
    /// Rank from 1; equal runs share it.
    pub rank: u32,
    pub team: String,
    /// Stages passed in its best run.
    pub stages_passed: u32,
    /// Stages of the course.
    pub stages: u32,
    /// Time of its best run, with penalties. [s]
    pub seconds: Option<f64>,
    /// Number of ended runs that count here.
    pub runs: u32,
    /// Id of the best run.
    pub run: String,
}

/// Ranks the teams of one course by their best ended run of this type; runs without a team have no place.
pub fn standings(runs: &[Run], course: &str, attempt: Attempt) -> Vec<Standing> {
    let mut best: BTreeMap<&str, (&Run, u32)> = BTreeMap::new();
    for run in runs {
        let counts = run.course == course && run.attempt == attempt && run.state == RunState::Ended;
        let (true, Some(team)) = (counts, &run.team) else { continue };
        let (kept, count) = best.entry(team).or_insert((run, 0));
        *count += 1;
        if compare(run, kept) == Ordering::Less {
            *kept = run;
        }
    }
    let mut best: Vec<_> = best.into_iter().collect();
    // Stable: equal runs share a rank, in alphabetical order.
    best.sort_by(|(_, (a, _)), (_, (b, _))| compare(a, b));
    let mut places: Vec<Standing> = Vec::with_capacity(best.len());
    let mut before: Option<(&Run, u32)> = None;
    for (index, (team, (run, runs))) in best.into_iter().enumerate() {
        let rank = match before {
            Some((other, rank)) if compare(other, run) == Ordering::Equal => rank,
            _ => index as u32 + 1,
        };
        before = Some((run, rank));
        places.push(Standing {
            rank,
            team: team.to_owned(),
            stages_passed: run.stages_passed,
            stages: run.stages,
            seconds: run.seconds.map(|seconds| seconds + run.penalty_s),
            runs,
            run: run.id.clone(),
        });
    }
    places
}

/// The better run is less.
fn compare(a: &Run, b: &Run) -> Ordering {
    let seconds = |run: &Run| run.seconds.map_or(f64::INFINITY, |seconds| seconds + run.penalty_s);
    b.stages_passed.cmp(&a.stages_passed).then(seconds(a).total_cmp(&seconds(b)))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::flights::leaderboard::tests::run;

    fn places(runs: &[Run]) -> Vec<(u32, String)> {
        let places = standings(runs, "race", Attempt::Official);
        places.into_iter().map(|place| (place.rank, place.team)).collect()
    }

    #[test]
    fn more_stages_win_then_less_time_with_penalties() {
        let penalised = Run { penalty_s: 5.0, ..run("wasps", 4, 20.0) };
        let runs = [run("bees", 3, 9.0), penalised, run("ants", 4, 24.0), run("bees", 2, 5.0)];
        let expected = [(1, "ants"), (2, "wasps"), (3, "bees")];
        assert_eq!(places(&runs), expected.map(|(rank, team)| (rank, team.to_owned())));
        assert_eq!(standings(&runs, "race", Attempt::Official)[2].runs, 2);
    }

    #[test]
    fn equal_runs_share_a_place_and_the_next_is_skipped() {
        let runs = [run("b", 2, 9.0), run("a", 2, 9.0), run("c", 1, 1.0)];
        assert_eq!(places(&runs), [(1, "a".into()), (1, "b".into()), (3, "c".into())]);
    }

    #[test]
    fn practice_runs_are_not_ranked() {
        let ended = run("a", 2, 9.0);
        let others = [
            Run { team: None, ..ended.clone() },
            Run { course: "forest".into(), ..ended.clone() },
            Run { attempt: Attempt::Practice, ..ended.clone() },
            Run { state: RunState::CutOff, ..ended.clone() },
            Run { state: RunState::Flying, ..ended },
        ];
        assert!(places(&others).is_empty());
    }

    proptest! {
        /// No place depends on the order of the runs, and no later place is better.
        #[test]
        fn order_does_not_matter(
            flown in proptest::collection::vec((0..6_usize, 0..5_u32, 0..40_u32), 0..40), turn in 0..40_usize,
        ) {
            let runs: Vec<Run> = flown
                .iter()
                .map(|&(team, stages, seconds)| run(&format!("team {team}"), stages, f64::from(seconds)))
                .collect();
            let mut turned = runs.clone();
            turned.rotate_left(turn.min(runs.len()));
            prop_assert_eq!(places(&runs), places(&turned));
            let found = standings(&runs, "race", Attempt::Official);
            for pair in found.windows(2) {
                let better = (std::cmp::Reverse(pair[0].stages_passed), pair[0].seconds);
                prop_assert!(better <= (std::cmp::Reverse(pair[1].stages_passed), pair[1].seconds));
            }
        }
    }
}
