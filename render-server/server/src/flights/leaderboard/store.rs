//! Database of teams and runs. Each change is one transaction that is on disk when the call returns.

use std::collections::BTreeSet;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use sqlx::any::{AnyPoolOptions, AnyRow};
use sqlx::migrate::{Migration, MigrationType, Migrator};
use sqlx::{AnyConnection, AnyPool, Connection, Executor, Row, SqlSafeStr};
use vizflyt_trust::{Fingerprint, secret};

use super::{Attempt, Database, NewRun, Run, RunEnd, RunState, Team};

#[derive(Clone, Debug)]
pub struct Leaderboard {
    pub(super) pool: AnyPool,
    pub(super) database: Database,
}

/// Errors of the leaderboard.
#[derive(Debug, thiserror::Error)]
pub enum LeaderboardError {
    /// The database cannot be opened.
    #[error("cannot open the leaderboard {0}: {1}; give another with --leaderboard")]
    Open(Database, sqlx::Error),
    /// The program has no support for this database.
    #[error(
        "this program was built without PostgreSQL, where the leaderboard {0} is; build it with \
         `cargo build --release --features postgres`"
    )]
    NoPostgres(Database),
    /// The tables are of a later version, or of another program.
    #[error("cannot use the leaderboard {0}: {1}; was it made by a later version of this program?")]
    Migrate(Database, sqlx::migrate::MigrateError),
    /// The folder of the database file cannot be created.
    #[error("cannot make the folder of the leaderboard {0}: {1}; give another with --leaderboard")]
    Folder(Database, std::io::Error),
    /// A query failed.
    #[error("the leaderboard {0} fails: {1}")]
    Query(Database, sqlx::Error),
    /// Invalid name of a team.
    #[error(
        "{0:?} is not a valid team name; give 1 to {MAX_NAME} characters without control characters"
    )]
    Name(String),
    /// A team of this name exists.
    #[error("there is a team '{0}' already; take another name")]
    Taken(String),
    /// The team does not exist.
    #[error("there is no team '{0}'; the teams are: {1}")]
    NoTeam(String, String),
    /// The team's flight is not over.
    #[error(
        "team '{0}' is flying; wait until its run has ended, or for a minute if its server has stopped"
    )]
    Flying(String),
    /// No official attempts left.
    #[error("team '{team}' has flown its {most} official attempts on '{course}'; practice is free")]
    Spent {
        team: String,
        course: String,
        /// Maximum number of attempts.
        most: u32,
    },
    /// The grade has been added before.
    #[error("the grade {hash} is on the leaderboard already: team '{team}' has added it")]
    Added {
        /// Hash over all flights.
        hash: String,
        /// Team that added it.
        team: String,
    },
    /// No random numbers for a token.
    #[error("cannot draw a token: {0}")]
    Random(String),
}

