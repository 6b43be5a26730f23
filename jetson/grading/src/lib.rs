//! `vizflyt grade`: flies a plugin through a project's course once per seed, and scores it.
//!
//! ```text
//! project, level, variant, seed -> course  in memory: splats, arena, distance field
//!                               -> trial   one flight in lock-step, with a separate plugin process
//!                               -> vizflyt_arena::crash  probable cause of a failure
//! each flight                   -> folder    images of its card, log, record (record)
//! flights                       -> document  results, points, hash, signature -> report/, junit, JSON
//! an earlier grade              -> changes   what is better and worse; `--watch` (watch) repeats the grade
//! shards of a grade             -> merge     the complete grade
//! ```
//! The guides are `docs/guides/grading.md` and `grading-at-scale.md`.

mod args;
mod changes;
pub mod class;
pub mod document;
mod door;
mod figures;
mod finished;
mod flights;
mod folder;
mod judge;
mod junit;
mod keys;
pub mod merge;
mod odometry;
pub mod plugin;
mod pool;
mod progress;
pub mod record;
mod report;
mod statistics;
mod trial;
mod watch;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, ensure};
use vizflyt_process::print_line;
use vizflyt_trust::hex;

pub use self::args::GradeArgs;
use self::args::{GradeCommand, ResultArgs};
pub use self::document::Grade;
use self::folder::ReportFolder;

/// Runs `vizflyt grade`.
pub fn run(args: &GradeArgs) -> Result<ExitCode> {
    match &args.command {
        None if args.fly.watch => watch::watch(&args.fly),
        None => flights::grade(&args.fly),
        Some(GradeCommand::Verify { file, junit, key, keys }) => {
            let is_folder = file.is_dir();
            let document = if is_folder { file.join(folder::GRADE) } else { file.clone() };
            let grade = verified(&document, key.as_deref(), keys.as_deref())?;
            if is_folder {
                let cannot = || format!("{} is not valid", file.display());
                folder::verify(file, &grade).with_context(cannot)?;
            }
            if let Some(path) = junit {
                junit::verify(path, &grade)?;
            }
            print_line(format!(
                "{}: valid signature of {}; score {:.1}, {} of {} finished",
                file.display(),
                grade.signature.as_ref().map_or("", |signed| &signed.key),
                grade.summary.score.value,
                grade.summary.finished,
                grade.summary.runs
            ));
            if let Some(team) = &grade.subject.team {
                print_line(format!("team        {team}"));
            }
            print_line(format!("courses     {}", grade.subject.courses()));
            match grade.files.len() {
                0 => {}
                count if is_folder => print_line(format!("all {count} files are as signed")),
                count => print_line(format!(
                    "the report's {count} files were not checked: give its folder to check them"
                )),
            }
            Ok(ExitCode::SUCCESS)
        }
        Some(GradeCommand::Merge { files, key, report, result }) => {
            let read = |path: &PathBuf| Ok((path.display().to_string(), Grade::read(path)?));
            let parts = files.iter().map(read).collect::<Result<Vec<_>>>()?;
            let key = keys::verifying_key(key.as_deref(), result.keys.as_deref())?;
            let mut grade = merge::merge(&parts, &key)?;
            check_outputs(report.as_deref(), result, None)?;
            let folder = report.as_deref().map(ReportFolder::begin).transpose()?;
            let key = keys::signing_key(result.keys.as_deref())?;
            if let Some(folder) = &folder {
                let cards: Vec<String> =
                    grade.runs.iter().map(report::card::without_images).collect();
                report::write(folder, &mut grade, Some(&key), &cards, Vec::new())?;
            } else {
                grade.sign(&key)?;
            }
            figures::hand_over(&grade, result)?;
            if let (Some(folder), false) = (report, result.json) {
                print_line(format!("report      {}", folder.join(folder::PAGE).display()));
            }
            Ok(ExitCode::SUCCESS)
        }
        Some(GradeCommand::Judge(args)) => judge::run(args),
        Some(GradeCommand::Key { keys }) => {
            print_line(hex(&keys::signing_key(keys.as_deref())?.verifying_key().to_bytes()));
            Ok(ExitCode::SUCCESS)
        }
    }
}

/// Returns the grade of a file if its signature is valid. `key` is in hexadecimal or a file;
/// without it, this computer's own key is used.
///
/// # Errors
/// The first failed check, as a sentence.
pub fn verified(file: &Path, key: Option<&str>, keys: Option<&Path>) -> Result<Grade> {
    let grade = Grade::read(file)?;
    let key = keys::verifying_key(key, keys)?;
    grade.verify(&key).with_context(|| format!("{} is not valid", file.display()))?;
    Ok(grade)
}

/// Checks that no other output is written into the report's folder, where all files are signed.
fn check_outputs(report: Option<&Path>, result: &ResultArgs, junit: Option<&Path>) -> Result<()> {
    let Some(root) = report else { return Ok(()) };
    let made = std::fs::create_dir_all(root).and_then(|()| root.canonicalize());
    let root = made.with_context(|| format!("cannot make {}", root.display()))?;
    let outputs = [("--output", result.output.as_deref(), folder::GRADE)];
    for (option, path, own) in outputs.into_iter().chain([("--junit", junit, folder::JUNIT)]) {
        let Some(path) = path else { continue };
        let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
        let parent = parent.unwrap_or(Path::new(".")).canonicalize();
        let Ok(parent) = parent else { continue };
        let is_own = parent == root && path.file_name() == Some(own.as_ref());
        ensure!(
            is_own || !parent.starts_with(&root),
            "{option} {}: all files in a report are signed, and it contains {own} already; give another folder",
            path.display()
        );
    }
    Ok(())
}
