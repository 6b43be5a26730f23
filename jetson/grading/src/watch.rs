//! `--watch`: grades again when the plugin is saved, and prints the changes.
//!
//! Each attempt is a separate process with the same options. It is killed when the plugin is saved
//! again, and leaves no files. A complete report replaces the earlier one.

use std::path::Path;
use std::process::{Child, Command, ExitCode, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;

use anyhow::{Context, Result};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use vizflyt_process::{print_error, print_line, stop_flag};

use super::args::FlyArgs;
use super::document::Grade;
use super::folder::{self, ReportFolder};
use super::{changes, figures};
use crate::door;
use crate::plugin::Plugin;
use crate::plugin::watch::{LOOK_EVERY, Sources};

/// Grades until interrupted.
pub(super) fn watch(args: &FlyArgs) -> Result<ExitCode> {
    let typed = args.plugin.as_ref().context("no plugin given")?;
    let plugin = Plugin::find(typed)?;
    let stop: &AtomicBool = &*stop_flag(false)?;
    let mut earlier = changes::earlier(args)?;
    let mut attempt = 0;
    // Dependencies are built once.
    let build = door::private_folder()?;
    while !stop.load(Ordering::Relaxed) {
        let saved = Sources::of(&plugin.watched());
        let is_saved = || Sources::of(&plugin.watched()) != saved;
        match fly(args, build.path(), stop, &is_saved)? {
            None => {
                if !stop.load(Ordering::Relaxed) {
                    print_error("saved meanwhile: started again");
                }
                continue;
            }
            Some(Attempt::Failed(status)) => print_error(format_args!("no grade: {status}")),
            Some(Attempt::Flown(grade)) => {
                attempt += 1;
                print_line(format!("attempt {attempt}"));
                figures::print(&grade);
                for line in earlier.iter().flat_map(|earlier| changes::lines(earlier, &grade)) {
                    print_line(format!("  {line}"));
                }
                if let Some(folder) = &args.report {
                    print_line(format!("report      {}", folder.join(folder::PAGE).display()));
                }
                earlier = Some(*grade);
            }
        }
        print_error(format_args!(
            "waiting until {} is saved; Ctrl-C ends",
            Path::new(typed).display()
        ));
        while !stop.load(Ordering::Relaxed) && !is_saved() {
            sleep(LOOK_EVERY);
        }
    }
    Ok(ExitCode::SUCCESS)
}

enum Attempt {
    Flown(Box<Grade>),
    Failed(ExitStatus),
}

/// Flies all flights once; returns `None` if interrupted, or if the plugin is saved.
fn fly(
    args: &FlyArgs,
    build: &Path,
    stop: &AtomicBool,
    is_saved: &dyn Fn() -> bool,
) -> Result<Option<Attempt>> {
    // On the same disk as the report, so that it can be moved atomically.
    let beside = args.report.as_deref().map(Path::parent).unwrap_or_default();
    let beside = beside.filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let scratch = match &args.report {
        Some(_) => tempfile::Builder::new().prefix(".attempt-").tempdir_in(beside),
        None => tempfile::tempdir(),
    };
    let scratch = scratch.context("no folder for an attempt")?;
    let (document, report) = (scratch.path().join("grade.json"), scratch.path().join("report"));
    let mut command = Command::new(std::env::current_exe()?);
    command.args(std::env::args_os().skip(1).filter(|arg| arg != "--watch"));
    // Options given twice: the last one counts (`args_override_self`).
    command.arg("--build-in").arg(build);
    command.arg("--output").arg(&document).stdout(Stdio::null()).stdin(Stdio::null());
    if let Some(folder) = &args.report {
        command.arg("--report").arg(&report).arg("--hide").arg(folder);
    }
    let mut child = command.spawn().context("cannot start an attempt")?;
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        if stop.load(Ordering::Relaxed) || is_saved() {
            end(&mut child)?;
            return Ok(None);
        }
        sleep(LOOK_EVERY);
    };
    let Ok(grade) = Grade::read(&document) else { return Ok(Some(Attempt::Failed(status))) };
    if let Some(path) = &args.result.output {
        std::fs::copy(&document, path)
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    if let Some(folder) = &args.report {
        ReportFolder::replace(folder, &report)?;
    }
    Ok(Some(Attempt::Flown(Box::new(grade))))
}

/// Ends an attempt as Ctrl-C does, and waits for it: its plugins end with it.
fn end(child: &mut Child) -> Result<()> {
    let _ = kill(Pid::from_raw(child.id().cast_signed()), Signal::SIGTERM);
    child.wait().context("cannot end an attempt")?;
    Ok(())
}
