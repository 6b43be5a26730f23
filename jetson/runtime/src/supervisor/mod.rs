//! The plugin as a child process: started in its own process group, its output read line by line,
//! its death noticed at once and told in one sentence, never outliving the runtime.

#[cfg(test)]
mod tests;

use std::ffi::OsString;
use std::io::{self, BufRead, BufReader, Read};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use nix::sys::signal::{Signal, killpg};
use nix::unistd::{Pid, getppid};

/// Which of the two outputs a line came from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stream {
    /// `print`.
    Stdout,
    /// Errors, tracebacks, panics.
    Stderr,
}

/// What the supervisor tells.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PluginEvent {
    /// A line that the plugin printed, cut at [`LINE_BYTES`].
    Line(Stream, String),
    /// The process ended; how, in a sentence.
    Exited(String),
}

/// The running plugin.
#[derive(Debug)]
pub struct Supervisor {
    group: Pid,
    ended: Arc<(Mutex<Option<ExitStatus>>, Condvar)>,
}

/// Longest part of a line that is kept. [bytes]
pub const LINE_BYTES: usize = 1024;
/// Lines passed on per stream and second; the rest is counted. A plugin that prints per image and
/// camera stays below.
const LINES_PER_SECOND: u32 = 200;
/// Time a plugin has to end when asked.
const END_WITHIN: Duration = Duration::from_millis(300);

impl Supervisor {
    /// Starts `command` (program, then arguments). `tell` is called from the supervisor's threads.
    ///
    /// The child dies with the thread that calls this (`PR_SET_PDEATHSIG`): call it from one that
    /// lives as long as the flight.
    ///
    /// # Errors
    /// If the program cannot be started.
    pub fn start(
        command: &[OsString],
        tell: impl Fn(PluginEvent) + Clone + Send + 'static,
    ) -> io::Result<Self> {
        let (program, arguments) = command
            .split_first()
            .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "no plugin given"))?;
        let mut process = Command::new(program);
        process
            .args(arguments)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            // So that Ctrl-C at the terminal reaches the runtime first, and grandchildren can be
            // ended with the plugin.
            .process_group(0);
        die_with_parent(&mut process);
        let mut child = process.spawn()?;
        let group = Pid::from_raw(child.id() as i32);
        let ended = Arc::new((Mutex::new(None), Condvar::new()));
        let last_error = Arc::new(Mutex::new(String::new()));

        let mut readers = Vec::new();
        if let Some(stdout) = child.stdout.take() {
            let tell = tell.clone();
            readers.push(spawn("plugin-stdout", move || {
                read_lines(stdout, |line| tell(PluginEvent::Line(Stream::Stdout, line)));
            })?);
        }
        if let Some(stderr) = child.stderr.take() {
            let (tell, last) = (tell.clone(), Arc::clone(&last_error));
            readers.push(spawn("plugin-stderr", move || {
                read_lines(stderr, |line| {
                    if !line.trim().is_empty() {
                        last.lock().unwrap_or_else(PoisonError::into_inner).clone_from(&line);
                    }
                    tell(PluginEvent::Line(Stream::Stderr, line));
                });
            })?);
        }
        let end = Arc::clone(&ended);
        spawn("plugin-wait", move || wait(child, group, &end, &last_error, &tell))?;
        Ok(Self { group, ended })
    }

    /// Returns the process id.
    pub fn id(&self) -> u32 {
        self.group.as_raw().cast_unsigned()
    }

    /// Whether the process still runs.
    pub fn is_running(&self) -> bool {
        self.ended.0.lock().unwrap_or_else(PoisonError::into_inner).is_none()
    }

    /// Ends the process and all it started: waits 0.3 s (it was asked to end by a message), then
    /// SIGTERM, 0.3 s more, then SIGKILL. Returns when it is gone.
    pub fn end(&self) {
        if !self.wait_ended(END_WITHIN) {
            self.signal(Signal::SIGTERM);
            if !self.wait_ended(END_WITHIN) {
                self.signal(Signal::SIGKILL);
                // A process in uninterruptible sleep may take longer; the flight does not wait.
                self.wait_ended(Duration::from_secs(1));
            }
        }
    }

    fn signal(&self, signal: Signal) {
        if self.is_running() {
            // ESRCH: it ended meanwhile.
            let _ = killpg(self.group, signal);
        }
    }

    fn wait_ended(&self, timeout: Duration) -> bool {
        let (state, changed) = &*self.ended;
        let state = state.lock().unwrap_or_else(PoisonError::into_inner);
        let (state, _) = changed
            .wait_timeout_while(state, timeout, |status| status.is_none())
            .unwrap_or_else(PoisonError::into_inner);
        state.is_some()
    }
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        self.signal(Signal::SIGKILL);
    }
}

