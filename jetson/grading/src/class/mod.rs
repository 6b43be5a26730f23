//! Submissions of a class: `vizflyt submit` packs one, `vizflyt grade-class` grades all.
//!
//! ```text
//! roster.csv ── team ─▶ SUBMISSIONS/team.zip, or a folder ─▶ DIR/plugins/team
//!               ─▶ `vizflyt grade --resume` in a separate process
//! DIR/course.secret: secret of the courses, the same for all teams and all runs
//! DIR/reports/team: each report, signed      DIR/grades.csv: the roster with results      DIR/index.html
//! ```
//! The command can be interrupted and repeated at any time: grades of the same submission with the
//! same options are kept.

pub mod archive;
mod page;
mod roster;
mod submission;

use std::ffi::{OsStr, OsString};
use std::fs;
use std::io::{self, BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};

use anyhow::{Context, Result, bail, ensure};
use clap::{Args, Parser};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use vizflyt_process::{print_fmt, print_line};
use vizflyt_runtime::console::printable;
use vizflyt_trust::{CourseSecret, hex};

use self::roster::{Roster, Team};
pub use self::submission::{SubmitArgs, submit};
use crate::GradeArgs;
use crate::{Grade, verified};

/// Grade every team of a class, and write one table of results
#[derive(Args, Debug)]
#[command(
    after_help = "ROSTER.csv has a line of headings, one of them `team`; its other columns are
kept. A team's submission is SUBMISSIONS/TEAM.zip, as `vizflyt submit` makes it, or a folder SUBMISSIONS/TEAM.
Without one, the score is 0. Options after DIR are for `vizflyt grade`. If repeated, the command grades new
and changed submissions.

Examples:
  vizflyt grade-class roster.csv submissions grades --project p4 --seeds 20 --first-seed @secret.txt
  vizflyt grade-class --own-seeds roster.csv submissions grades --project p5 --level g"
)]
pub struct ClassArgs {
    /// Different courses for each team; seeds follow from the first seed and team name
    #[arg(long)]
    own_seeds: bool,
    /// Courses that follow only from the seeds, so that everybody can fly them
    ///
    /// Without it, they follow from DIR/course.secret, 128 random bits. Delete that file to draw new courses.
    #[arg(long)]
    public_courses: bool,
    /// Roster of the class, one team per line
    #[arg(value_name = "ROSTER.csv")]
    roster: PathBuf,
    /// Folder of submissions
    #[arg(value_name = "SUBMISSIONS")]
    submissions: PathBuf,
    /// Folder for grades.csv, index.html and the reports of the teams
    #[arg(value_name = "DIR")]
    output: PathBuf,
    /// Options of `vizflyt grade`, the same for all teams
    #[arg(value_name = "OPTION OF GRADE", trailing_var_arg = true, allow_hyphen_values = true)]
    options: Vec<OsString>,
}

/// Result of a team.
struct Graded<'a> {
    team: &'a Team,
    submission: String,
    result: Result<Grade, String>,
}

/// Submission and options of a report.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Flown {
    submission_sha256: String,
    options: Vec<String>,
    /// Name of the secret of the courses.
    courses: Option<String>,
}

/// Runs `vizflyt grade-class`.
pub fn grade_class(args: &ClassArgs) -> Result<ExitCode> {
    let roster = Roster::read(&args.roster)?;
    check_options(&args.options)?;
    ensure!(
        args.submissions.is_dir(),
        "{} is not a folder of submissions",
        args.submissions.display()
    );
    let program = std::env::current_exe().context("cannot find this program's path")?;
    let secret = (!args.public_courses).then(|| args.output.join("course.secret"));
    if let Some(path) = &secret {
        fs::create_dir_all(&args.output)
            .with_context(|| format!("cannot make {}", args.output.display()))?;
        CourseSecret::read_or_create(path)?;
    }
    let mut all = Vec::with_capacity(roster.teams.len());
    for (index, team) in roster.teams.iter().enumerate() {
        print_fmt!("{}/{} {}", index + 1, roster.teams.len(), team.name);
        let mut submission = String::new();
        let result = grade_team(args, &program, team, secret.as_deref(), &mut submission);
        let result = result.map_err(|error| format!("{error:#}"));
        if let Err(why) = &result {
            print_fmt!("    no grade: {why}");
        }
        all.push(Graded { team, submission, result });
        // Written after each team, so that the table shows the progress.
        let table = roster.with_grades(&all)?;
        write(&args.output.join("grades.csv"), table.as_bytes())?;
        write(&args.output.join("index.html"), page::page(&all).as_bytes())?;
    }
    let graded = all.iter().filter(|one| one.result.is_ok()).count();
    print_fmt!("{graded} of {} teams have a grade", all.len());
    print_line(format!("table       {}", args.output.join("grades.csv").display()));
    print_line(format!("page        {}", args.output.join("index.html").display()));
    Ok(ExitCode::SUCCESS)
}

