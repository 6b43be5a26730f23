//! A child process of the simulated lab: this program with another subcommand. Its standard output
//! is read as JSON lines. The pipe to its standard input ends it when the parent ends.

use std::ffi::OsString;
use std::io::{BufRead, BufReader};
use std::process::{Child as Process, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

/// Which child process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Role {
    /// `vizflyt serve`
    Server,
    /// `vizflyt fly`
    Runtime,
    /// `vizflyt sim`
    Simulator,
    /// `vizflyt bridge emulate`
    Bridge,
    /// `vizflyt tags locate`
    Tags,
}

impl Role {
    /// Returns the child's name for messages.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Server => "render server",
            Self::Runtime => "runtime",
            Self::Simulator => "simulator",
            Self::Bridge => "bridge",
            Self::Tags => "AprilTag localization",
        }
    }
}

/// Message to the main loop.
#[derive(Debug)]
pub(crate) enum Notice {
    /// A child printed a JSON line.
    Line(Role, Value),
    /// A child closed its standard output: it has ended or is about to.
    Closed(Role),
    /// The user pressed Ctrl-C.
    Interrupted,
}

pub(crate) struct Child {
    role: Role,
    process: Process,
    /// The child ends when this pipe is closed; the kernel closes it if the parent dies.
    lifeline: Option<ChildStdin>,
}

impl Child {
    /// Starts `vizflyt ARGS`. The child's lines and its end are sent to `notices`.
    pub(crate) fn start(role: Role, args: &[OsString], notices: &Sender<Notice>) -> Result<Self> {
        let program = std::env::current_exe().context("cannot find this program's own path")?;
        let mut process = Command::new(program)
            .args(args)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start the {}", role.name()))?;
        let lifeline = process.stdin.take();
        if let Some(stdout) = process.stdout.take() {
            let notices = notices.clone();
            std::thread::spawn(move || {
                for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                    if let Ok(value) = serde_json::from_str(&line) {
                        // The receiver may have ended; then the line is not needed.
                        drop(notices.send(Notice::Line(role, value)));
                    } else {
                        tracing::warn!("{} printed: {line}", role.name());
                    }
                }
                drop(notices.send(Notice::Closed(role)));
            });
        }
        Ok(Self { role, process, lifeline })
    }

    /// Requests the child's end by signal and by closing the lifeline.
    pub(crate) fn ask_to_end(&mut self) {
        self.lifeline = None;
        if let Ok(None) = self.process.try_wait() {
            // The child has not been reaped, so the pid still belongs to it.
            let _ = kill(Pid::from_raw(self.process.id() as i32), Signal::SIGTERM);
        }
    }

    /// Waits for the child's end until `deadline`, then kills it.
    pub(crate) fn wait_until(&mut self, deadline: Instant) -> Option<ExitStatus> {
        loop {
            match self.process.try_wait() {
                Ok(Some(status)) => return Some(status),
                Ok(None) if Instant::now() < deadline => {
                    std::thread::sleep(Duration::from_millis(10));
                }
                Ok(None) => {
                    tracing::warn!("the {} did not end in time; killed it", self.role.name());
                    let _ = self.process.kill();
                    return self.process.wait().ok();
                }
                Err(_) => return None,
            }
        }
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
