//! Signed grades on the leaderboard: stored once each, ranked separately from runs in the lab.
//!
//! The caller has verified the signature; this module stores figures and text.

use std::cmp::Ordering;
use std::collections::BTreeMap;

use serde::Serialize;
use sqlx::Row;
use sqlx::any::AnyRow;

use super::store::unix_ms;
use super::{Leaderboard, LeaderboardError};

/// Grade as stored by the leaderboard.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GradeEntry {
    pub team: String,
    /// Hash over all flights, from the grade.
    pub hash: String,
    /// Hash of the plugin's files.
    pub plugin_sha256: String,
    /// Name of the project.
    pub project: String,
    /// `ug` or `g`: the sensors of the plugin.
    pub level: String,
    /// Variants, seeds and delays as text: only grades with equal conditions can be compared.
    pub conditions: String,
    /// Number of flights.
    pub flights: u32,
    /// Number of finished flights.
    pub finished: u32,
    /// Stages of the course.
    pub stages: u32,
    /// Mean of the stages passed.
    pub mean_stages_passed: f64,
    /// Median time of the finished flights, with penalties. [s]
    pub median_s: Option<f64>,
    /// Mean score, 0 to 100.
    pub score: f64,
}

/// Place of a team among the grades of the same course and conditions.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GradePlace {
    /// Rank from 1; equal grades share it.
    pub rank: u32,
    /// Number of the team's grades here; the best counts.
    pub grades: u32,
    #[serde(flatten)]
    pub best: GradeEntry,
}

/// Places on one course under the same conditions.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GradeBoard {
    /// Name of the project.
    pub project: String,
    /// `ug` or `g`.
    pub level: String,
    /// Variants, seeds and delays as text.
    pub conditions: String,
    /// Places, best first.
    pub places: Vec<GradePlace>,
}

/// Ranks grades separately for each project, level and conditions. Most stages on average first; then the larger
/// share of finished flights; then the least median time.
pub fn grade_boards(grades: &[GradeEntry]) -> Vec<GradeBoard> {
    let mut boards: BTreeMap<[&str; 3], BTreeMap<&str, (&GradeEntry, u32)>> = BTreeMap::new();
    for grade in grades {
        let board = boards.entry([&grade.project, &grade.level, &grade.conditions]).or_default();
        let (kept, count) = board.entry(&grade.team).or_insert((grade, 0));
        *count += 1;
        if compare(grade, kept) == Ordering::Less {
            *kept = grade;
        }
    }
    boards
        .into_iter()
        .map(|([project, level, conditions], best)| GradeBoard {
            project: project.to_owned(),
            level: level.to_owned(),
            conditions: conditions.to_owned(),
            places: places(best.into_values().collect()),
        })
        .collect()
}

fn places(mut best: Vec<(&GradeEntry, u32)>) -> Vec<GradePlace> {
    // Stable: equal grades share a rank, in alphabetical order.
    best.sort_by(|(a, _), (b, _)| compare(a, b));
    let mut places: Vec<GradePlace> = Vec::with_capacity(best.len());
    for (index, (grade, grades)) in best.into_iter().enumerate() {
        let shared = places.last().filter(|last| compare(&last.best, grade) == Ordering::Equal);
        let rank = shared.map_or(index as u32 + 1, |last| last.rank);
        places.push(GradePlace { rank, grades, best: grade.clone() });
    }
    places
}

/// The better grade is less.
fn compare(a: &GradeEntry, b: &GradeEntry) -> Ordering {
    let share = |grade: &GradeEntry| f64::from(grade.finished) / f64::from(grade.flights.max(1));
    let seconds = |grade: &GradeEntry| grade.median_s.unwrap_or(f64::INFINITY);
    b.mean_stages_passed
        .total_cmp(&a.mean_stages_passed)
        .then(share(b).total_cmp(&share(a)))
        .then(seconds(a).total_cmp(&seconds(b)))
}

impl Leaderboard {
    /// Adds a grade whose signature was verified, with its complete text.
    ///
    /// # Errors
    /// The team does not exist, or the grade has been added before, by any team.
    pub async fn add_grade(
        &self,
        grade: &GradeEntry,
        document: &str,
    ) -> Result<(), LeaderboardError> {
        let done = sqlx::query(
            "INSERT INTO grades (hash, plugin_sha256, team, project, level, conditions, added_unix_ms, flights, \
             finished, stages, mean_stages_passed, median_s, score, document) \
             VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13, $14) ON CONFLICT DO NOTHING",
        )
        .bind(&grade.hash)
        .bind(&grade.plugin_sha256)
        .bind(&grade.team)
        .bind(&grade.project)
        .bind(&grade.level)
        .bind(&grade.conditions)
        .bind(unix_ms())
        .bind(i64::from(grade.flights))
        .bind(i64::from(grade.finished))
        .bind(i64::from(grade.stages))
        .bind(grade.mean_stages_passed)
        .bind(grade.median_s)
        .bind(grade.score)
        .bind(document)
        .execute(&self.pool)
        .await;
        match done {
            Ok(done) if done.rows_affected() > 0 => Ok(()),
            Ok(_) => Err(self.added_by(grade).await?),
            Err(sqlx::Error::Database(error)) if error.is_foreign_key_violation() => {
                Err(self.no_team(&grade.team).await)
            }
            Err(error) => Err(self.failed(error)),
        }
    }

