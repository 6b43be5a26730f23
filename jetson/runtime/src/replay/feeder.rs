//! The runtime's end of a replay: starts the plugin, feeds it, waits for its answers.

use std::collections::HashMap;
use std::ffi::OsString;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use vizflyt_protocol::messages::{FromPlugin, Setpoint, ToPlugin};
use vizflyt_protocol::packet::ObservationHeader;
use vizflyt_rgbd::{Decoder, peek};
use vizflyt_sdk::ipc::{IpcError, RuntimeEnd, SERVICE_OPTION, unique_service};
use zerocopy::FromBytes;

use super::{ReplayError, sleep_until};
use crate::log::Observation;
use crate::supervisor::{Confinement, PluginEvent, PluginLimits, Stream, Supervisor};

/// The plugin hears of us at least this often.
const HEARTBEAT: Duration = Duration::from_millis(400);
/// How long a plugin may take to attach and to load what it needs: models take their time.
const READY_WITHIN: Duration = Duration::from_mins(5);
/// Largest observation that is fed: what eight of the largest cameras need is a faulty log.
/// [bytes]
const LARGEST: usize = 1 << 30;

/// What came of an image.
#[derive(Debug)]
#[allow(clippy::large_enum_variant)] // Why: there is one of it at a time.
pub(super) enum Answered {
    /// The plugin answered.
    With(Option<Setpoint>),
    /// The log does not hold it whole.
    Undecodable,
    /// The plugin failed: how, in a sentence.
    Failed(String),
}

/// The plugin's process and our end of its shared memory.
struct Session {
    ipc: RuntimeEnd,
    supervisor: Supervisor,
    events: Receiver<PluginEvent>,
    beaten: Instant,
}

/// Feeds one plugin process after the other, as the flight had them.
pub(super) struct Feeder<'a> {
    command: &'a [OsString],
    answer_within: Duration,
    session: Option<Session>,
    decoders: HashMap<u32, Decoder>,
}

/// A plugin that failed: how, in a sentence.
type Failed = String;

impl<'a> Feeder<'a> {
    pub(super) fn new(command: &'a [OsString], answer_within: Duration) -> Self {
        Self { command, answer_within, session: None, decoders: HashMap::new() }
    }

    /// Sends a message; a start begins a process, and ends the one before.
    pub(super) fn send(
        &mut self,
        message: &ToPlugin,
        line: &mut dyn FnMut(Stream, &str),
    ) -> Result<Result<(), Failed>, ReplayError> {
        match message {
            ToPlugin::Start(_) => {
                self.stop(line);
                let session = self.session.insert(Session::start(self.command)?);
                session.begin(message, line)
            }
            // Ours comes at the end of the log.
            ToPlugin::Stop => Ok(Ok(())),
            ToPlugin::Event(_) => match &mut self.session {
                Some(session) => session.send(message, self.answer_within, line),
                None => Ok(Ok(())),
            },
        }
    }

    /// Publishes an observation and waits for its answer.
    pub(super) fn feed(
        &mut self,
        observation: &Observation,
        line: &mut dyn FnMut(Stream, &str),
    ) -> Result<Answered, ReplayError> {
        let Some(session) = &mut self.session else { return Ok(Answered::Undecodable) };
        let Some(len) = observation_len(&observation.head) else {
            return Ok(Answered::Undecodable);
        };
        let mut memory = session.ipc.loan(len)?;
        if decode(observation, memory.memory(), &mut self.decoders).is_none() {
            return Ok(Answered::Undecodable);
        }
        session.ipc.publish(memory)?;
        session.wait_for_answer(observation.seq, self.answer_within, line)
    }

    /// Waits until then; the plugin hears that we live.
    pub(super) fn idle_until(&mut self, due: Instant, line: &mut dyn FnMut(Stream, &str)) {
        while Instant::now() < due {
            sleep_until(due.min(Instant::now() + HEARTBEAT));
            if let Some(session) = &mut self.session {
                session.ipc.heartbeat();
                // An end is noticed when the next image is not answered.
                session.pass_lines(line);
            }
        }
    }

    /// Ends the plugin in order.
    pub(super) fn stop(&mut self, line: &mut dyn FnMut(Stream, &str)) {
        let Some(mut session) = self.session.take() else { return };
        if session.ipc.plugin_attached() {
            let _ = session.ipc.send(&ToPlugin::Stop);
        }
        session.supervisor.end();
        session.ipc.clean_up();
        session.pass_lines(line);
    }
}

