//! Leaderboard: runs of lab flights, teams and their standings, in a database.
//!
//! ```text
//! recorder (a task for each vehicle) -> begin, keep_alive, end -> runs
//! `vizflyt leaderboard team add`     -> teams, their tokens
//! `vizflyt leaderboard add`          -> grades, their signatures verified
//! runs -> standings (pure) -> page, wall view, command line;  runs -> CSV
//! grades -> grade_boards (pure) -> page, command line
//! ```
//! The database is SQLite in a file by default, or `PostgreSQL` by URL for a department, with the same queries.
//! A run is a row from its take-off on. If a server is killed in flight, only that run's end is lost, and the
//! run becomes [`RunState::CutOff`].

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

/// Type of a flight.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Attempt {
    /// Unlimited; shown, but not ranked first.
    #[default]
    Practice,
    /// Ranked; a course may limit the number per team.
    Official,
}

impl Attempt {
    /// Returns the name used by the database and the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Practice => "practice",
            Self::Official => "official",
        }
    }
}

/// State of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RunState {
    /// In the air.
    Flying,
    /// Ended, with a verdict.
    Ended,
    /// Its server stopped in flight: it has no verdict.
    CutOff,
}

/// Data of a run at its start.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NewRun {
    /// Name of the team; `None` if no team has checked in.
    pub team: Option<String>,
    /// Name of the arena.
    pub course: String,
    /// The vehicle's name.
    pub vehicle: String,
    pub attempt: Attempt,
}

/// Result of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct RunEnd {
    /// Word or sentence: `finished`, `collision`.
    pub outcome: String,
    /// Stages passed, including the goal.
    pub stages_passed: u32,
    /// Stages of the course.
    pub stages: u32,
    /// Time from take-off to the end, without penalties. [s]
    pub seconds: Option<f64>,
    /// Penalties. [s]
    pub penalty_s: f64,
    /// Least distance from the body's surface to an obstacle. [m]
    pub min_clearance_m: Option<f64>,
    /// Complete verdict, JSON.
    pub verdict: String,
}

/// Run as stored by the leaderboard.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Run {
    /// Random id.
    pub id: String,
    /// Name of the team, if one has checked in.
    pub team: Option<String>,
    /// Name of the arena.
    pub course: String,
    /// The vehicle's name.
    pub vehicle: String,
    pub attempt: Attempt,
    pub state: RunState,
    /// Time of the take-off, UTC. [ms since 1970]
    pub began_unix_ms: i64,
    /// Time of the end, UTC. [ms since 1970]
    pub ended_unix_ms: Option<i64>,
    /// Word or sentence; empty until the run ends.
    pub outcome: String,
    /// Stages passed.
    pub stages_passed: u32,
    /// Stages of the course.
    pub stages: u32,
    /// Time from take-off to the end, without penalties. [s]
    pub seconds: Option<f64>,
    /// Penalties. [s]
    pub penalty_s: f64,
    /// Least distance from the body's surface to an obstacle. [m]
    pub min_clearance_m: Option<f64>,
}

/// Team as shown to an instructor.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Team {
    pub name: String,
    /// Time of its creation, UTC. [ms since 1970]
    pub created_unix_ms: i64,
    /// Whether its token is revoked.
    pub retired: bool,
}
