//! Who flew what how well: runs of lab flights, teams and their standings, in a database that outlives the server.
//!
//! ```text
//! recorder (a task for each vehicle) -> begin, keep_alive, end -> runs
//! `vizflyt leaderboard team add`     -> teams, their tokens
//! `vizflyt leaderboard add`          -> grades, their signatures verified
//! runs -> standings (pure) -> page, wall view, command line;  runs -> CSV
//! grades -> grade_boards (pure) -> page, command line
//! ```
//! SQLite in a file by default, `PostgreSQL` by URL for a department; one set of queries for both. A run is
//! a row from its take-off on: a server killed in flight loses that run's end, which is then
//! [`RunState::CutOff`], and nothing else.

mod database_url;
mod export;
pub(crate) mod grades;
mod records;
mod standings;
mod store;
#[cfg(test)]
pub(crate) mod tests;

pub use database_url::{Database, UnknownDatabase};
pub use export::write_csv;
pub use grades::{GradeBoard, GradeEntry, GradePlace, grade_boards};
pub use records::{Erased, GradeRecord, RunRecord, TeamRecords};
pub use standings::{Standing, standings};
pub use store::{Leaderboard, LeaderboardError, MAX_RUNS};

use serde::{Deserialize, Serialize};

/// What a flight counts as.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Attempt {
    /// As often as one likes; shown, not ranked first.
    #[default]
    Practice,
    /// Counts; a course may bound how many a team has.
    Official,
}

impl Attempt {
    /// Returns its name as the database and the command line have it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Practice => "practice",
            Self::Official => "official",
        }
    }
}

/// How far a run is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RunState {
    /// In the air.
    Flying,
    /// Ended, with a verdict.
    Ended,
    /// Its server went away in flight: it has no verdict.
    CutOff,
}

/// What is known of a run when it begins.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NewRun {
    /// Whose; `None` where no team has checked in.
    pub team: Option<String>,
    /// The arena's name.
    pub course: String,
    /// The vehicle's name.
    pub vehicle: String,
    /// What it counts as.
    pub attempt: Attempt,
}

/// What a run came to.
#[derive(Clone, Debug, PartialEq)]
pub struct RunEnd {
    /// In a word or a sentence: `finished`, `collision`.
    pub outcome: String,
    /// Stages passed, the goal among them.
    pub stages_passed: u32,
    /// Stages that the course has.
    pub stages: u32,
    /// From take-off to the end, penalties not added. [s]
    pub seconds: Option<f64>,
    /// To be added. [s]
    pub penalty_s: f64,
    /// Least distance from the body's surface to an obstacle. [m]
    pub min_clearance_m: Option<f64>,
    /// The whole verdict, JSON.
    pub verdict: String,
}

/// A run as the leaderboard keeps it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Run {
    /// Random.
    pub id: String,
    /// Whose.
    pub team: Option<String>,
    /// The arena's name.
    pub course: String,
    /// The vehicle's name.
    pub vehicle: String,
    /// What it counts as.
    pub attempt: Attempt,
    /// How far it is.
    pub state: RunState,
    /// Its take-off, UTC. [ms since 1970]
    pub began_unix_ms: i64,
    /// Its end, UTC. [ms since 1970]
    pub ended_unix_ms: Option<i64>,
    /// In a word or a sentence; empty until it ends.
    pub outcome: String,
    /// Stages passed.
    pub stages_passed: u32,
    /// Stages that the course has.
    pub stages: u32,
    /// From take-off to the end, penalties not added. [s]
    pub seconds: Option<f64>,
    /// To be added. [s]
    pub penalty_s: f64,
    /// Least distance from the body's surface to an obstacle. [m]
    pub min_clearance_m: Option<f64>,
}

/// A team as an instructor sees it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Team {
    /// Its name.
    pub name: String,
    /// When it was added, UTC. [ms since 1970]
    pub created_unix_ms: i64,
    /// Whether its token opens nothing any more.
    pub retired: bool,
}