fn spawn(name: &str, run: impl FnOnce() + Send + 'static) -> io::Result<thread::JoinHandle<()>> {
    thread::Builder::new().name(name.into()).spawn(run)
}

/// Makes the child die with the thread that starts it, even if that is killed.
fn die_with_parent(process: &mut Command) {
    let parent = nix::unistd::getpid();
    // SAFETY: between fork and exec only async-signal-safe calls are allowed: prctl and getppid
    // are, and neither allocates.
    unsafe {
        process.pre_exec(move || {
            nix::sys::prctl::set_pdeathsig(Signal::SIGKILL)?;
            // The parent may have died before that.
            if getppid() == parent { Ok(()) } else { Err(io::ErrorKind::BrokenPipe.into()) }
        });
    }
}

/// Waits for the end of the process, tells it at once, and ends what it left behind.
fn wait(
    mut child: Child,
    group: Pid,
    ended: &(Mutex<Option<ExitStatus>>, Condvar),
    last_error: &Mutex<String>,
    tell: &impl Fn(PluginEvent),
) {
    let status = child.wait();
    // Grandchildren would keep the pipes open and the processor busy.
    let _ = killpg(group, Signal::SIGKILL);
    // The last words travel through a pipe that another thread reads; they are usually there.
    // Waiting for them would delay the landing, so they are not waited for.
    let last = last_error.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let sentence = match &status {
        Ok(status) => describe(*status, &last),
        Err(error) => format!("the plugin cannot be watched: {error}"),
    };
    *ended.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(status.unwrap_or_default());
    ended.1.notify_all();
    tell(PluginEvent::Exited(sentence));
}

/// Returns how a process ended, in a sentence.
fn describe(status: ExitStatus, last_error: &str) -> String {
    let mut text = match (status.code(), status.signal()) {
        (Some(0), _) => "the plugin ended by itself (exit status 0)".to_owned(),
        (Some(code), _) => format!("the plugin ended with exit status {code}"),
        (None, Some(number)) => {
            let name = Signal::try_from(number).map_or("unknown signal", Signal::as_str);
            let meaning = match Signal::try_from(number) {
                Ok(Signal::SIGSEGV | Signal::SIGBUS) => ": it touched memory that is not its own",
                Ok(Signal::SIGABRT) => ": it aborted",
                Ok(Signal::SIGILL) => ": it ran an instruction this processor lacks",
                Ok(Signal::SIGFPE) => ": it divided by zero",
                Ok(Signal::SIGKILL) => ": someone, or the kernel short of memory, ended it",
                _ => "",
            };
            format!("the plugin was killed by {name}{meaning}")
        }
        (None, None) => "the plugin ended".to_owned(),
    };
    if !status.success() && !last_error.is_empty() {
        text = format!("{text}; it last said: {last_error}");
    }
    text
}

/// Reads lines to the end of the pipe, at most [`LINE_BYTES`] of each and [`LINES_PER_SECOND`].
fn read_lines(pipe: impl Read, mut tell: impl FnMut(String)) {
    let mut reader = BufReader::new(pipe);
    let (mut window, mut passed, mut dropped) = (std::time::Instant::now(), 0, 0u64);
    while let Ok(Some(line)) = read_line(&mut reader) {
        if window.elapsed() >= Duration::from_secs(1) {
            if dropped > 0 {
                tell(format!("({dropped} more lines in that second were dropped)"));
            }
            (window, passed, dropped) = (std::time::Instant::now(), 0, 0);
        }
        if passed < LINES_PER_SECOND {
            passed += 1;
            tell(line);
        } else {
            dropped += 1;
        }
    }
    if dropped > 0 {
        tell(format!("({dropped} more lines in that second were dropped)"));
    }
}

/// Reads one line, keeps the start of it; `None` at the end. Memory stays bounded whatever comes.
fn read_line(reader: &mut impl BufRead) -> io::Result<Option<String>> {
    let mut line = Vec::new();
    let mut any = false;
    loop {
        let available = match reader.fill_buf() {
            Ok(available) => available,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(error) => return Err(error),
        };
        if available.is_empty() {
            return Ok(any.then(|| String::from_utf8_lossy(&line).into_owned()));
        }
        any = true;
        let end = available.iter().position(|&byte| byte == b'\n');
        let part = &available[..end.unwrap_or(available.len())];
        let room = LINE_BYTES.saturating_sub(line.len());
        line.extend_from_slice(&part[..part.len().min(room)]);
        let used = end.map_or(available.len(), |end| end + 1);
        reader.consume(used);
        if end.is_some() {
            return Ok(Some(String::from_utf8_lossy(&line).into_owned()));
        }
    }
}
