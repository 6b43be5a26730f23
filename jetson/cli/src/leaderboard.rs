//! `vizflyt leaderboard`: teams, runs and standings of the lab's flights, from the database that
//! `vizflyt serve` writes. Also adds signed grades.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, ensure};
use clap::{Args, Subcommand};
use vizflyt_grading::class::archive::{Files, pack};
use vizflyt_grading::{Grade, verified};
use vizflyt_process::print_line;
use vizflyt_server::flights::leaderboard::{
    Attempt, Database, Erased, GradeBoard, GradeEntry, Leaderboard, Run, Standing, grade_boards,
    standings, write_csv,
};

/// Show standings, manage teams, and export runs
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt leaderboard                                show the standings of each course
  vizflyt leaderboard team add wasps                 add a team and print its token for check-in
  vizflyt leaderboard export --course race runs.csv
  vizflyt leaderboard team export wasps wasps.json   export all data of a team; `team erase wasps` deletes it
  vizflyt leaderboard archive autumn.zip             archive a term in one file
  vizflyt leaderboard add grade.json --team wasps    add a grade of `vizflyt grade` if its signature is valid
  vizflyt leaderboard --database postgres://user:password@db.example.edu/vizflyt")]
pub(crate) struct LeaderboardArgs {
    /// Database: a file, or postgres://USER:PASSWORD@HOST/NAME
    ///
    /// [default: $XDG_DATA_HOME/vizflyt/leaderboard.sqlite or
    /// ~/.local/share/vizflyt/leaderboard.sqlite]
    #[arg(long, value_name = "FILE|URL", global = true)]
    database: Option<Database>,
    #[command(subcommand)]
    command: Option<LeaderboardCommand>,
}

#[derive(Subcommand, Debug)]
enum LeaderboardCommand {
    /// Show the standings and the newest runs; the default command
    Show(ShowArgs),
    /// Add, list, retire, export and erase teams
    Team {
        #[command(subcommand)]
        command: TeamCommand,
    },
    /// Write the runs as CSV
    Export(ExportArgs),
    /// Archive a term in one file: records of all teams, all runs
    Archive {
        /// ZIP file
        #[arg(value_name = "FILE.zip")]
        out: PathBuf,
    },
    /// Add a signed grade of `vizflyt grade`, if its signature is valid
    Add(AddArgs),
}

#[derive(Args, Debug)]
struct AddArgs {
    /// Complete grade, as `vizflyt grade -o` or `vizflyt grade merge -o` wrote it
    #[arg(value_name = "GRADE.json")]
    file: PathBuf,
    /// Name of the team
    #[arg(long, value_name = "NAME")]
    team: String,
    /// Public key of the signature, or a file with one [default: this computer's key]
    #[arg(long, value_name = "KEY")]
    key: Option<String>,
    /// Folder of this computer's own key [default: ~/.config/vizflyt]
    #[arg(long, value_name = "DIR")]
    keys: Option<PathBuf>,
}

#[derive(Args, Debug, Default)]
struct ShowArgs {
    /// Only this course: name of the arena, or for grades, of the project
    #[arg(long)]
    course: Option<String>,
    /// Print one JSON object instead of tables
    #[arg(long)]
    json: bool,
}

#[derive(Subcommand, Debug)]
enum TeamCommand {
    /// Add a team and print its token, which is shown only once
    Add {
        /// Name of the team, up to 40 characters
        name: String,
    },
    /// List the teams
    List,
    /// Revoke a team's token; its runs stay
    Retire {
        /// Name of the team
        name: String,
    },
    /// Export all data of a team: runs with their verdicts, signed grades
    Export {
        /// Name of the team
        name: String,
        /// Output file [default: standard output]
        #[arg(value_name = "FILE.json")]
        out: Option<PathBuf>,
    },
    /// Erase a team with its runs and grades, permanently
    Erase {
        /// Name of the team
        name: String,
        /// Erase; without this option, only show what would be erased
        #[arg(long)]
        yes: bool,
    },
}

