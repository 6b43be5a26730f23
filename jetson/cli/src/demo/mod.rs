//! `vizflyt demo`: everything on this machine.
//!
//! ```text
//! prepare   generate (or find) the scene: scene.ply, arena.toml, truth.json
//! keys      pair server and runtime, for this demo only
//! serve     start the render server; it says which ports it got
//! fly       start the runtime with the plugin; it says which port waits for MAVLink
//! sim       start the simulated lab: vehicle, autopilot, mocap
//! watch     print events, until the runtime ends (or a person ends the demo)
//! report    join what the three measured
//! ```
//! The three are real processes that talk over UDP, QUIC and shared memory. This one only starts
//! them, listens, and ends them.

mod child;
mod keys;
mod memory;
mod prepare;
mod report;

use std::ffi::OsString;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use clap::Args;
use serde_json::Value;
use vizflyt_server::render::RendererKind;

use self::child::{Child, Notice, Role};
use self::keys::Keys;
use self::memory::MemoryWatch;
use self::prepare::Stage;
use self::report::Parts;

/// Flies the simulated lab on this machine: scene, render server, runtime, plugin, vehicle, page.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt demo                                  fly the forest and watch it in the browser
  vizflyt demo --scene race --seed 3            another scene, another course
  vizflyt demo --headless --report out.json     no browser; figures as JSON; status 0 if finished
  vizflyt demo --plugin ./my_plugin             your plugin instead of the example")]
pub(crate) struct DemoArgs {
    /// forest, race, room; or the path of a scene folder, an arena.toml or a scene file.
    #[arg(long, default_value = "forest")]
    scene: String,
    /// Plugin to fly: an executable, or the name of a built-in example.
    #[arg(long, default_value = "avoid")]
    plugin: String,
    /// Seed of the generated scene and of the simulator's noise.
    #[arg(long, default_value_t = 7)]
    seed: u64,
    /// Lands after this many seconds of flight; without it the course's own time limit counts. [s]
    #[arg(long)]
    seconds: Option<f64>,
    /// What draws: a graphics card if one answers, the processor, or any graphics adapter.
    #[arg(long, value_enum, value_name = "KIND", default_value_t)]
    renderer: RendererKind,
    /// Opens no browser.
    #[arg(long)]
    headless: bool,
    /// Writes the flight's figures to this file as JSON.
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// Port of the page; a free one without it.
    #[arg(long, default_value_t = 0)]
    port: u16,
    /// Folder for the flight log.
    #[arg(long, value_name = "DIR", default_value = "flights")]
    log: PathBuf,
}

/// How long a child may take to say it is ready: a large scene is loaded and baked.
const READY_LIMIT: Duration = Duration::from_mins(2);
/// How long all children together may take to end.
const END_LIMIT: Duration = Duration::from_millis(1500);