/// Rejects options that `vizflyt grade` would reject for every team, and options that this command
/// sets.
fn check_options(options: &[OsString]) -> Result<()> {
    let ours = [
        "--report", "--resume", "--output", "-o", "--json", "--least", "--junit", "--shard",
        "--hide", "--secret", "--team",
    ];
    for option in options {
        let text = option.to_string_lossy();
        let name = text.split('=').next().unwrap_or_default();
        ensure!(
            !ours.contains(&name),
            "{name} is not for a class: each team has a report of its own in DIR"
        );
    }
    let line =
        ["vizflyt grade", "avoid"].map(OsString::from).into_iter().chain(options.iter().cloned());
    if let Err(error) = GradeLine::try_parse_from(line) {
        error.exit();
    }
    Ok(())
}

/// Command line of `vizflyt grade`, to check the options.
#[derive(Parser)]
struct GradeLine {
    #[command(flatten)]
    _args: GradeArgs,
}

/// Grades one team, or returns its earlier grade.
fn grade_team(
    args: &ClassArgs,
    program: &Path,
    team: &Team,
    secret: Option<&Path>,
    submission: &mut String,
) -> Result<Grade> {
    let found = submission::find(&args.submissions, &team.name)?;
    *submission = found.sha256()?;
    let mut options = args.options.clone();
    if args.own_seeds {
        own_seed(&mut options, &team.name)?;
    }
    let flown = Flown {
        submission_sha256: submission.clone(),
        // Options are stored as hashes, so that a secret seed is not stored.
        options: options.iter().map(|option| hash(option.as_encoded_bytes())).collect(),
        courses: secret.map(CourseSecret::read).transpose()?.and_then(|secret| secret.name()),
    };
    // On standard input: other users can see command lines.
    let seed = if args.own_seeds { options.pop() } else { None };
    options.extend(seed.is_some().then(|| "@/dev/stdin".into()));
    let [plugin, report, kept] =
        ["plugins", "reports", "state"].map(|folder| args.output.join(folder).join(&team.name));
    let kept = kept.with_extension("json");
    let grade_file = report.join("grade.json");
    let is_same = fs::read(&kept).is_ok_and(|bytes| {
        serde_json::from_slice(&bytes).ok().is_some_and(|old: Flown| old == flown)
    });
    if is_same && grade_file.is_file() {
        match kept_grade(&grade_file, &team.name, &options) {
            Ok(grade) => return Ok(grade),
            Err(why) => print_fmt!("    graded again: {why:#}"),
        }
    }
    if !is_same || grade_file.is_file() {
        for folder in [&plugin, &report] {
            if folder.exists() {
                fs::remove_dir_all(folder)
                    .with_context(|| format!("cannot empty {}", folder.display()))?;
            }
        }
        found.unpack(&plugin)?;
        write(&kept, &serde_json::to_vec(&flown)?)?;
    }
    let hidden = hidden(args, &plugin)?;
    let mut child = Command::new(program)
        .arg("grade")
        .arg(&plugin)
        .args(&options)
        .args([OsStr::new("--team"), OsStr::new(&team.name)])
        .args([OsStr::new("--resume"), OsStr::new("--report"), report.as_os_str()])
        .args(hidden.iter().flat_map(|path| [OsStr::new("--hide"), path.as_os_str()]))
        .args(secret.iter().flat_map(|path| [OsStr::new("--secret"), path.as_os_str()]))
        .stdin(if seed.is_some() { Stdio::piped() } else { Stdio::inherit() })
        .stderr(Stdio::piped())
        .spawn()
        .context("cannot start vizflyt grade")?;
    if let (Some(mut input), Some(seed)) = (child.stdin.take(), &seed) {
        // If the process has ended, its status is the error.
        let _ = input.write_all(seed.as_encoded_bytes());
    }
    let mut error = String::new();
    for line in BufReader::new(child.stderr.take().context("no standard error")?).split(b'\n') {
        let line = printable(&String::from_utf8_lossy(&line?));
        // A closed terminal does not stop the grading.
        let _ = writeln!(io::stderr(), "{line}");
        note_error(&mut error, &line);
    }
    let status = child.wait().context("cannot wait for vizflyt grade")?;
    if !status.success() && error.is_empty() {
        bail!("vizflyt grade ended with {status}; see its messages above");
    }
    ensure!(status.success(), "{error}");
    Grade::read(&grade_file)
}

/// Adds a line of `vizflyt grade` to its last error message, which becomes one line without the carets
/// of Python.
fn note_error(error: &mut String, line: &str) {
    if let Some(text) = line.strip_prefix("error: ") {
        text.clone_into(error);
    } else if !error.is_empty()
        && error.len() < LONGEST_ERROR
        && line.contains(|c| !matches!(c, '^' | '~' | ' '))
    {
        error.push(' ');
        error.push_str(line.trim());
    }
}