    /// Returns all grades, the oldest first.
    ///
    /// # Errors
    /// Errors of the database.
    pub async fn grades(&self) -> Result<Vec<GradeEntry>, LeaderboardError> {
        let rows = sqlx::query(
            "SELECT team, hash, plugin_sha256, project, level, conditions, flights, finished, stages, \
             mean_stages_passed, median_s, score FROM grades ORDER BY added_unix_ms, hash",
        )
        .fetch_all(&self.pool)
        .await
        .map_err(|error| self.failed(error))?;
        rows.iter().map(entry).collect::<Result<_, _>>().map_err(|error| self.failed(error))
    }

    /// Returns the error that names the team which added a grade.
    async fn added_by(&self, grade: &GradeEntry) -> Result<LeaderboardError, LeaderboardError> {
        let row = sqlx::query("SELECT team FROM grades WHERE hash = $1 AND plugin_sha256 = $2")
            .bind(&grade.hash)
            .bind(&grade.plugin_sha256)
            .fetch_one(&self.pool)
            .await
            .map_err(|error| self.failed(error))?;
        let team = row.try_get(0).map_err(|error| self.failed(error))?;
        Ok(LeaderboardError::Added { hash: grade.hash.clone(), team })
    }
}

fn entry(row: &AnyRow) -> Result<GradeEntry, sqlx::Error> {
    let count = |index: usize| row.try_get::<i64, _>(index).map(|count| count as u32);
    Ok(GradeEntry {
        team: row.try_get(0)?,
        hash: row.try_get(1)?,
        plugin_sha256: row.try_get(2)?,
        project: row.try_get(3)?,
        level: row.try_get(4)?,
        conditions: row.try_get(5)?,
        flights: count(6)?,
        finished: count(7)?,
        stages: count(8)?,
        mean_stages_passed: row.try_get(9)?,
        median_s: row.try_get(10)?,
        score: row.try_get(11)?,
    })
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Returns a grade of ten flights; the hash follows from its figures.
    pub(crate) fn grade(team: &str, stages: f64, finished: u32, median_s: f64) -> GradeEntry {
        GradeEntry {
            team: team.to_owned(),
            hash: format!("{stages} {finished} {median_s}"),
            plugin_sha256: format!("of {team}"),
            project: "p5".to_owned(),
            level: "ug".to_owned(),
            conditions: "day, seeds 1 to 10".to_owned(),
            flights: 10,
            finished,
            stages: 5,
            mean_stages_passed: stages,
            median_s: (finished > 0).then_some(median_s),
            score: 20.0 * stages,
        }
    }

    fn ranks(grades: &[GradeEntry]) -> Vec<(u32, String, u32)> {
        let boards = grade_boards(grades);
        assert_eq!(boards.len(), 1);
        let places = boards.into_iter().flat_map(|board| board.places);
        places.map(|place| (place.rank, place.best.team, place.grades)).collect()
    }

    #[test]
    fn more_stages_win_then_more_finishes_then_less_time() {
        let grades = [
            grade("a", 4.0, 2, 20.0),
            grade("b", 4.5, 0, 0.0),
            grade("c", 4.0, 3, 40.0),
            grade("d", 4.0, 2, 19.0),
            // The better of two counts.
            grade("d", 1.0, 0, 0.0),
            grade("e", 4.0, 2, 20.0),
        ];
        let expected = [(1, "b", 1), (2, "c", 1), (3, "d", 2), (4, "a", 1), (4, "e", 1)];
        let expected = expected.map(|(rank, team, count)| (rank, team.to_owned(), count));
        assert_eq!(ranks(&grades), expected);
        let turned: Vec<_> = grades.iter().rev().cloned().collect();
        assert_eq!(ranks(&turned), expected);
    }

    #[test]
    fn incomparable_grades_are_ranked_separately() {
        let own = grade("a", 4.0, 2, 20.0);
        let others = [
            GradeEntry { project: "p4".into(), ..own.clone() },
            GradeEntry { level: "g".into(), ..own.clone() },
            GradeEntry { conditions: "night, seeds 1 to 10".into(), ..own.clone() },
            own,
        ];
        let boards = grade_boards(&others);
        assert_eq!(boards.len(), 4);
        assert!(boards.iter().all(|board| board.places[0].rank == 1));
    }
}