impl Session {
    fn start(command: &[OsString]) -> Result<Self, ReplayError> {
        let service = unique_service();
        let mut command = command.to_vec();
        // Confined as in flight: what it could not do there it cannot do here.
        let confinement = Confinement::prepare(&PluginLimits::default(), &command);
        let len = size_of::<ObservationHeader>();
        let ipc = RuntimeEnd::create_for(&service, len, confinement.user_id())?;
        command.push(format!("{SERVICE_OPTION}={service}").into());
        let (sender, events) = channel();
        let tell = move |event| {
            let _ = sender.send(event);
        };
        let supervisor = Supervisor::start(&command, &confinement, tell).map_err(|error| {
            let program = command.first().map(|program| program.to_string_lossy().into_owned());
            ReplayError::Start(program.unwrap_or_default(), error)
        })?;
        Ok(Self { ipc, supervisor, events, beaten: Instant::now() })
    }

    /// Greets the plugin when it has attached, and waits until it is ready.
    fn begin(
        &mut self,
        start: &ToPlugin,
        line: &mut dyn FnMut(Stream, &str),
    ) -> Result<Result<(), Failed>, ReplayError> {
        let deadline = Instant::now() + READY_WITHIN;
        while !self.ipc.plugin_attached() {
            if let Some(why) = self.pass_lines(line) {
                return Ok(Err(why));
            }
            if Instant::now() > deadline {
                return Ok(Err("the plugin did not attach within five minutes".into()));
            }
            sleep_until(Instant::now() + Duration::from_millis(2));
        }
        self.ipc.send(start)?;
        loop {
            match self.next(line)? {
                Some(Ok(FromPlugin::Ready { .. })) => return Ok(Ok(())),
                Some(Ok(FromPlugin::Failed { reason })) => return Ok(Err(reason.as_str().into())),
                Some(Err(why)) => return Ok(Err(why)),
                None if Instant::now() > deadline => {
                    return Ok(Err("`on_start` did not return within five minutes".into()));
                }
                Some(Ok(FromPlugin::Answer { .. })) | None => {}
            }
        }
    }

    /// Sends a message; waits for room if many have been sent since the last image.
    fn send(
        &mut self,
        message: &ToPlugin,
        within: Duration,
        line: &mut dyn FnMut(Stream, &str),
    ) -> Result<Result<(), Failed>, ReplayError> {
        let deadline = Instant::now() + within;
        loop {
            match self.ipc.send(message) {
                Ok(()) => return Ok(Ok(())),
                Err(IpcError::QueueFull(_)) if Instant::now() < deadline => {
                    self.ipc.heartbeat();
                    if let Some(why) = self.pass_lines(line) {
                        return Ok(Err(why));
                    }
                    sleep_until(Instant::now() + Duration::from_millis(2));
                }
                Err(IpcError::QueueFull(_)) => {
                    let seconds = within.as_secs_f64();
                    return Ok(Err(format!("the plugin has read no event for {seconds:.0} s")));
                }
                Err(error) => return Err(error.into()),
            }
        }
    }

    fn wait_for_answer(
        &mut self,
        seq: u64,
        within: Duration,
        line: &mut dyn FnMut(Stream, &str),
    ) -> Result<Answered, ReplayError> {
        let deadline = Instant::now() + within;
        loop {
            match self.next(line)? {
                Some(Ok(FromPlugin::Answer { seq: found, setpoint, .. })) if found == seq => {
                    return Ok(Answered::With(setpoint));
                }
                Some(Ok(FromPlugin::Failed { reason })) => {
                    return Ok(Answered::Failed(format!("the plugin failed: {reason}")));
                }
                Some(Err(why)) => return Ok(Answered::Failed(why)),
                None if Instant::now() > deadline => {
                    let seconds = within.as_secs_f64();
                    return Ok(Answered::Failed(format!(
                        "the plugin has not answered image {seq} for {seconds:.0} s"
                    )));
                }
                Some(Ok(_)) | None => {}
            }
        }
    }