/// Runs the demo; success only if the flight finished.
pub(crate) fn run(args: &DemoArgs, log_level: &str) -> Result<ExitCode> {
    let memory = MemoryWatch::start();
    let (notices, inbox) = mpsc::channel();
    interrupt_notices(notices.clone())?;
    let stage = Stage::prepare(&args.scene, args.seed)?;
    let keys = Keys::make()?;
    let mut show = Show {
        log_level: format!("--log-level={log_level}").into(),
        notices,
        inbox,
        children: Vec::new(),
        parts: Parts::default(),
    };
    let result = show.fly(args, &stage, &keys);
    show.end();
    let log = match result {
        Ok(Flown::To { log }) => log,
        Ok(Flown::Interrupted) => {
            tell("ended on request");
            return Ok(ExitCode::FAILURE);
        }
        Err(error) => return Err(error),
    };
    let report = show.parts.join(args.seed, memory.peak_mb(), &log);
    if let Some(path) = &args.report {
        report.write(path)?;
    }
    tell(report.summary());
    Ok(if report.outcome == "finished" { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// How the flight part of the demo ended.
enum Flown {
    /// The runtime ended; the log is there.
    To { log: String },
    /// A person ended it.
    Interrupted,
}

/// The running children and what they have said.
struct Show {
    /// The option that gives the children our log level.
    log_level: OsString,
    notices: Sender<Notice>,
    inbox: Receiver<Notice>,
    children: Vec<(Role, Child)>,
    parts: Parts,
}

impl Show {
    fn fly(&mut self, args: &DemoArgs, stage: &Stage, keys: &Keys) -> Result<Flown> {
        let page = format!("127.0.0.1:{}", args.port);
        let serve: Vec<OsString> = vec![
            "serve".into(),
            stage.arena.clone().into(),
            keys.option(),
            "--json".into(),
            "--lifeline".into(),
            "--quic=127.0.0.1:0".into(),
            "--vicon=127.0.0.1:0".into(),
            // The simulator's, whoever else the arena names.
            "--vehicle=vizflyt".into(),
            format!("--http={page}").into(),
            format!("--renderer={}", args.renderer).into(),
        ];
        let Some(server) = self.start(Role::Server, &serve)? else {
            return Ok(Flown::Interrupted);
        };
        let url = text(&server, "http")?;
        tell(format!(
            "renderer    {} ({})",
            text(&server, "renderer")?,
            text(&server, "renderer_reason")?
        ));
        tell(format!("page        {url}"));
        if !args.headless {
            open_browser(&url);
        }

        keys.note_server(&text(&server, "quic")?)?;
        let mut fly: Vec<OsString> = vec![
            "fly".into(),
            args.plugin.clone().into(),
            "--json".into(),
            "--lifeline".into(),
            format!("--server={}", text(&server, "quic")?).into(),
            keys.option(),
            "--mavlink=udpin:127.0.0.1:0".into(),
            format!("--log={}", args.log.display()).into(),
        ];
        if let Some(seconds) = args.seconds {
            fly.push(format!("--seconds={seconds}").into());
        }
        let Some(runtime) = self.start(Role::Runtime, &fly)? else {
            return Ok(Flown::Interrupted);
        };

        let mut sim: Vec<OsString> = vec![
            "sim".into(),
            "--json".into(),
            "--lifeline".into(),
            format!("--mavlink=udpout:{}", text(&runtime, "mavlink")?).into(),
            format!("--vicon={}", text(&server, "vicon")?).into(),
            format!("--spawn={}", stage.spawn).into(),
            format!("--seed={}", args.seed).into(),
        ];
        if let Some(truth) = &stage.truth {
            sim.push("--truth".into());
            sim.push(truth.clone().into());
        }
        if self.start(Role::Simulator, &sim)?.is_none() {
            return Ok(Flown::Interrupted);
        }
        if self.watch() {
            Ok(Flown::To { log: text(&runtime, "log").unwrap_or_default() })
        } else {
            Ok(Flown::Interrupted)
        }
    }

    /// Starts a child and returns its `ready` line; `None` if a person ends the demo meanwhile.
    fn start(&mut self, role: Role, args: &[OsString]) -> Result<Option<Value>> {
        let args: Vec<_> = args.iter().chain([&self.log_level]).cloned().collect();
        let child = Child::start(role, &args, &self.notices)?;
        self.children.push((role, child));
        let deadline = Instant::now() + READY_LIMIT;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.inbox.recv_timeout(left) {
                Ok(Notice::Line(from, line)) if from == role && line["ready"].is_string() => {
                    return Ok(Some(line));
                }
                Ok(Notice::Line(from, line)) => self.note(from, &line),
                Ok(Notice::Closed(from)) if from == role => {
                    bail!("the {} ended before it was ready; see its message above", role.name())
                }
                Ok(Notice::Closed(from)) => {
                    bail!("the {} ended while the {} started", from.name(), role.name())
                }
                Ok(Notice::Interrupted) => return Ok(None),
                Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {
                    bail!("the {} was not ready within {} s", role.name(), READY_LIMIT.as_secs())
                }
            }
        }
    }

    /// Prints events until the runtime ends; false if a person ends the demo first.
    fn watch(&mut self) -> bool {
        loop {
            match self.inbox.recv() {
                Ok(Notice::Line(from, line)) => self.note(from, &line),
                Ok(Notice::Closed(Role::Runtime)) => return true,
                // The runtime notices a dead server or vehicle by itself, and lands: let it.
                Ok(Notice::Closed(from)) => {
                    tell(format!("            the {} has ended", from.name()));
                }
                Ok(Notice::Interrupted) | Err(_) => return false,
            }
        }
    }

    /// Keeps a child's report; prints what is for people.
    fn note(&mut self, from: Role, line: &Value) {
        if let Some(report) = line.get("report") {
            *match from {
                Role::Server => &mut self.parts.server,
                Role::Runtime => &mut self.parts.runtime,
                Role::Simulator => &mut self.parts.simulator,
            } = report.clone();
        }
        // The server repeats to its page what the runtime says: take each from its source.
        if from == Role::Runtime
            && let Some(sentence) = line["event"]["text"].as_str()
        {
            tell(format!("            {sentence}"));
        }
    }

    /// Ends every child and keeps the reports they print on the way out.
    fn end(&mut self) {
        let deadline = Instant::now() + END_LIMIT;
        for (_, child) in &mut self.children {
            child.ask_to_end();
        }
        for (_, child) in &mut self.children {
            child.wait_until(deadline);
        }
        // Each child's reader closes behind its last line, so this ends.
        let mut open = self.children.len();
        while open > 0 {
            match self.inbox.recv_timeout(END_LIMIT) {
                Ok(Notice::Line(from, line)) => self.note(from, &line),
                Ok(Notice::Closed(_)) => open -= 1,
                Ok(Notice::Interrupted) => {}
                Err(_) => break,
            }
        }
    }
}

/// Returns a text field of a `ready` line.
fn text(ready: &Value, key: &str) -> Result<String> {
    ready[key]
        .as_str()
        .map(str::to_owned)
        .with_context(|| format!("the ready line {ready} has no '{key}'"))
}

/// Sends [`Notice::Interrupted`] on SIGINT and SIGTERM.
fn interrupt_notices(notices: Sender<Notice>) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot watch for signals")?;
    std::thread::spawn(move || {
        runtime.block_on(async {
            use tokio::signal::unix::{SignalKind, signal};
            let (Ok(mut interrupt), Ok(mut terminate)) =
                (signal(SignalKind::interrupt()), signal(SignalKind::terminate()))
            else {
                return;
            };
            loop {
                tokio::select! {
                    _ = interrupt.recv() => {}
                    _ = terminate.recv() => {}
                }
                if notices.send(Notice::Interrupted).is_err() {
                    return;
                }
            }
        });
    });
    Ok(())
}

/// Prints a line for people; unlike `println!` it does not panic when nobody reads any more.
pub(crate) fn tell(line: impl std::fmt::Display) {
    use std::io::Write;
    let mut out = std::io::stdout().lock();
    let _ = writeln!(out, "{line}").and_then(|()| out.flush());
}

/// Opens the page where there is a desktop; the address is printed in any case.
pub(crate) fn open_browser(url: &str) {
    let opener = if cfg!(target_os = "macos") { "open" } else { "xdg-open" };
    let quiet = std::process::Stdio::null;
    let spawned = std::process::Command::new(opener)
        .arg(url)
        .stdin(quiet())
        .stdout(quiet())
        .stderr(quiet())
        .spawn();
    if spawned.is_err() {
        tell("            open it in a browser");
    }
}