impl Leaderboard {
    /// Opens a database, creates or updates its tables, and ends runs whose server has stopped.
    ///
    /// # Errors
    /// A file or server that cannot be used.
    pub async fn open(database: &Database) -> Result<Self, LeaderboardError> {
        if matches!(database, Database::Postgres(_)) && !cfg!(feature = "postgres") {
            return Err(LeaderboardError::NoPostgres(database.clone()));
        }
        sqlx::any::install_default_drivers();
        if let Database::File(path) = database
            && let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty())
        {
            std::fs::create_dir_all(folder)
                .map_err(|error| LeaderboardError::Folder(database.clone(), error))?;
        }
        let is_file = matches!(database, Database::File(_));
        // SQLite allows only one writer; a department's server serves several labs.
        let options = AnyPoolOptions::new()
            .max_connections(if is_file { 1 } else { 4 })
            .acquire_timeout(PATIENCE)
            .after_connect(move |connection, _| {
                Box::pin(async move {
                    if is_file {
                        // Readers, including the command line, do not delay the end of a flight. FULL: data are
                        // on disk when the call returns, even after a power cut.
                        connection.execute("PRAGMA busy_timeout = 5000").await?;
                        connection.execute("PRAGMA journal_mode = WAL").await?;
                        connection.execute("PRAGMA synchronous = FULL").await?;
                        connection.execute("PRAGMA foreign_keys = ON").await?;
                        // Deleted data are overwritten.
                        connection.execute("PRAGMA secure_delete = ON").await?;
                    }
                    Ok(())
                })
            });
        let open = |error| LeaderboardError::Open(database.clone(), error);
        // Connects once without the pool: the pool would retry, and report only a timeout.
        let mut first = AnyConnection::connect(&database.url()).await.map_err(open)?;
        if is_file {
            first.execute("PRAGMA schema_version").await.map_err(open)?;
        }
        first.close().await.map_err(open)?;
        let pool = options.connect(&database.url()).await.map_err(open)?;
        migrations(&MIGRATIONS)
            .run(&pool)
            .await
            .map_err(|error| LeaderboardError::Migrate(database.clone(), error))?;
        let board = Self { pool, database: database.clone() };
        board.cut_off_unheard(unix_ms()).await?;
        Ok(board)
    }

    pub fn database(&self) -> &Database {
        &self.database
    }

    /// Adds a team; returns its token, which cannot be shown again.
    ///
    /// # Errors
    /// A name that is taken or invalid.
    pub async fn add_team(&self, name: &str) -> Result<String, LeaderboardError> {
        let is_name = (1..=MAX_NAME).contains(&name.chars().count());
        if !is_name || name.trim() != name || name.chars().any(char::is_control) {
            return Err(LeaderboardError::Name(name.to_owned()));
        }
        let token = secret().map_err(LeaderboardError::Random)?;
        let added = sqlx::query(
            "INSERT INTO teams (name, token_hash, created_unix_ms) VALUES ($1, $2, $3) ON CONFLICT DO NOTHING",
        )
        .bind(name)
        .bind(hash(&token))
        .bind(unix_ms())
        .execute(&self.pool)
        .await
        .map_err(|error| self.failed(error))?;
        match added.rows_affected() {
            0 => Err(LeaderboardError::Taken(name.to_owned())),
            _ => Ok(token),
        }
    }

    /// Revokes a team's token; its runs stay.
    ///
    /// # Errors
    /// The team does not exist.
    pub async fn retire_team(&self, name: &str) -> Result<(), LeaderboardError> {
        let done = sqlx::query("UPDATE teams SET retired = 1 WHERE name = $1")
            .bind(name)
            .execute(&self.pool)
            .await
            .map_err(|error| self.failed(error))?;
        if done.rows_affected() == 0 {
            return Err(self.no_team(name).await);
        }
        Ok(())
    }

    /// Returns the teams, sorted by name.
    ///
    /// # Errors
    /// Errors of the database.
    pub async fn teams(&self) -> Result<Vec<Team>, LeaderboardError> {
        let rows = sqlx::query("SELECT name, created_unix_ms, retired FROM teams ORDER BY name")
            .fetch_all(&self.pool)
            .await
            .map_err(|error| self.failed(error))?;
        let team = |row: &AnyRow| {
            Ok(Team {
                name: row.try_get(0)?,
                created_unix_ms: row.try_get(1)?,
                retired: row.try_get::<i64, _>(2)? != 0,
            })
        };
        rows.iter().map(team).collect::<Result<_, _>>().map_err(|error| self.failed(error))
    }

    /// Returns the team of a token; `None` if it is unknown or revoked.
    ///
    /// # Errors
    /// Errors of the database.
    pub async fn team_of(&self, token: &str) -> Result<Option<String>, LeaderboardError> {
        // The query uses the hash, so that its duration reveals nothing about the token.
        let row = sqlx::query("SELECT name FROM teams WHERE token_hash = $1 AND retired = 0")
            .bind(hash(token))
            .fetch_optional(&self.pool)
            .await
            .map_err(|error| self.failed(error))?;
        row.map(|row| row.try_get(0)).transpose().map_err(|error| self.failed(error))
    }

    /// Begins a run; returns its id. With `most_official`, a team's official runs beyond that number are
    /// rejected; runs that were cut off do not count.
    ///
    /// # Errors
    /// The team does not exist, or has no attempts left.
    pub async fn begin(
        &self,
        new: &NewRun,
        most_official: Option<u32>,
    ) -> Result<String, LeaderboardError> {
        let id = secret().map_err(LeaderboardError::Random)?;
        let now = unix_ms();
        // One statement counts and inserts, so that two servers cannot both take the last attempt.
        let done = sqlx::query(
            "INSERT INTO runs (id, team, course, vehicle, attempt, state, began_unix_ms, heard_unix_ms) \
             SELECT $1, $2, $3, $4, $5, 'flying', $6, $7 \
             WHERE $8 = 0 OR (SELECT COUNT(*) FROM runs WHERE team = $9 AND course = $10 \
             AND attempt = 'official' AND state <> 'cut_off') < $11",
        )
        .bind(&id)
        .bind(&new.team)
        .bind(&new.course)
        .bind(&new.vehicle)
        .bind(new.attempt.name())
        .bind(now)
        .bind(now)
        .bind(i64::from(new.attempt == Attempt::Official && most_official.is_some()))
        .bind(&new.team)
        .bind(&new.course)
        .bind(i64::from(most_official.unwrap_or(0)))
        .execute(&self.pool)
        .await;
        match (done, &new.team) {
            (Ok(done), _) if done.rows_affected() > 0 => Ok(id),
            (Ok(_), team) => Err(LeaderboardError::Spent {
                team: team.clone().unwrap_or_default(),
                course: new.course.clone(),
                most: most_official.unwrap_or(0),
            }),
            (Err(sqlx::Error::Database(error)), Some(team)) if error.is_foreign_key_violation() => {
                Err(self.no_team(team).await)
            }
            (Err(error), _) => Err(self.failed(error)),
        }
    }

    /// Marks a run as still flown. Call every few seconds: after a minute without a mark, a run is cut off.
    ///
    /// # Errors
    /// Errors of the database.
    pub async fn keep_alive(&self, id: &str) -> Result<(), LeaderboardError> {
        sqlx::query("UPDATE runs SET heard_unix_ms = $1 WHERE id = $2 AND state = 'flying'")
            .bind(unix_ms())
            .bind(id)
            .execute(&self.pool)
            .await
            .map_err(|error| self.failed(error))?;
        Ok(())
    }

    /// Ends a run, also one that was cut off while its server was only silent.
    ///
    /// # Errors
    /// Errors of the database.
    pub async fn end(&self, id: &str, end: &RunEnd) -> Result<(), LeaderboardError> {
        sqlx::query(
            "UPDATE runs SET state = 'ended', ended_unix_ms = $1, outcome = $2, stages_passed = $3, \
             stages = $4, seconds = $5, penalty_s = $6, min_clearance_m = $7, verdict = $8 WHERE id = $9",
        )
        .bind(unix_ms())
        .bind(&end.outcome)
        .bind(i64::from(end.stages_passed))
        .bind(i64::from(end.stages))
        // Infinity is not portable between databases.
        .bind(end.seconds.filter(|seconds| seconds.is_finite()))
        .bind(if end.penalty_s.is_finite() { end.penalty_s } else { 0.0 })
        .bind(end.min_clearance_m.filter(|clearance| clearance.is_finite()))
        .bind(&end.verdict)
        .bind(id)
        .execute(&self.pool)
        .await
        .map_err(|error| self.failed(error))?;
        Ok(())
    }

    /// Returns the newest [`MAX_RUNS`] runs, newest first, of all courses or of one.
    ///
    /// # Errors
    /// Errors of the database.
    pub async fn runs(&self, course: Option<&str>) -> Result<Vec<Run>, LeaderboardError> {
        self.cut_off_unheard(unix_ms()).await?;
        let rows = sqlx::query(
            "SELECT id, team, course, vehicle, attempt, state, began_unix_ms, ended_unix_ms, outcome, \
             stages_passed, stages, seconds, penalty_s, min_clearance_m FROM runs \
             WHERE $1 = 0 OR course = $2 ORDER BY began_unix_ms DESC, id LIMIT $3",
        )
        .bind(i64::from(course.is_some()))
        .bind(course.unwrap_or(""))
        .bind(MAX_RUNS)
        .fetch_all(&self.pool)
        .await
        .map_err(|error| self.failed(error))?;
        rows.iter().map(run).collect::<Result<_, _>>().map_err(|error| self.failed(error))
    }

    /// Returns the verdict of an ended run, JSON.
    ///
    /// # Errors
    /// Errors of the database.
    pub async fn verdict(&self, id: &str) -> Result<Option<String>, LeaderboardError> {
        let row = sqlx::query("SELECT verdict FROM runs WHERE id = $1")
            .bind(id)
            .fetch_optional(&self.pool)
            .await
            .map_err(|error| self.failed(error))?;
        let verdict = row.map(|row| row.try_get(0)).transpose();
        verdict.map(Option::flatten).map_err(|error| self.failed(error))
    }

    /// Returns the names of all flown courses.
    ///
    /// # Errors
    /// Errors of the database.
    pub async fn courses(&self) -> Result<Vec<String>, LeaderboardError> {
        let rows = sqlx::query("SELECT DISTINCT course FROM runs ORDER BY course")
            .fetch_all(&self.pool)
            .await
            .map_err(|error| self.failed(error))?;
        rows.iter()
            .map(|row| row.try_get(0))
            .collect::<Result<_, _>>()
            .map_err(|error| self.failed(error))
    }

    /// Cuts off runs whose server has stopped.
    pub(super) async fn cut_off_unheard(&self, now_unix_ms: i64) -> Result<(), LeaderboardError> {
        sqlx::query(
            "UPDATE runs SET state = 'cut_off', ended_unix_ms = heard_unix_ms \
             WHERE state = 'flying' AND heard_unix_ms < $1",
        )
        .bind(now_unix_ms - UNHEARD.as_millis() as i64)
        .execute(&self.pool)
        .await
        .map_err(|error| self.failed(error))?;
        Ok(())
    }

    pub(super) async fn no_team(&self, name: &str) -> LeaderboardError {
        match self.teams().await {
            Ok(teams) => {
                let names: BTreeSet<String> = teams.into_iter().map(|team| team.name).collect();
                let names: Vec<String> = names.into_iter().collect();
                let names = if names.is_empty() {
                    "none yet; add one with `vizflyt leaderboard team add NAME`".to_owned()
                } else {
                    names.join(", ")
                };
                LeaderboardError::NoTeam(name.to_owned(), names)
            }
            Err(error) => error,
        }
    }

    pub(super) fn failed(&self, error: sqlx::Error) -> LeaderboardError {
        LeaderboardError::Query(self.database.clone(), error)
    }
}

