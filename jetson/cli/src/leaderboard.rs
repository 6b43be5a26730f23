//! `vizflyt leaderboard`: teams, runs and standings of the lab's flights, from the database that `vizflyt serve` writes.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result};
use clap::{Args, Subcommand};
use vizflyt_server::leaderboard::{
    Attempt, Database, Leaderboard, Place, Run, standings, write_csv,
};

use crate::terminal::tell;

/// Shows who flew what how well, keeps the teams, and exports the runs.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt leaderboard                                who leads on each course
  vizflyt leaderboard team add wasps                 prints the token by which the team checks in
  vizflyt leaderboard export --course race runs.csv
  vizflyt leaderboard --database postgres://user:password@db.example.edu/vizflyt")]
pub(crate) struct LeaderboardArgs {
    /// A file, or postgres://USER:PASSWORD@HOST/NAME
    /// [default: $XDG_DATA_HOME/vizflyt/leaderboard.sqlite or ~/.local/share/vizflyt/leaderboard.sqlite]
    #[arg(long, value_name = "FILE|URL", global = true)]
    database: Option<Database>,
    #[command(subcommand)]
    command: Option<LeaderboardCommand>,
}

#[derive(Subcommand, Debug)]
enum LeaderboardCommand {
    /// Who leads, and the newest runs; what `vizflyt leaderboard` alone shows.
    Show(ShowArgs),
    /// Adds and retires teams.
    Team {
        #[command(subcommand)]
        command: TeamCommand,
    },
    /// Writes the runs as CSV.
    Export(ExportArgs),
}

#[derive(Args, Debug, Default)]
struct ShowArgs {
    /// Only this course: the arena's name
    #[arg(long)]
    course: Option<String>,
    /// One JSON object instead of tables
    #[arg(long)]
    json: bool,
}

#[derive(Subcommand, Debug)]
enum TeamCommand {
    /// Adds a team and prints its token, which is shown this once.
    Add {
        /// Up to 40 characters
        name: String,
    },
    /// Lists the teams.
    List,
    /// Takes a team's token away; its runs stay.
    Retire {
        /// Its name
        name: String,
    },
}

#[derive(Args, Debug)]
struct ExportArgs {
    /// Only this course: the arena's name
    #[arg(long)]
    course: Option<String>,
    /// Where to write; standard output without it
    #[arg(value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Does what is asked.
pub(crate) fn run(args: &LeaderboardArgs) -> Result<ExitCode> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start tokio")?;
    runtime.block_on(answer(args))?;
    Ok(ExitCode::SUCCESS)
}

async fn answer(args: &LeaderboardArgs) -> Result<()> {
    let database = match &args.database {
        Some(database) => database.clone(),
        None => Database::File(Database::default_file().context(
            "there is no home folder to keep the leaderboard in; name a file with --database",
        )?),
    };
    let board = Leaderboard::open(&database).await?;
    let shown = ShowArgs::default();
    match args.command.as_ref().unwrap_or(&LeaderboardCommand::Show(shown)) {
        LeaderboardCommand::Show(show) => self::show(&board, show).await,
        LeaderboardCommand::Team { command } => team(&board, command).await,
        LeaderboardCommand::Export(export) => {
            let runs = board.runs(export.course.as_deref()).await?;
            match &export.out {
                Some(path) => {
                    let file = std::fs::File::create(path)
                        .with_context(|| format!("cannot write {}", path.display()))?;
                    write_csv(&runs, file)
                        .with_context(|| format!("cannot write {}", path.display()))?;
                    tell(format!("{} runs written to {}", runs.len(), path.display()));
                }
                None => write_csv(&runs, std::io::stdout().lock())?,
            }
            Ok(())
        }
    }
}

async fn team(board: &Leaderboard, command: &TeamCommand) -> Result<()> {
    match command {
        TeamCommand::Add { name } => {
            let token = board.add_team(name).await?;
            tell(format!("team '{name}' is added; its token, shown this once:"));
            tell(&token);
            tell("the team checks in with it on the server's page before it flies");
        }
        TeamCommand::List => {
            let teams = board.teams().await?;
            if teams.is_empty() {
                tell("no teams yet; add one with `vizflyt leaderboard team add NAME`");
            }
            for team in teams {
                tell(format!("{}{}", team.name, if team.retired { " (retired)" } else { "" }));
            }
        }
        TeamCommand::Retire { name } => {
            board.retire_team(name).await?;
            tell(format!("the token of team '{name}' opens nothing any more; its runs stay"));
        }
    }
    Ok(())
}

async fn show(board: &Leaderboard, args: &ShowArgs) -> Result<()> {
    let runs = board.runs(args.course.as_deref()).await?;
    let mut courses = board.courses().await?;
    courses.retain(|course| args.course.as_ref().is_none_or(|only| only == course));
    if args.json {
        let boards: Vec<_> = courses
            .iter()
            .map(|course| {
                serde_json::json!({
                    "course": course,
                    "official": standings(&runs, course, Attempt::Official),
                    "practice": standings(&runs, course, Attempt::Practice),
                })
            })
            .collect();
        tell(serde_json::json!({ "courses": boards, "runs": runs }));
        return Ok(());
    }
    if courses.is_empty() {
        tell(match &args.course {
            Some(course) => format!("nobody has flown '{course}' yet"),
            None => format!("nobody has flown yet; runs are kept in {}", board.database()),
        });
    }
    for course in courses {
        for attempt in [Attempt::Official, Attempt::Practice] {
            let places = standings(&runs, &course, attempt);
            if !places.is_empty() {
                tell(format!("{course}, {}", attempt.name()));
                for place in &places {
                    tell(line(place));
                }
            }
        }
        let of_course: Vec<&Run> = runs.iter().filter(|run| run.course == course).collect();
        let nobodys = of_course.iter().filter(|run| run.team.is_none()).count();
        tell(format!(
            "{course}: {} runs, {nobodys} of them by nobody who had checked in",
            of_course.len()
        ));
    }
    Ok(())
}

fn line(place: &Place) -> String {
    let seconds = place.seconds.map_or_else(|| "-".to_owned(), |seconds| format!("{seconds:.2} s"));
    format!(
        "{:>4}  {:<24} {:>2} of {:<2} stages  {seconds:>10}  {:>3} runs",
        place.rank, place.team, place.stages_passed, place.stages, place.runs
    )
}
