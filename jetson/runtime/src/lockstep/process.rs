//! Plugin process that the caller waits for: starts, greets, sends one observation at a time, stops.

use std::ffi::OsString;
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::{Duration, Instant};

use vizflyt_protocol::flight_end::PluginFault;
use vizflyt_protocol::messages::{
    FromPlugin, MAX_ODOMETRY_PER_REPLY, Odometry, Setpoint, ToPlugin,
};
use vizflyt_protocol::packet::ObservationHeader;
use vizflyt_sdk::ObservationTooLarge;
use vizflyt_sdk::ipc::{IpcError, LoanedObservation, RuntimeEnd};

use super::own_time::{OwnTime, look};
use crate::console::printable;
use crate::supervisor::{Confinement, PluginEvent, PluginLimits, Stream, Supervisor};

/// Maximum own time of a plugin for attaching and loading, because models load slowly.
const READY_WITHIN: Duration = Duration::from_mins(5);

/// Timeout for the last lines of a plugin that has ended.
const LAST_LINES_WITHIN: Duration = Duration::from_secs(5);

/// Why a plugin's process cannot continue.
#[derive(Debug, thiserror::Error)]
pub enum ProcessError {
    /// Shared memory failed.
    #[error(transparent)]
    Ipc(#[from] IpcError),
    /// The observation does not fit into the shared memory.
    #[error(transparent)]
    TooLarge(#[from] ObservationTooLarge),
    /// The plugin's program cannot be started.
    #[error("the plugin {0} cannot be started: {1}")]
    Start(String, std::io::Error),
    /// The plugin failed.
    #[error("{0}")]
    Failed(Box<PluginFault>),
    /// The plugin ended for a reason that it did not cause.
    #[error("{0}")]
    Lost(String),
}

/// Receives the lines that the plugin prints.
pub type LineSink<'a> = &'a mut dyn FnMut(Stream, &str);

/// Plugin process and the runtime's end of its shared memory. The process ends with the thread that started it.
#[derive(Debug)]
pub struct PluginProcess {
    ipc: RuntimeEnd,
    supervisor: Supervisor,
    events: Receiver<PluginEvent>,
    /// Maximum own time of the plugin for a reply, or for reading an event; longer is a failure.
    within: Duration,
    /// Published estimates that the caller has not taken yet.
    odometry: Vec<Odometry>,
}

impl PluginProcess {
    /// Starts `command` (program, then arguments), confined as in flight by `limits`. A reply may take `within` of the
    /// plugin's own time: computing time, and voluntary sleep.
    ///
    /// # Errors
    /// [`ProcessError::Start`] and [`ProcessError::Ipc`].
    pub fn start(
        command: &[OsString],
        limits: &PluginLimits,
        within: Duration,
    ) -> Result<Self, ProcessError> {
        let confinement = Confinement::prepare(limits, command);
        let ipc = RuntimeEnd::new(size_of::<ObservationHeader>());
        let socket = ipc.connect()?;
        let (sender, events) = channel();
        let handle = move |event| {
            let _ = sender.send(event);
        };
        let supervisor = Supervisor::start(command, &confinement, Some(socket), handle);
        let supervisor = supervisor.map_err(|error| {
            let program = command.first().map(|program| program.to_string_lossy().into_owned());
            ProcessError::Start(program.unwrap_or_default(), error)
        })?;
        Ok(Self { ipc, supervisor, events, within, odometry: Vec::new() })
    }

    /// Returns the process id.
    pub fn id(&self) -> u32 {
        self.supervisor.id()
    }

    /// Greets the plugin with `start` after it has attached, and waits until it is ready, at most five minutes of its
    /// own time.
    ///
    /// # Errors
    /// [`ProcessError::Failed`] if the plugin ends, gives up or takes longer; [`ProcessError::Lost`] if another process
    /// ends or stops it.
    pub fn begin(&mut self, start: &ToPlugin, line: LineSink<'_>) -> Result<(), ProcessError> {
        let mut time = OwnTime::new(Instant::now());
        while !self.ipc.plugin_attached() {
            if let Some(why) = self.pass_lines(line) {
                return Err(end_of(why));
            }
            if self.has_taken(&mut time, READY_WITHIN)? {
                return Err(failed("the plugin did not attach within five minutes"));
            }
            thread::sleep(Duration::from_millis(2));
        }
        self.send(start, line)?;
        loop {
            match self.next(line)? {
                Some(FromPlugin::Ready { .. }) => return Ok(()),
                Some(FromPlugin::Failed { reason }) => {
                    return Err(failed(&printable(reason.as_str())));
                }
                Some(FromPlugin::Reply { .. } | FromPlugin::Odometry(_)) | None => {
                    if self.has_taken(&mut time, READY_WITHIN)? {
                        return Err(failed("`on_start` did not return within five minutes"));
                    }
                }
            }
        }
    }

    /// Sends a message; waits for room in the queue if many messages were sent since the last image.
    ///
    /// # Errors
    /// [`ProcessError::Failed`] if the plugin has ended or does not read.
    pub fn send(&mut self, message: &ToPlugin, line: LineSink<'_>) -> Result<(), ProcessError> {
        let mut time = OwnTime::new(Instant::now());
        loop {
            match self.ipc.send(message) {
                // The end of the plugin is detected when the next image has no reply.
                Ok(()) | Err(IpcError::Gone(_)) => return Ok(()),
                Err(IpcError::QueueFull(_)) => {
                    if let Some(why) = self.pass_lines(line) {
                        return Err(end_of(why));
                    }
                    if self.has_taken(&mut time, self.within)? {
                        let seconds = self.within.as_secs_f64();
                        let why = format!("the plugin has read no event for {seconds:.0} s");
                        return Err(failed(&why));
                    }
                    thread::sleep(Duration::from_millis(2));
                }
                Err(error) => return Err(error.into()),
            }
        }
    }

    /// Lends shared memory for one observation of `len` bytes, zeroed and aligned to 64.
    ///
    /// # Errors
    /// [`ProcessError::Ipc`] if there is not enough memory.
    pub fn loan(&self, len: usize) -> Result<LoanedObservation, ProcessError> {
        Ok(self.ipc.loan(len)?)
    }

    /// Publishes observation `seq` and waits for the reply.
    ///
    /// # Errors
    /// [`ProcessError::Failed`] if the plugin ends, gives up or exceeds its time; [`ProcessError::Lost`] if another
    /// process ends or stops it.
    pub fn ask(
        &mut self,
        seq: u64,
        observation: LoanedObservation,
        line: LineSink<'_>,
    ) -> Result<Option<Setpoint>, ProcessError> {
        self.ipc.publish(observation)?;
        let mut time = OwnTime::new(Instant::now());
        loop {
            match self.next(line)? {
                Some(FromPlugin::Reply { seq: found, setpoint, .. }) if found == seq => {
                    return Ok(setpoint);
                }
                Some(FromPlugin::Failed { reason }) => {
                    let reason = printable(reason.as_str());
                    return Err(failed(&format!("the plugin failed: {reason}")));
                }
                Some(FromPlugin::Odometry(odometry))
                    if self.odometry.len() < MAX_ODOMETRY_PER_REPLY =>
                {
                    self.odometry.push(odometry);
                }
                // Also if the plugin sends anything except the reply.
                Some(_) | None => {
                    if self.has_taken(&mut time, self.within)? {
                        let silent_s = self.within.as_secs_f64();
                        let fault = PluginFault::NoAnswer { image: seq, silent_s };
                        return Err(ProcessError::Failed(Box::new(fault)));
                    }
                }
            }
        }
    }

    /// Takes the published odometry, at most [`MAX_ODOMETRY_PER_REPLY`] estimates per observation.
    pub fn take_odometry(&mut self) -> Vec<Odometry> {
        std::mem::take(&mut self.odometry)
    }

    /// Stops the plugin in an orderly way.
    pub fn stop(self, line: LineSink<'_>) {
        if self.ipc.plugin_attached() {
            let _ = self.ipc.send(&ToPlugin::Stop);
        }
        self.supervisor.end();
        self.ipc.clean_up();
        // The last lines are still in the pipes, which close after all their writers have ended.
        let until = Instant::now() + LAST_LINES_WITHIN;
        while let Ok(event) =
            self.events.recv_timeout(until.saturating_duration_since(Instant::now()))
        {
            if let PluginEvent::Line(stream, text) = event {
                line(stream, &text);
            }
        }
    }

    /// Whether the plugin's [own time](OwnTime) exceeds `within`. Samples it periodically.
    fn has_taken(&self, time: &mut OwnTime, within: Duration) -> Result<bool, ProcessError> {
        if time.is_due(Instant::now()) {
            let sample = look(self.supervisor.id());
            // Reading the sample took time, too.
            time.take(Instant::now(), sample);
        }
        if time.is_lost() {
            let why = "the plugin got no processor time for ten minutes: it was stopped, or the computer is overloaded";
            return Err(ProcessError::Lost(why.to_owned()));
        }
        Ok(time.taken() > within)
    }

    /// Returns the plugin's next message; `None` after a timeout.
    fn next(&mut self, line: LineSink<'_>) -> Result<Option<FromPlugin>, ProcessError> {
        if let Some(message) = self.receive()? {
            return Ok(Some(message));
        }
        self.ipc.wait(Duration::from_millis(50))?;
        let ended = self.pass_lines(line);
        // Messages sent before its end are still handled.
        match (self.receive()?, ended) {
            (Some(message), _) => Ok(Some(message)),
            (None, Some(why)) => Err(end_of(why)),
            (None, None) => Ok(None),
        }
    }

    fn receive(&self) -> Result<Option<FromPlugin>, ProcessError> {
        match self.ipc.receive() {
            // A message that cannot be decoded is the plugin's fault; continue with the next one.
            Err(IpcError::Message(_)) => Ok(None),
            result => Ok(result?),
        }
    }

    /// Passes printed lines to `line`; returns the reason for the plugin's end, if it has ended.
    pub fn pass_lines(&mut self, line: LineSink<'_>) -> Option<String> {
        let mut ended = None;
        for event in self.events.try_iter() {
            match event {
                PluginEvent::Line(stream, text) => line(stream, &text),
                PluginEvent::Note(text) => tracing::debug!("plugin: {text}"),
                PluginEvent::Exited(sentence) => ended = Some(sentence),
            }
        }
        ended
    }
}

/// Returns the error for the end of a plugin. SIGKILL comes from the kernel if memory is short, or from a person; a
/// plugin that exceeds its own limits ends with another sentence.
fn end_of(why: String) -> ProcessError {
    if why.starts_with("the plugin was killed by SIGKILL") {
        return ProcessError::Lost(why);
    }
    failed(&why)
}

fn failed(why: &str) -> ProcessError {
    ProcessError::Failed(Box::new(PluginFault::ended(why)))
}