#[derive(Args, Debug)]
struct ExportArgs {
    /// Only this course: name of the arena
    #[arg(long)]
    course: Option<String>,
    /// Output file [default: standard output]
    #[arg(value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Runs `vizflyt leaderboard`.
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
        None => Database::File(
            Database::default_file()
                .context("no home folder for the leaderboard; give a file with --database")?,
        ),
    };
    if let Some(LeaderboardCommand::Add(add)) = &args.command {
        // An invalid grade does not open a database.
        let grade = verified(&add.file, add.key.as_deref(), add.keys.as_deref())?;
        let entry = entry(&grade, &add.team)?;
        let board = Leaderboard::open(&database).await?;
        return self::add(&board, &entry, &grade.to_text()?).await;
    }
    let board = Leaderboard::open(&database).await?;
    let shown = ShowArgs::default();
    match args.command.as_ref().unwrap_or(&LeaderboardCommand::Show(shown)) {
        LeaderboardCommand::Show(show) => self::show(&board, show).await,
        LeaderboardCommand::Team { command } => team(&board, command).await,
        LeaderboardCommand::Archive { out } => archive(&board, out).await,
        // Handled above.
        LeaderboardCommand::Add(_) => Ok(()),
        LeaderboardCommand::Export(export) => {
            let runs = board.runs(export.course.as_deref()).await?;
            let Some(path) = &export.out else {
                let mut csv = Vec::new();
                write_csv(&runs, &mut csv)?;
                print_line(String::from_utf8_lossy(&csv).trim_end());
                return Ok(());
            };
            let file = std::fs::File::create(path)
                .with_context(|| format!("cannot write {}", path.display()))?;
            write_csv(&runs, file).with_context(|| format!("cannot write {}", path.display()))?;
            print_line(format!("{} runs written to {}", runs.len(), path.display()));
            Ok(())
        }
    }
}

async fn team(board: &Leaderboard, command: &TeamCommand) -> Result<()> {
    match command {
        TeamCommand::Add { name } => {
            let token = board.add_team(name).await?;
            print_line(format!("added team '{name}'; its token, shown only once:"));
            print_line(&token);
            print_line("the team checks in with it on the server's page before it flies");
        }
        TeamCommand::List => {
            let teams = board.teams().await?;
            if teams.is_empty() {
                print_line("no teams yet; add one with `vizflyt leaderboard team add NAME`");
            }
            for team in teams {
                print_line(format!(
                    "{}{}",
                    team.name,
                    if team.retired { " (retired)" } else { "" }
                ));
            }
        }
        TeamCommand::Retire { name } => {
            board.retire_team(name).await?;
            print_line(format!("the token of team '{name}' is revoked; its runs stay"));
        }
        TeamCommand::Export { name, out } => {
            let text = records_text(board, name).await?;
            let Some(path) = out else {
                print_line(text);
                return Ok(());
            };
            std::fs::write(path, text)
                .with_context(|| format!("cannot write {}", path.display()))?;
            print_line(format!("all data of '{name}' written to {}", path.display()));
        }
        TeamCommand::Erase { name, yes: false } => {
            let records = board.records_of(name).await?;
            print_line(format!(
                "'{name}' has {} runs and {} grades here; `--yes` erases them permanently. \
                 Logs, reports and submissions are separate \
                 files: docs/guides/records.md",
                records.runs.len(),
                records.grades.len()
            ));
        }
        TeamCommand::Erase { name, yes: true } => {
            let Erased { runs, grades } = board.erase_team(name).await?;
            print_line(format!("team '{name}', {runs} runs and {grades} grades erased"));
        }
    }
    Ok(())
}

async fn records_text(board: &Leaderboard, team: &str) -> Result<String> {
    Ok(serde_json::to_string_pretty(&board.records_of(team).await?)?)
}

/// Archives a term: `runs.csv`, and a numbered file for each team, because a team's name may be
/// invalid as a file name.
async fn archive(board: &Leaderboard, out: &Path) -> Result<()> {
    let mut files = Files::new();
    let runs = board.runs(None).await?;
    let mut csv = Vec::new();
    write_csv(&runs, &mut csv)?;
    files.insert("runs.csv".to_owned(), csv);
    let teams = board.teams().await?;
    for (number, team) in (1..).zip(&teams) {
        let text = records_text(board, &team.name).await?;
        files.insert(format!("teams/{number:03}.json"), text.into_bytes());
    }
    std::fs::write(out, pack(&files)?)
        .with_context(|| format!("cannot write {}", out.display()))?;
    print_line(format!(
        "{} teams and {} runs written to {}",
        teams.len(),
        runs.len(),
        out.display()
    ));
    Ok(())
}

