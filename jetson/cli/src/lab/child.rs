//! One child process of the simulated lab: the same binary with another subcommand, its standard output
//! read as JSON lines, its life bound to ours by the pipe on its standard input.

use std::ffi::OsString;
use std::io::{BufRead, BufReader};
use std::process::{Child as Process, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

/// Which child speaks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Role {
    /// `vizflyt serve`.
    Server,
    /// `vizflyt fly`.
    Runtime,
    /// `vizflyt sim`.
    Simulator,
    /// `vizflyt bridge emulate`.
    Bridge,
    /// `vizflyt tags locate`.
    Tags,
}

impl Role {
    /// The child's name for people.
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

/// What the one loop waits for.
#[derive(Debug)]
pub(crate) enum Notice {
    /// A child printed a JSON line.
    Line(Role, Value),
    /// A child closed its standard output: it has ended or is about to.
    Closed(Role),
    /// A person asked for the end.
    Interrupted,
}

/// A running child.
pub(crate) struct Child {
    role: Role,
    process: Process,
    /// Closing this is the child's sign to end; the kernel closes it if we die.
    lifeline: Option<ChildStdin>,
}

impl Child {
    /// Starts `vizflyt ARGS`; its lines and its end arrive at `notices`.
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
                        // It may all have ended; then nobody needs the line.
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

    /// Asks the child to end: signal and lifeline both.
    pub(crate) fn ask_to_end(&mut self) {
        self.lifeline = None;
        if let Ok(None) = self.process.try_wait() {
            // The child was alive a moment ago and is not reaped, so the pid is still its own.
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
                    tracing::warn!("the {} did not end in time and is killed", self.role.name());
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
