//! `vizflyt lab`: lab day of a running server, with its checklist as text and its report as a PDF.

use std::fmt::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, Result, bail};
use clap::{Args, Subcommand};
use serde::Deserialize;
use vizflyt_process::print_line;

use crate::server_page::ServerPage;

/// Show a lab day: checklist before flights, and the queue of teams
///
/// The checklist is the page /lab of the server. It covers localization and its axes, network,
/// clocks, camera latency, battery, autopilot parameters, the fence in three places and STOP, each
/// with evidence and time. The page also has the queue in which teams book, the order of take-off,
/// the separation of several vehicles, and one STOP for all.
///
/// This command prints the address of the page and the state of the checks. It ends with status 1
/// if a check is open, failed or outdated.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt lab                                       print the page's address, open checks, and the queue
  vizflyt lab report --out monday.pdf               write checks with evidence and time, and the queue
  vizflyt lab --page http://192.168.10.2:8080 --key KEY   from another computer
  vizflyt doctor vehicle --arena arena.toml --report http://127.0.0.1:8080   report the autopilot's parameters")]
pub(crate) struct LabDayArgs {
    #[command(subcommand)]
    command: Option<LabDayCommand>,
    /// Address of the server's page
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:8080", global = true)]
    page: String,
    /// Instructor's key; not needed on the server's own computer
    ///
    /// The key is in the address /enter?key=KEY.
    #[arg(long, value_name = "KEY", global = true)]
    key: Option<String>,
}

#[derive(Subcommand, Debug)]
enum LabDayCommand {
    /// Write the lab day as a PDF: checks with evidence and time, queue, events
    Report {
        /// PDF file
        #[arg(short, long, value_name = "FILE.pdf", default_value = "lab-day.pdf")]
        out: PathBuf,
    },
}

/// Response of `GET /api/lab`, only the printed fields.
#[derive(Debug, Deserialize)]
struct Day {
    arena: String,
    checks: Vec<Check>,
    queue: Vec<Booking>,
}

#[derive(Debug, Deserialize)]
struct Check {
    title: String,
    vehicle: String,
    state: String,
    evidence: String,
    todo: String,
    ask: String,
}

#[derive(Debug, Deserialize)]
struct Booking {
    team: String,
    vehicle: String,
    state: String,
    place: Option<usize>,
}

/// Prints the state of the lab day, or writes its report.
pub(crate) fn run(args: &LabDayArgs) -> Result<ExitCode> {
    let page = ServerPage::at(&args.page).with_key(args.key.as_deref());
    if let Some(LabDayCommand::Report { out }) = &args.command {
        let pdf = ask(&page, args, "/api/lab/report.pdf")?;
        std::fs::write(out, &pdf).with_context(|| format!("cannot write {}", out.display()))?;
        print_line(format!("{}: {} bytes", out.display(), pdf.len()));
        return Ok(ExitCode::SUCCESS);
    }
    let day: Day = serde_json::from_slice(&ask(&page, args, "/api/lab")?)
        .context("cannot parse the server's reply; does it have another version?")?;
    print_line(format!("page     {}/lab", args.page.trim_end_matches('/')));
    print_line(words(&day).trim_end());
    Ok(if day.checks.iter().all(|check| check.state == "ok") {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

fn ask(page: &ServerPage<'_>, args: &LabDayArgs, path: &str) -> Result<Vec<u8>> {
    let (status, body) = page.get(path)?;
    match status {
        200 => Ok(body),
        401 | 403 => {
            let todo = match args.key {
                Some(_) => "the --key is wrong; the right one is in page-keys.toml",
                None => "give --key",
            };
            bail!("{} shows this only to its instructor: {todo}", args.page)
        }
        404 => {
            bail!("{} has no lab day: it is not a VizFlyt server, or an older version", args.page)
        }
        status => bail!("{}: {} (HTTP status {status})", args.page, String::from_utf8_lossy(&body)),
    }
}

/// Returns the lab day as text: each check, then the queue.
fn words(day: &Day) -> String {
    let mut text = format!("arena    {}\n", day.arena);
    for check in &day.checks {
        let of = if check.vehicle.is_empty() { "the room" } else { &check.vehicle };
        let state = check.state.replace('_', " ");
        // Why: writing to a String cannot fail.
        let _ = write!(text, "{state:<9}{of}: {}", check.title);
        if !check.evidence.is_empty() {
            let _ = write!(text, ": {}", check.evidence);
        }
        if check.state != "ok" {
            let todo = if check.todo.is_empty() { &check.ask } else { &check.todo };
            let _ = write!(text, "\n         to do: {todo}");
        }
        text.push('\n');
    }
    for Booking { team, vehicle, state, place } in &day.queue {
        match (state.as_str(), place) {
            ("called", _) => _ = writeln!(text, "called   {team} on {vehicle}"),
            (_, Some(place)) => _ = writeln!(text, "waits    {team} on {vehicle}, place {place}"),
            _ => {}
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prints_a_lab_day() {
        let day: Day = serde_json::from_str(
            r#"{"arena": "hall", "more": 1, "checks": [
                {"title": "net closed", "vehicle": "", "state": "ok",
                 "evidence": "looked at by Ada", "todo": "", "ask": "sign"},
                {"title": "battery", "vehicle": "wasp", "state": "failed",
                 "evidence": "14.2 V", "todo": "charge", "ask": "power"},
                {"title": "clocks", "vehicle": "wasp", "state": "not_done",
                 "evidence": "", "todo": "", "ask": "fly --wait"}],
              "queue": [{"team": "ants", "vehicle": "wasp", "state": "called", "place": null},
                        {"team": "bees", "vehicle": "wasp", "state": "waiting", "place": 1},
                        {"team": "cats", "vehicle": "wasp", "state": "done", "place": null}]}"#,
        )
        .unwrap();
        let expected = "\
arena    hall
ok       the room: net closed: looked at by Ada
failed   wasp: battery: 14.2 V
         to do: charge
not done wasp: clocks
         to do: fly --wait
called   ants on wasp
waits    bees on wasp, place 1
";
        assert_eq!(words(&day), expected);
    }
}
