//! Runs the plugin as a confined child process: reads its output line by line, checks its limits,
//! reports its end at once in one sentence, and kills it if the runtime ends.
//!
//! [`PluginLimits`] holds the settings, [`Confinement`] applies them with the features of this kernel,
//! [`Supervisor`] is one running process. The [control loop](crate::control) decides about restarts.

mod cell;
mod cgroup;
mod confine;
mod limits;
mod occupation;
mod output;
#[cfg(test)]
mod tests;
mod tool;
mod watch;

use std::ffi::OsString;
use std::io;
use std::os::unix::process::ExitStatusExt;
use std::process::{Child, ExitStatus, Stdio};
use std::sync::{Arc, Condvar, Mutex, PoisonError, mpsc};
use std::thread;
use std::time::Duration;
use vizflyt_process::lock;

use nix::sys::signal::{Signal, killpg};
use nix::unistd::Pid;
use vizflyt_protocol::time::HostTime;
use vizflyt_sdk::host_now;
use vizflyt_sdk::ipc::PluginSocket;

use confine::Bounds;
use occupation::{Look, Occupation};
use output::{Tracebacks, read_lines};

pub use confine::{Confinement, is_python};
pub use limits::{MIN_MEMORY_MB, PluginLimits, Restart};
pub use occupation::TimeSpent;
pub use output::LINE_BYTES;

/// Output stream of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stream {
    /// `print`.
    Stdout,
    /// Errors, tracebacks, panics.
    Stderr,
}

/// An event of the plugin's process.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PluginEvent {
    /// A line that the plugin printed, cut at [`LINE_BYTES`].
    Line(Stream, String),
    /// A missing protection or limit, as a sentence for the operator.
    Note(String),
    /// The process ended, for the reason in this sentence.
    Exited(String),
}

/// The running plugin.
#[derive(Debug)]
pub struct Supervisor {
    shared: Arc<SharedState>,
}

/// State shared by the supervisor's threads.
struct SharedState {
    group: Pid,
    bounds: Bounds,
    limits: PluginLimits,
    ended: Mutex<Option<ExitStatus>>,
    changed: Condvar,
    /// The newest line on standard error.
    last_error: Mutex<String>,
    /// Reason for which the supervisor killed the process.
    kill_reason: Mutex<Option<String>>,
    occupation: Mutex<Occupation>,
}

/// Maximum delay of the report of the end, for the last lines on standard error.
const LAST_LINE_WITHIN: Duration = Duration::from_millis(100);
/// Timeout of each step of an orderly end.
const END_WITHIN: Duration = Duration::from_millis(300);
/// Period at which limits and occupation are sampled: a leak of 2 GB/s adds 200 MB.
const WATCH_EVERY: Duration = Duration::from_millis(100);

impl Supervisor {
    /// Starts `command` (program, then arguments), confined, with its end of the socket to the runtime.
    /// The supervisor's threads call `handle`.
    ///
    /// The kernel kills the child when the calling thread ends (`PR_SET_PDEATHSIG`): call this from a
    /// thread that runs during the whole flight.
    ///
    /// # Errors
    /// If the program cannot be started.
    pub fn start(
        command: &[OsString],
        confinement: &Confinement,
        socket: Option<PluginSocket>,
        handle: impl Fn(PluginEvent) + Clone + Send + 'static,
    ) -> io::Result<Self> {
        let (program, arguments) = command
            .split_first()
            .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "no plugin given"))?;
        let (bounds, notes) = confinement.bounds();
        let mut process = confinement.command(program);
        process.args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped());
        // The runtime's own environment may contain a map of another course.
        process.env_remove(vizflyt_sdk::MAP_VARIABLE);
        if let Some(map) = &confinement.limits.map {
            process.env(vizflyt_sdk::MAP_VARIABLE, map);
        }
        process.args(socket.as_ref().map(PluginSocket::argument));
        confinement.apply(&mut process, &bounds, socket);
        let mut child = process.spawn()?;
        for note in notes {
            handle(PluginEvent::Note(note));
        }
        let shared = Arc::new(SharedState {
            group: Pid::from_raw(child.id() as i32),
            bounds,
            limits: confinement.limits.clone(),
            ended: Mutex::new(None),
            changed: Condvar::new(),
            last_error: Mutex::new(String::new()),
            kill_reason: Mutex::new(None),
            occupation: Mutex::default(),
        });
        if let Some(stdout) = child.stdout.take() {
            let handle = handle.clone();
            spawn("plugin-stdout", move || {
                read_lines(stdout, |line| handle(PluginEvent::Line(Stream::Stdout, line)));
            })?;
        }
        // Disconnected when standard error has been read to its end.
        let (reading, is_read) = mpsc::channel::<()>();
        if let Some(stderr) = child.stderr.take() {
            let (handle, shared) = (handle.clone(), Arc::clone(&shared));
            let mut tracebacks = Tracebacks::new(confinement.own_folders().to_vec());
            spawn("plugin-stderr", move || {
                let mut handle = |line| handle(PluginEvent::Line(Stream::Stderr, line));
                read_lines(stderr, |line| {
                    if !line.trim().is_empty() {
                        lock(&shared.last_error).clone_from(&line);
                    }
                    tracebacks.take(line, &mut handle);
                });
                tracebacks.end(&mut handle);
                drop(reading);
            })?;
        }
        let watched = Arc::clone(&shared);
        spawn("plugin-watch", move || watched.watch())?;
        let waited = Arc::clone(&shared);
        spawn("plugin-wait", move || waited.wait(child, &is_read, &handle))?;
        Ok(Self { shared })
    }

    /// Returns the process id.
    pub fn id(&self) -> u32 {
        self.shared.group.as_raw().cast_unsigned()
    }

    /// Whether the process still runs.
    pub fn is_running(&self) -> bool {
        lock(&self.shared.ended).is_none()
    }

    /// Returns how the process and its descendants spent the time from `since` on; `None` with fewer than two samples.
    pub fn time_spent(&self, since: HostTime) -> Option<TimeSpent> {
        lock(&self.shared.occupation).since(since)
    }

    /// Ends the process and its descendants: waits 0.3 s (a message has requested the end), sends
    /// SIGTERM, waits 0.3 s more, and sends SIGKILL. Returns after the end, or 1 s after SIGKILL.
    pub fn end(&self) {
        if !self.shared.wait_ended(END_WITHIN) {
            self.signal(Signal::SIGTERM);
            if !self.shared.wait_ended(END_WITHIN) {
                self.kill();
                // A process in uninterruptible sleep may take longer; the flight does not wait.
                self.shared.wait_ended(Duration::from_secs(1));
            }
        }
    }

    /// Kills the process and its descendants without waiting; [`PluginEvent::Exited`] reports the end.
    pub fn kill(&self) {
        if self.is_running() {
            self.shared.kill();
        }
    }

    fn signal(&self, signal: Signal) {
        if self.is_running() {
            // ESRCH: the process has just ended.
            let _ = killpg(self.shared.group, signal);
        }
    }
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        self.kill();
    }
}