fn run(row: &AnyRow) -> Result<Run, sqlx::Error> {
    let attempt: String = row.try_get(4)?;
    let state: String = row.try_get(5)?;
    Ok(Run {
        id: row.try_get(0)?,
        team: row.try_get(1)?,
        course: row.try_get(2)?,
        vehicle: row.try_get(3)?,
        attempt: if attempt == Attempt::Official.name() {
            Attempt::Official
        } else {
            Attempt::Practice
        },
        state: match state.as_str() {
            "flying" => RunState::Flying,
            "ended" => RunState::Ended,
            _ => RunState::CutOff,
        },
        began_unix_ms: row.try_get(6)?,
        ended_unix_ms: row.try_get(7)?,
        outcome: row.try_get::<Option<String>, _>(8)?.unwrap_or_default(),
        stages_passed: row.try_get::<i64, _>(9)? as u32,
        stages: row.try_get::<i64, _>(10)? as u32,
        seconds: row.try_get(11)?,
        penalty_s: row.try_get(12)?,
        min_clearance_m: row.try_get(13)?,
    })
}

/// Returns the migrations to the last of these versions.
pub(super) fn migrations(versions: &[(&'static str, &'static str)]) -> Migrator {
    let migration = |(index, &(name, sql)): (usize, &(&'static str, &'static str))| {
        let version = index as i64 + 1;
        Migration::new(version, name.into(), MigrationType::Simple, sql.into_sql_str(), false)
    };
    Migrator::with_migrations(versions.iter().enumerate().map(migration).collect())
}

/// Versions of the tables: one file each, never changed once released.
pub(super) const MIGRATIONS: [(&str, &str); 2] = [
    ("teams and runs", include_str!("migrations/0001_teams_and_runs.sql")),
    ("grades", include_str!("migrations/0002_grades.sql")),
];

/// Returns a token's hash. A token has 128 random bits, so a slow hash would add no security.
fn hash(token: &str) -> String {
    Fingerprint::of(token.as_bytes()).to_string()
}

pub(super) fn unix_ms() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as i64)
}

/// Maximum number of runs listed: enough for several terms of a large class.
pub const MAX_RUNS: i64 = 20_000;
/// Maximum length of a team's name. [characters]
const MAX_NAME: usize = 40;
/// Time without a mark after which a run is cut off.
const UNHEARD: Duration = Duration::from_mins(1);
/// Timeout of the database.
const PATIENCE: Duration = Duration::from_secs(10);