/// Returns the leaderboard's entry for a grade.
fn entry(grade: &Grade, team: &str) -> Result<GradeEntry> {
    if let Some(shard) = grade.shard {
        let (index, count) = (shard.index, shard.count);
        anyhow::bail!(
            "this is part {index} of {count} of a grade; combine all parts with `vizflyt grade merge`"
        );
    }
    ensure!(!grade.runs.is_empty(), "this grade has no flights");
    let (subject, summary) = (&grade.subject, &grade.summary);
    if let Some(signed) = subject.team.as_ref().filter(|signed| *signed != team) {
        anyhow::bail!("this grade is of team '{signed}', not of '{team}'; give --team {signed}");
    }
    let last_seed = subject.first_seed.saturating_add(subject.seeds.saturating_sub(1));
    let delays = subject.delays;
    Ok(GradeEntry {
        team: team.to_owned(),
        hash: grade.hash.clone(),
        plugin_sha256: subject.plugin_sha256.clone(),
        project: subject.project.clone(),
        level: subject.level.clone(),
        conditions: format!(
            "{}, seeds {} to {last_seed}{}, {:.1}+{:.1} ms late, every {:.1} ms{}",
            subject.variants.join(" "),
            subject.first_seed,
            subject.courses.as_ref().map_or(String::new(), |name| format!(" of {name}")),
            delays.image,
            delays.answer,
            delays.image_period,
            subject.imu.as_ref().map_or(String::new(), |imu| format!(", {imu}"))
        ),
        flights: summary.runs as u32,
        finished: summary.finished as u32,
        stages: grade.runs.iter().map(|run| run.stages.len()).max().unwrap_or(0) as u32,
        mean_stages_passed: summary.mean_stages_passed,
        median_s: grade.median_finish_s(),
        score: summary.score.value,
    })
}

async fn add(board: &Leaderboard, entry: &GradeEntry, document: &str) -> Result<()> {
    board.add_grade(entry, document).await?;
    print_line(format!("added grade {} of team '{}'", entry.hash, entry.team));
    let boards = grade_boards(&board.grades().await?);
    let own = boards.iter().filter(|board| {
        (&board.project, &board.level, &board.conditions)
            == (&entry.project, &entry.level, &entry.conditions)
    });
    own.for_each(show_grades);
    Ok(())
}

fn show_grades(board: &GradeBoard) {
    print_line(format!("{} {}, graded: {}", board.project, board.level, board.conditions));
    for place in &board.places {
        let best = &place.best;
        let median = best.median_s.map_or_else(|| "-".to_owned(), |s| format!("{s:.2} s"));
        print_line(format!(
            "{:>4}  {:<24} {:>5.2} of {:<2} stages  {:>3} of {:<3} finished  {median:>10}  {:>3} grades",
            place.rank,
            best.team,
            best.mean_stages_passed,
            best.stages,
            best.finished,
            best.flights,
            place.grades
        ));
    }
}

async fn show(board: &Leaderboard, args: &ShowArgs) -> Result<()> {
    let runs = board.runs(args.course.as_deref()).await?;
    let mut courses = board.courses().await?;
    let mut graded = grade_boards(&board.grades().await?);
    graded.retain(|board| args.course.as_ref().is_none_or(|only| *only == board.project));
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
        print_line(serde_json::json!({ "courses": boards, "graded": graded, "runs": runs }));
        return Ok(());
    }
    if courses.is_empty() && graded.is_empty() {
        print_line(match &args.course {
            Some(course) => format!("no runs on '{course}' yet"),
            None => format!("no runs yet; runs are stored in {}", board.database()),
        });
    }
    for course in courses {
        for attempt in [Attempt::Official, Attempt::Practice] {
            let places = standings(&runs, &course, attempt);
            if !places.is_empty() {
                print_line(format!("{course}, {}", attempt.name()));
                for place in &places {
                    print_line(line(place));
                }
            }
        }
        let of_course: Vec<&Run> = runs.iter().filter(|run| run.course == course).collect();
        let nobodys = of_course.iter().filter(|run| run.team.is_none()).count();
        print_line(format!(
            "{course}: {} runs, {nobodys} of them without a checked-in team",
            of_course.len()
        ));
    }
    graded.iter().for_each(show_grades);
    Ok(())
}

fn line(place: &Standing) -> String {
    let seconds = place.seconds.map_or_else(|| "-".to_owned(), |seconds| format!("{seconds:.2} s"));
    format!(
        "{:>4}  {:<24} {:>2} of {:<2} stages  {seconds:>10}  {:>3} runs",
        place.rank, place.team, place.stages_passed, place.stages, place.runs
    )
}