/// Length of an error message from which further lines are left out. [bytes]
const LONGEST_ERROR: usize = 4096;

/// Returns the grade of an earlier run, if its signature is valid. A grade without a signature is
/// also returned; the table marks it.
fn kept_grade(file: &Path, team: &str, options: &[OsString]) -> Result<Grade> {
    let grade = Grade::read(file)?;
    ensure!(grade.subject.team.as_deref() == Some(team), "{} is not of this team", file.display());
    if grade.signature.is_none() {
        return Ok(grade);
    }
    let value = |(option, next): (&OsString, Option<&OsString>)| {
        let text = option.to_str()?;
        let inline = text.strip_prefix("--keys=").map(PathBuf::from);
        inline.or_else(|| next.filter(|_| text == "--keys").map(PathBuf::from))
    };
    let nexts = options.iter().skip(1).map(Some).chain([None]);
    let keys = options.iter().zip(nexts).find_map(value);
    verified(file, None, keys.as_deref())
}

/// Returns the paths that a team's plugin must not read: submissions and results of the other
/// teams.
fn hidden(args: &ClassArgs, plugin: &Path) -> Result<Vec<PathBuf>> {
    let within = |folder: &Path| -> Result<Vec<PathBuf>> {
        let read =
            fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))?;
        Ok(read.collect::<Result<Vec<_>, _>>()?.into_iter().map(|entry| entry.path()).collect())
    };
    let mut hidden = within(&args.output)?;
    let plugins = plugin.parent().unwrap_or(plugin);
    hidden.retain(|path| path != plugins);
    hidden.extend(within(plugins)?.into_iter().filter(|path| path != plugin));
    hidden.extend([args.submissions.clone(), args.roster.clone()]);
    Ok(hidden)
}

/// Replaces the first seed by the team's own.
fn own_seed(options: &mut Vec<OsString>, team: &str) -> Result<()> {
    let mut given = String::from("1");
    let mut index = 0;
    while index < options.len() {
        let text = options[index].to_string_lossy().into_owned();
        if let Some(value) = text.strip_prefix("--first-seed=") {
            value.clone_into(&mut given);
            options.remove(index);
        } else if text == "--first-seed" && index + 1 < options.len() {
            given = options.remove(index + 1).to_string_lossy().into_owned();
            options.remove(index);
        } else {
            index += 1;
        }
    }
    if let Some(path) = given.strip_prefix('@') {
        given = fs::read_to_string(path).with_context(|| format!("cannot read {path}"))?;
    }
    let given: u64 = given.trim().parse().context("--first-seed is not a number")?;
    let digest = Sha256::digest(format!("{given}\0{team}"));
    // 48 bits: JSON readers with floating-point numbers keep all following seeds exact.
    let seed = digest[..6].iter().fold(0, |seed: u64, byte| seed << 8 | u64::from(*byte));
    options.extend(["--first-seed".into(), seed.to_string().into()]);
    Ok(())
}

fn hash(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

/// Writes a file atomically, and makes its folder.
fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    let cannot = || format!("cannot write {}", path.display());
    let folder = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(folder).with_context(cannot)?;
    let mut draft = tempfile::NamedTempFile::new_in(folder).with_context(cannot)?;
    draft.write_all(bytes).with_context(cannot)?;
    draft.persist(path).with_context(cannot)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_teams_row_names_the_error_of_its_plugin() {
        let messages = "a warning\nerror: plugin.py is not Python:\n  File \"plugin.py\", line 45\n    \
                        def on_image(self, obs)\n          ^^\nSyntaxError: expected ':'\n";
        let mut error = String::new();
        messages.lines().for_each(|line| note_error(&mut error, line));
        assert_eq!(
            error,
            "plugin.py is not Python: File \"plugin.py\", line 45 def on_image(self, obs) \
             SyntaxError: expected ':'"
        );
    }

    #[test]
    fn a_teams_seeds_are_unique_and_follow_from_the_secret() {
        let seed = |options: &[&str], team: &str| {
            let mut options: Vec<OsString> = options.iter().map(OsString::from).collect();
            own_seed(&mut options, team).unwrap();
            let text: Vec<String> =
                options.iter().map(|o| o.to_string_lossy().into_owned()).collect();
            assert_eq!(text.iter().filter(|o| *o == "--first-seed").count(), 1, "{text:?}");
            text
        };
        let secret = ["--project", "p4", "--first-seed", "77", "--seeds", "3"];
        let a = seed(&secret, "a");
        assert_eq!(a[..4], ["--project", "p4", "--seeds", "3"]);
        assert_eq!(a, seed(&secret, "a"));
        assert_ne!(a, seed(&secret, "b"));
        assert_ne!(seed(&["--first-seed=78"], "a").last(), a.last());
        assert_eq!(seed(&["--first-seed=77"], "a").last(), a.last());
        assert!(a.last().unwrap().parse::<u64>().unwrap() < 1 << 48);
    }
}