    /// Returns the plugin's next message, or how it ended; `None` after a while.
    fn next(
        &mut self,
        line: &mut dyn FnMut(Stream, &str),
    ) -> Result<Option<Result<FromPlugin, Failed>>, ReplayError> {
        if let Some(message) = self.receive()? {
            return Ok(Some(Ok(message)));
        }
        self.ipc.wait(Duration::from_millis(50))?;
        if self.beaten.elapsed() >= HEARTBEAT {
            self.beaten = Instant::now();
            self.ipc.heartbeat();
        }
        let ended = self.pass_lines(line);
        // What it said before it ended counts.
        if let Some(message) = self.receive()? {
            return Ok(Some(Ok(message)));
        }
        Ok(ended.map(Err))
    }

    fn receive(&self) -> Result<Option<FromPlugin>, ReplayError> {
        match self.ipc.receive() {
            // A message that does not decode is the plugin's fault; the next one counts.
            Err(IpcError::Message(_)) => Ok(None),
            result => Ok(result?),
        }
    }

    /// Passes on what the plugin printed; returns how it ended, if it has.
    fn pass_lines(&mut self, line: &mut dyn FnMut(Stream, &str)) -> Option<Failed> {
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

/// Returns how much shared memory an observation with this head takes; `None` if it makes no sense.
pub fn observation_len(head: &[u8]) -> Option<usize> {
    let (header, _) = ObservationHeader::ref_from_prefix(head).ok()?;
    let len = header.total_len as usize;
    (head.len() <= len && len <= LARGEST).then_some(len)
}

/// Writes an observation as it was: the recorded head, the images decoded anew. `None` if the log
/// does not hold it whole, or it makes no sense.
#[allow(clippy::implicit_hasher)] // Why: nobody brings another one.
pub fn decode(
    observation: &Observation,
    memory: &mut [u8],
    decoders: &mut HashMap<u32, Decoder>,
) -> Option<()> {
    memory.get_mut(..observation.head.len())?.copy_from_slice(&observation.head);
    // A copy: the planes are in the same memory. It is small, and checked to be in there.
    let header = *ObservationHeader::parse(memory).ok()?;
    let planes_begin = size_of::<ObservationHeader>();
    for (index, camera) in (0..).zip(&header.cameras[..header.camera_count.into()]) {
        if camera.width_px == 0 {
            continue;
        }
        let image = observation.images.iter().find(|image| image.camera == index)?;
        let info = peek(&image.bitstream).ok()?;
        if (info.width, info.height) != (camera.width_px, camera.height_px) {
            return None;
        }
        let pixels = camera.width_px as usize * camera.height_px as usize;
        let (rgb_at, depth_at) = (camera.rgb_offset as usize, camera.depth_offset as usize);
        if rgb_at < planes_begin || depth_at < rgb_at + 3 * pixels {
            return None;
        }
        let (front, back) = memory.split_at_mut_checked(depth_at)?;
        let rgb = front.get_mut(rgb_at..rgb_at + 3 * pixels)?;
        let depth_mm = <[u16]>::mut_from_bytes(back.get_mut(..2 * pixels)?).ok()?;
        let decoder = decoders.entry(index).or_default();
        decoder.decode(&image.bitstream, rgb, depth_mm).ok()?;
    }
    Some(())
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use zerocopy::IntoBytes;

    /// An observation is decoded as it was, and not if anything of it is out of place.
    pub(crate) fn check(observation: &Observation) {
        let len = observation_len(&observation.head).unwrap();
        let mut blocks = vec![0u64; len.div_ceil(8)];
        let memory = &mut blocks.as_mut_bytes()[..len];
        assert!(decode(observation, memory, &mut HashMap::new()).is_some());
        let header = ObservationHeader::parse(memory).unwrap();
        let depth_at = header.cameras[0].depth_offset as usize;
        assert_eq!(&memory[depth_at..depth_at + 2], &1u16.to_le_bytes());
        assert_eq!(observation_len(&observation.head[..20]), None);
        let mut longer = observation.clone();
        longer.head.resize(len + 1, 0);
        assert_eq!(observation_len(&longer.head), None, "longer than the whole");
        assert!(decode(observation, &mut [0; 64], &mut HashMap::new()).is_none());
        let mut without = observation.clone();
        without.images.clear();
        assert!(decode(&without, memory, &mut HashMap::new()).is_none(), "its image is missing");
        // Wherever a byte is another, nothing panics.
        for at in 0..observation.head.len() {
            let mut other = observation.clone();
            other.head[at] ^= 0x55;
            let _ = observation_len(&other.head);
            let _ = decode(&other, memory, &mut HashMap::new());
        }
    }
}