impl SharedState {
    fn kill(&self) {
        let _ = killpg(self.group, Signal::SIGKILL);
        self.bounds.group().kill();
    }

    fn wait_ended(&self, timeout: Duration) -> bool {
        let state = lock(&self.ended);
        let (state, _) = self
            .changed
            .wait_timeout_while(state, timeout, |status| status.is_none())
            .unwrap_or_else(PoisonError::into_inner);
        state.is_some()
    }

    /// Checks the limits until the process has ended; kills it if it exceeds one.
    fn watch(&self) {
        while !self.wait_ended(WATCH_EVERY) {
            self.look();
            if let Some(sentence) = self.beyond_limits() {
                *lock(&self.kill_reason) = Some(sentence);
                self.kill();
                return;
            }
        }
    }

    /// Samples the occupation of the process and its descendants.
    fn look(&self) {
        let members = self.bounds.group().members();
        let processes = if members.is_empty() {
            watch::processes(self.group, self.bounds.in_cell())
        } else {
            members
        };
        lock(&self.occupation).add(Look::at(host_now(), &processes));
    }

    fn beyond_limits(&self) -> Option<String> {
        let counted =
            self.bounds.counts_itself().then(|| watch::count(self.group, self.bounds.in_cell()));
        watch::beyond_limits(&self.limits, self.bounds.group(), counted)
    }

    /// Waits for the end of the process, kills its remaining descendants, and reports the end.
    fn wait(&self, mut child: Child, is_read: &mpsc::Receiver<()>, handle: &impl Fn(PluginEvent)) {
        let status = child.wait();
        // Remaining descendants would keep the pipes open and use the processor.
        self.kill();
        // The last line is the cause in words. On a busy machine, the thread that reads it needs some time.
        let _ = is_read.recv_timeout(LAST_LINE_WITHIN);
        let last = lock(&self.last_error).clone();
        let kill_reason = lock(&self.kill_reason).take();
        let sentence = match &status {
            // The kernel may have enforced a limit before the watch thread saw it.
            Ok(status) => kill_reason
                .or_else(|| watch::beyond_limits(&self.limits, self.bounds.group(), None))
                .unwrap_or_else(|| describe(*status, &last)),
            Err(error) => format!("the plugin cannot be watched: {error}"),
        };
        *lock(&self.ended) = Some(status.unwrap_or_default());
        self.changed.notify_all();
        handle(PluginEvent::Exited(sentence));
    }
}

impl std::fmt::Debug for SharedState {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SharedState").field("group", &self.group).finish_non_exhaustive()
    }
}

fn spawn(name: &str, run: impl FnOnce() + Send + 'static) -> io::Result<thread::JoinHandle<()>> {
    thread::Builder::new().name(name.into()).spawn(run)
}

/// Returns the end of a process as a sentence.
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
                Ok(Signal::SIGKILL) => ": by a user, or by the kernel because memory ran out",
                _ => "",
            };
            format!("the plugin was killed by {name}{meaning}")
        }
        (None, None) => "the plugin ended".to_owned(),
    };
    if !status.success() && !last_error.is_empty() {
        text = format!("{text}; last line on stderr: {last_error}");
    }
    text + hint(last_error)
}

/// Returns the setting that causes an error, as a hint; empty if the error is not caused by a limit.
fn hint(last_error: &str) -> &'static str {
    let mentions = |marks: &[&str]| marks.iter().any(|mark| last_error.contains(mark));
    if mentions(&["memory allocation of", "MemoryError", "bad_alloc"]) {
        " (memory_mb in [plugin] allows no more)"
    } else if mentions(&["Network is unreachable"]) {
        " (a plugin has no network unless [plugin] sets network = true)"
    } else if mentions(&["Permission denied", "PermissionError", "Read-only file system"]) {
        " (a plugin writes in its own folder, /tmp, and what [plugin] write lists)"
    } else if mentions(&["No such file", "ModuleNotFoundError", "FileNotFoundError"]) {
        " (a plugin sees its own folder, the working folder, its interpreter, the system, and what [plugin] read lists)"
    } else {
        ""
    }
}
