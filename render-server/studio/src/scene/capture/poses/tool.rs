//! Runs an external program, reads its progress, and returns its error output if it fails.

use std::io::{BufRead, BufReader, ErrorKind, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use anyhow::{Context, Result, anyhow, bail};

use super::log::{self, Phase};

/// Name of a program, and log file for its output.
pub(super) struct Tool<'a> {
    pub(super) name: &'a str,
    pub(super) log: &'a Path,
}

impl Tool<'_> {
    /// Runs a command to its end. Kills it if this function returns early.
    ///
    /// # Errors
    /// It cannot be started, or it fails.
    pub(super) fn run(&self, command: &mut Command, progress: &mut dyn FnMut(Phase)) -> Result<()> {
        let mut file = std::fs::OpenOptions::new()
            .create(true)
            .append(true)
            .open(self.log)
            .with_context(|| format!("cannot write {}", self.log.display()))?;
        // Both streams share a pipe, so that none can fill up while the other is read.
        let (reader, writer) = std::io::pipe().context("cannot make a pipe")?;
        let child = {
            let twin = writer.try_clone().context("cannot make a pipe")?;
            command.stdin(Stdio::null()).stdout(twin).stderr(writer).spawn()
        };
        let mut child =
            Ended(child.map_err(|error| anyhow!("cannot start {}: {error}", self.name))?);
        // The command also holds the write ends; close them.
        command.stdout(Stdio::null()).stderr(Stdio::null());
        let mut reader = BufReader::new(reader);
        let mut line = Vec::new();
        let mut tail = String::new();
        loop {
            line.clear();
            match reader.read_until(b'\n', &mut line) {
                Ok(0) => break,
                Ok(_) => {}
                Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                Err(error) => {
                    return Err(error).with_context(|| format!("cannot read from {}", self.name));
                }
            }
            // A write error of the log must not stop the program.
            let _ = file.write_all(&line);
            let text = String::from_utf8_lossy(&line);
            if let Some(phase) = log::phase(&text) {
                progress(phase);
            }
            if tail.len() > TAIL_BYTES {
                tail.clear();
            }
            tail.push_str(&text);
        }
        let status = child.0.wait().with_context(|| format!("cannot wait for {}", self.name))?;
        if !status.success() {
            let said = log::error(&tail).unwrap_or("no output").to_owned();
            bail!(
                "{} failed ({status}): {said}\nits complete output is in {}",
                self.name,
                self.log.display()
            );
        }
        Ok(())
    }
}

/// Child process that is killed on drop.
struct Ended(Child);

impl Drop for Ended {
    fn drop(&mut self) {
        // These have no effect on a process that has ended.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Returns the output of a short command; `None` if it is not installed or fails.
pub(super) fn ask(command: &mut Command) -> Option<String> {
    let output = command.stdin(Stdio::null()).output().ok()?;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    output.status.success().then_some(text)
}

/// Size of the last part of the output in which an error is searched.
const TAIL_BYTES: usize = 64 << 10;
