//! Runs a tool on student code before a flight, for example a linter or a build, with the plugin's confinement.

use std::ffi::OsStr;
use std::io::{self, Read};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, killpg};
use nix::unistd::Pid;

use super::confine::{Bounds, Confinement};
use super::{WATCH_EVERY, watch};

/// Maximum output that is kept, per stream. [bytes]
const MAX_OUTPUT: u64 = 64 << 20;

impl Confinement {
    /// Returns a command of `program` with the environment of student code and without input.
    pub fn command(&self, program: impl AsRef<OsStr>) -> Command {
        let mut process = Command::new(program);
        self.limits.choose_environment(&mut process);
        process.stdin(Stdio::null());
        process
    }

    /// Runs `process` to its end, confined, with the timeout `within`. Returns its output, if its stdout and stderr are
    /// pipes. Kills its descendants at its end.
    ///
    /// # Errors
    /// If the process cannot be started or waited for. [`io::ErrorKind::TimedOut`] after the timeout, and
    /// [`io::ErrorKind::OutOfMemory`] above a limit, both with a sentence.
    pub fn run(&self, mut process: Command, within: Duration) -> io::Result<Output> {
        let (bounds, _) = self.bounds();
        self.apply(&mut process, &bounds, None);
        let mut child = process.spawn()?;
        let group = Pid::from_raw(child.id().cast_signed());
        let stdout = child.stdout.take().map(read).transpose()?;
        let stderr = child.stderr.take().map(read).transpose()?;
        let ended = self.wait(&mut child, group, &bounds, within);
        // Remaining descendants would keep the pipes open.
        let _ = killpg(group, Signal::SIGKILL);
        bounds.group().kill();
        let status = match ended {
            Ok(status) => status,
            Err(error) => {
                let _ = child.wait();
                return Err(error);
            }
        };
        let text = |reader: Option<std::thread::JoinHandle<Vec<u8>>>| {
            reader.and_then(|reader| reader.join().ok()).unwrap_or_default()
        };
        Ok(Output { status, stdout: text(stdout), stderr: text(stderr) })
    }

    fn wait(
        &self,
        child: &mut Child,
        group: Pid,
        bounds: &Bounds,
        within: Duration,
    ) -> io::Result<std::process::ExitStatus> {
        let began = Instant::now();
        let mut looked = began;
        loop {
            if let Some(status) = child.try_wait()? {
                return Ok(status);
            }
            if began.elapsed() > within {
                let sentence = format!("it took longer than {:.0} s", within.as_secs_f64());
                return Err(io::Error::new(io::ErrorKind::TimedOut, sentence));
            }
            if looked.elapsed() > WATCH_EVERY {
                looked = Instant::now();
                let counted = bounds.counts_itself().then(|| watch::count(group, bounds.in_cell()));
                if let Some(why) = watch::beyond_limits(&self.limits, bounds.group(), counted) {
                    return Err(io::Error::new(io::ErrorKind::OutOfMemory, why));
                }
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

/// Reads a pipe to its end in a new thread, and keeps the first [`MAX_OUTPUT`].
fn read(mut pipe: impl Read + Send + 'static) -> io::Result<std::thread::JoinHandle<Vec<u8>>> {
    let thread = std::thread::Builder::new().name("tool-output".into());
    thread.spawn(move || {
        let mut text = Vec::new();
        let _ = pipe.by_ref().take(MAX_OUTPUT).read_to_end(&mut text);
        let _ = io::copy(&mut pipe, &mut io::sink());
        text
    })
}
