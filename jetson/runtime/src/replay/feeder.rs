//! Runtime side of a replay: starts the plugin, feeds it, and waits for its replies.

use std::collections::HashMap;
use std::ffi::OsString;
use std::time::{Duration, Instant};

use vizflyt_protocol::messages::{Setpoint, ToPlugin};
use vizflyt_protocol::packet::ObservationHeader;
use vizflyt_protocol::sensor::SensorHeader;
use vizflyt_rgbd::{Decoder, peek};
use zerocopy::FromBytes;

use super::{ReplayError, ReplayOptions, sleep_until};
use crate::lockstep::{PluginProcess, ProcessError};
use crate::log::Observation;
use crate::supervisor::{PluginLimits, Stream};

/// Period at which printed lines of the plugin are passed on.
const LINES_EVERY: Duration = Duration::from_millis(400);
/// Maximum size of an observation; a larger one is a faulty log. [bytes]
const LARGEST: usize = 1 << 30;

/// Outcome of feeding an image.
#[derive(Debug)]
#[allow(clippy::large_enum_variant)] // Why: only one exists at a time.
pub(super) enum FeedOutcome {
    /// The plugin replied.
    Replied(Option<Setpoint>),
    /// The observation is incomplete in the log.
    Undecodable,
    /// The plugin failed, for the reason in this sentence.
    Failed(String),
}

/// Feeds the plugin; starts a new process where the flight did.
pub(super) struct Feeder<'a> {
    command: &'a [OsString],
    limits: &'a PluginLimits,
    answer_within: Duration,
    process: Option<PluginProcess>,
    decoders: HashMap<u32, Decoder>,
    /// Called with each line that the plugin prints.
    line: &'a mut dyn FnMut(Stream, &str),
}

/// Failure of a plugin, as a sentence.
type Failed = String;

impl<'a> Feeder<'a> {
    pub(super) fn new(options: &'a ReplayOptions, line: &'a mut dyn FnMut(Stream, &str)) -> Self {
        let ReplayOptions { command, limits, answer_within, .. } = options;
        let answer_within = *answer_within;
        Self { command, limits, answer_within, process: None, decoders: HashMap::new(), line }
    }

    /// Sends a message. A start message ends the present process and starts a new one.
    pub(super) fn send(&mut self, message: &ToPlugin) -> Result<Result<(), Failed>, ReplayError> {
        match message {
            ToPlugin::Start(_) => {
                self.stop();
                let process = PluginProcess::start(self.command, self.limits, self.answer_within)?;
                split_failure(self.process.insert(process).begin(message, self.line))
            }
            // The replay sends its own stop at the end of the log.
            ToPlugin::Stop => Ok(Ok(())),
            ToPlugin::Event(_) => match &mut self.process {
                Some(process) => split_failure(process.send(message, self.line)),
                None => Ok(Ok(())),
            },
        }
    }

    /// Publishes an observation and waits for the reply.
    pub(super) fn feed(&mut self, observation: &Observation) -> Result<FeedOutcome, ReplayError> {
        let Some(process) = &mut self.process else { return Ok(FeedOutcome::Undecodable) };
        let Some(len) = observation_len(&observation.head) else {
            return Ok(FeedOutcome::Undecodable);
        };
        let mut memory = process.loan(len)?;
        if decode(observation, memory.memory(), &mut self.decoders).is_none() {
            return Ok(FeedOutcome::Undecodable);
        }
        let answer = split_failure(process.ask(observation.seq, memory, self.line))?;
        Ok(answer.map_or_else(FeedOutcome::Failed, FeedOutcome::Replied))
    }

    /// Waits until `due`, and passes on printed lines of the plugin.
    pub(super) fn idle_until(&mut self, due: Instant) {
        while Instant::now() < due {
            sleep_until(due.min(Instant::now() + LINES_EVERY));
            if let Some(process) = &mut self.process {
                process.pass_lines(self.line);
            }
        }
    }

    /// Stops the plugin and passes on its last lines.
    pub(super) fn stop(&mut self) {
        if let Some(process) = self.process.take() {
            process.stop(self.line);
        }
    }
}

/// Separates a plugin's failure, which goes into the report, from errors that end the replay.
fn split_failure<T>(result: Result<T, ProcessError>) -> Result<Result<T, Failed>, ReplayError> {
    match result {
        Ok(value) => Ok(Ok(value)),
        Err(ProcessError::Failed(fault)) => Ok(Err(fault.to_string())),
        Err(error) => Err(error.into()),
    }
}

/// Returns the size of an observation in shared memory; `None` if its head is invalid. [bytes]
pub fn observation_len(head: &[u8]) -> Option<usize> {
    let (header, _) = ObservationHeader::ref_from_prefix(head).ok()?;
    let len = header.total_len as usize;
    (head.len() <= len && len <= LARGEST).then_some(len)
}

/// Restores an observation: writes the recorded head and the sensors' readings, and decodes the images. `None` if the
/// observation is incomplete or invalid.
#[allow(clippy::implicit_hasher)] // Why: all callers use the default one.
pub fn decode(
    observation: &Observation,
    memory: &mut [u8],
    decoders: &mut HashMap<u32, Decoder>,
) -> Option<()> {
    memory.get_mut(..observation.head.len())?.copy_from_slice(&observation.head);
    write_sensors(observation, memory)?;
    // A copy, because the planes are in the same memory.
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

/// Writes the table of sensors and their records to the offsets in the head and the table.
fn write_sensors(observation: &Observation, memory: &mut [u8]) -> Option<()> {
    let (header, _) = ObservationHeader::ref_from_prefix(memory).ok()?;
    let (at, count) = (header.sensors_offset as usize, header.sensor_count as usize);
    if count == 0 {
        return Some(());
    }
    let behind_the_head = at >= size_of::<ObservationHeader>();
    let table = observation.sensors.as_slice();
    memory.get_mut(at..)?.get_mut(..table.len())?.copy_from_slice(table);
    for records in &observation.records {
        let (stride, index) = (size_of::<SensorHeader>(), records.sensor as usize);
        let head = table.get(index.checked_mul(stride)?..)?.get(..stride)?;
        let sensor = SensorHeader::read_from_bytes(head).ok()?;
        let (from, len) = (sensor.records_offset as usize, records.bytes.len());
        let kind = sensor.kind()?;
        let is_whole = len == (sensor.record_count as usize).checked_mul(kind.record_len())?;
        let is_behind = from >= at.checked_add(table.len())?;
        let room = memory.get_mut(from..from.checked_add(len)?)?;
        if !(is_whole && is_behind && behind_the_head) {
            return None;
        }
        room.copy_from_slice(&records.bytes);
    }
    Some(())
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use zerocopy::IntoBytes;

    /// Checks that an observation is restored, and rejected if a part is missing or invalid.
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
        assert_eq!(observation_len(&longer.head), None, "head longer than the observation");
        assert!(decode(observation, &mut [0; 64], &mut HashMap::new()).is_none());
        let mut without = observation.clone();
        without.images.clear();
        assert!(decode(&without, memory, &mut HashMap::new()).is_none(), "its image is missing");
        // Any changed byte is handled without a panic.
        for at in 0..observation.head.len() {
            let mut other = observation.clone();
            other.head[at] ^= 0x55;
            let _ = observation_len(&other.head);
            let _ = decode(&other, memory, &mut HashMap::new());
        }
    }
}
