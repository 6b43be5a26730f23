//! Stored data of a team: complete export and deletion.

use serde::Serialize;
use serde_json::Value;
use sqlx::Row;

use super::{Database, GradeEntry, Leaderboard, LeaderboardError, Run, RunState, Team};

/// All stored data of a team, except the hash of its token.
#[derive(Debug, Serialize)]
pub struct TeamRecords {
    /// Name, creation, and whether its token is revoked.
    pub team: Team,
    /// Flights in the lab, newest first.
    pub runs: Vec<RunRecord>,
    /// Grades, oldest first.
    pub grades: Vec<GradeRecord>,
}

/// A flight with its verdict.
#[derive(Debug, Serialize)]
pub struct RunRecord {
    #[serde(flatten)]
    pub run: Run,
    /// Verdict of the referee; absent for a run that was cut off.
    pub verdict: Option<Value>,
}

/// A grade with its document.
#[derive(Debug, Serialize)]
pub struct GradeRecord {
    #[serde(flatten)]
    pub grade: GradeEntry,
    /// Complete text of the grade, exactly as it was signed.
    pub document: String,
}

/// Numbers of deleted records.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Erased {
    pub runs: u64,
    pub grades: u64,
}

impl Leaderboard {
    /// Returns all stored data of a team.
    ///
    /// # Errors
    /// The team does not exist.
    pub async fn records_of(&self, name: &str) -> Result<TeamRecords, LeaderboardError> {
        let teams = self.teams().await?;
        let Some(team) = teams.into_iter().find(|team| team.name == name) else {
            return Err(self.no_team(name).await);
        };
        let mut runs = Vec::new();
        for run in self.runs(None).await? {
            if run.team.as_deref() == Some(name) {
                let verdict = self.verdict(&run.id).await?;
                let verdict = verdict.and_then(|text| serde_json::from_str(&text).ok());
                runs.push(RunRecord { run, verdict });
            }
        }
        let mut grades = Vec::new();
        for grade in self.grades().await?.into_iter().filter(|grade| grade.team == name) {
            let document =
                sqlx::query("SELECT document FROM grades WHERE hash = $1 AND plugin_sha256 = $2")
                    .bind(&grade.hash)
                    .bind(&grade.plugin_sha256)
                    .fetch_one(&self.pool)
                    .await
                    .and_then(|row| row.try_get::<String, _>(0))
                    .map_err(|error| self.failed(error))?;
            grades.push(GradeRecord { grade, document });
        }
        Ok(TeamRecords { team, runs, grades })
    }

    /// Deletes a team with its flights and grades in one transaction, also from the bytes of a file. Places of
    /// others move up.
    ///
    /// # Errors
    /// The team does not exist, or is flying.
    pub async fn erase_team(&self, name: &str) -> Result<Erased, LeaderboardError> {
        let runs = self.runs(None).await?;
        let flies = |run: &Run| run.team.as_deref() == Some(name) && run.state == RunState::Flying;
        if runs.iter().any(flies) {
            return Err(LeaderboardError::Flying(name.to_owned()));
        }
        let erase = async {
            let mut all = self.pool.begin().await?;
            let mut counts = [0; 3];
            let tables = [
                "DELETE FROM grades WHERE team = $1",
                "DELETE FROM runs WHERE team = $1",
                "DELETE FROM teams WHERE name = $1",
            ];
            for (statement, count) in tables.into_iter().zip(&mut counts) {
                *count =
                    sqlx::query(statement).bind(name).execute(&mut *all).await?.rows_affected();
            }
            all.commit().await?;
            if matches!(self.database, Database::File(_)) {
                // The write-ahead log still contains the old rows.
                sqlx::query("PRAGMA wal_checkpoint(TRUNCATE)").execute(&self.pool).await?;
            }
            Ok(counts)
        };
        match erase.await.map_err(|error| self.failed(error))? {
            [_, _, 0] => Err(self.no_team(name).await),
            [grades, runs, _] => Ok(Erased { runs, grades }),
        }
    }
}
