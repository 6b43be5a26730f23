//! Reads flight logs: record by record, in bounded memory, also from invalid files.
//!
//! A log of a killed runtime ends early, and a damaged log is read up to the damage. [`LogReader::is_cut`]
//! reports both; they are not errors.

use std::collections::HashMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;
use std::sync::Arc;

use foxglove::messages::{CompressedImage, PoseInFrame};
use glam::{DQuat, DVec3};
use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use prost::Message as _;
use vizflyt_protocol::PROTOCOL_VERSION;
use vizflyt_protocol::geometry::{Body, Pose, World};
use vizflyt_protocol::messages::{Event, Timing, ToPlugin};
use vizflyt_protocol::packet::framing::decode_body;
use vizflyt_protocol::time::ServerTime;
use vizflyt_rgbd::{DecodeError, join_jpeg};

use super::channels::Channel;
use super::messages::{Observation, ObservedImage, PluginMessage};
use super::sensors::points_of;
use super::writer::FLIGHT;

/// Maximum length of a record; images of the largest size are smaller. [bytes]
const LONGEST_RECORD: usize = 256 << 20;
/// Maximum size of one read, regardless of the announced length of a record. [bytes]
const READ_AT_ONCE: usize = 1 << 20;

/// Error of opening or reading a log.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The file cannot be opened or read.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The file does not begin as an MCAP file.
    #[error("this is not an MCAP file: {0}; give a flight log, such as flights/DATE.mcap")]
    Foreign(mcap::McapError),
}

/// One message of a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LogMessage {
    /// Topic of the channel, for example `/pose`.
    pub topic: Arc<str>,
    /// Time since 1970. [ns]
    pub log_time_ns: u64,
    /// Payload in the channel's encoding.
    pub data: Vec<u8>,
}

/// Entry of a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Entry {
    Message(LogMessage),
    /// Names and values that identify the flight.
    Flight(std::collections::BTreeMap<String, String>),
}

/// Reads a log from its start to its end.
pub struct LogReader<R> {
    source: R,
    reader: LinearReader,
    topics: HashMap<u16, Arc<str>>,
    /// Present chunk.
    chunk: Vec<u8>,
    /// Position in `chunk`.
    at: usize,
    is_cut: bool,
    is_over: bool,
}

impl LogReader<BufReader<File>> {
    /// Opens a log.
    ///
    /// # Errors
    /// If the file cannot be opened, or is not an MCAP file.
    pub fn open(path: &Path) -> Result<Self, LogError> {
        Self::new(BufReader::new(File::open(path)?))
    }
}

impl<R: Read> LogReader<R> {
    /// Reads the header of a log from `source`.
    ///
    /// # Errors
    /// If `source` cannot be read, or is not an MCAP file.
    pub fn new(source: R) -> Result<Self, LogError> {
        // A killed runtime may leave a file without an end.
        let options = LinearReaderOptions::default()
            .with_skip_end_magic(true)
            // Chunks are parsed in this module: the library trusts the announced lengths of a chunk's records.
            .with_emit_chunks(true)
            .with_record_length_limit(LONGEST_RECORD);
        let reader = LinearReader::new_with_options(options);
        let mut log = Self {
            source,
            reader,
            topics: HashMap::new(),
            chunk: Vec::new(),
            at: 0,
            is_cut: false,
            is_over: false,
        };
        // An MCAP file begins with a header.
        match log.step() {
            Ok(_) => Ok(log),
            Err(Stop::Io(error)) => Err(LogError::Io(error)),
            Err(Stop::End) => Err(LogError::Foreign(mcap::McapError::UnexpectedEof)),
            Err(Stop::Damaged(error)) => Err(LogError::Foreign(error)),
        }
    }

    /// Whether the log is truncated or damaged; valid after [`Self::next`] has returned `None`.
    pub fn is_cut(&self) -> bool {
        self.is_cut
    }

    /// Returns the next message or metadata; `None` at the end, or at the first damage.
    ///
    /// # Errors
    /// If the file cannot be read.
    #[allow(clippy::should_implement_trait)] // Why: `Result<Option>` ends at an error.
    pub fn next(&mut self) -> Result<Option<Entry>, LogError> {
        while !self.is_over {
            match self.step() {
                Ok(Some(entry)) => return Ok(Some(entry)),
                Ok(None) => {}
                Err(Stop::End) => self.is_over = true,
                Err(Stop::Damaged(error)) => {
                    tracing::debug!("log: {error}");
                    (self.is_over, self.is_cut) = (true, true);
                }
                Err(Stop::Io(error)) => {
                    self.is_over = true;
                    return Err(error.into());
                }
            }
        }
        Ok(None)
    }

    /// Reads one record; `None` if it is not an entry.
    fn step(&mut self) -> Result<Option<Entry>, Stop> {
        if self.at < self.chunk.len() {
            let (record, rest) = split_record(&self.chunk[self.at..])?;
            self.at = self.chunk.len() - rest;
            return Ok(record.and_then(|record| take(&mut self.topics, record)));
        }
        loop {
            match self.reader.next_event() {
                None => return Err(Stop::End),
                Some(Err(error)) => return Err(Stop::Damaged(error)),
                Some(Ok(LinearReadEvent::ReadRequest(wanted))) => {
                    let room = self.reader.insert(wanted.clamp(1, READ_AT_ONCE));
                    let read = loop {
                        match self.source.read(room) {
                            Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
                            result => break result.map_err(Stop::Io)?,
                        }
                    };
                    self.reader.notify_read(read);
                }
                Some(Ok(LinearReadEvent::Record { data, opcode })) => {
                    let (header, data) = match parse(opcode, data)? {
                        Some(Record::Chunk { header, data }) => (header, data),
                        record => {
                            return Ok(record.and_then(|record| take(&mut self.topics, record)));
                        }
                    };
                    if !header.compression.is_empty() {
                        let error = mcap::McapError::UnsupportedCompression(header.compression);
                        return Err(Stop::Damaged(error));
                    }
                    self.chunk.clear();
                    self.chunk.extend_from_slice(&data);
                    self.at = 0;
                    return Ok(None);
                }
            }
        }
    }
}

/// Reason for which no next record is available.
enum Stop {
    End,
    Damaged(mcap::McapError),
    Io(std::io::Error),
}

/// Returns the first record of a chunk's bytes, if its kind is used, and the number of bytes after it.
fn split_record(bytes: &[u8]) -> Result<(Option<Record<'_>>, usize), Stop> {
    let cut = || Stop::Damaged(mcap::McapError::UnexpectedEoc);
    let (head, rest) = bytes.split_first_chunk::<9>().ok_or_else(cut)?;
    let [opcode, length @ ..] = *head;
    let length = usize::try_from(u64::from_le_bytes(length)).map_err(|_| cut())?;
    let (data, behind) = rest.split_at_checked(length).ok_or_else(cut)?;
    Ok((parse(opcode, data)?, behind.len()))
}

/// Parses a record; `None` if its kind is not used.
///
/// The library allocates the announced length of a string before it checks that the bytes exist, so this function
/// checks the lengths first.
fn parse(opcode: u8, data: &[u8]) -> Result<Option<Record<'_>>, Stop> {
    let fits = match opcode {
        op::HEADER => skip_texts(data, 2).is_some(),
        op::CHANNEL => data.get(4..).and_then(|data| skip_texts(data, 2)).is_some_and(is_map),
        op::CHUNK => data.get(28..).and_then(|data| skip_texts(data, 1)).is_some(),
        op::METADATA => skip_texts(data, 1).is_some_and(is_map),
        op::MESSAGE => true,
        _ => return Ok(None),
    };
    if !fits {
        return Err(Stop::Damaged(mcap::McapError::UnexpectedEoc));
    }
    mcap::parse_record(opcode, data).map(Some).map_err(Stop::Damaged)
}

/// Returns the bytes after the first `texts` strings; `None` if one is incomplete.
fn skip_texts(mut data: &[u8], texts: usize) -> Option<&[u8]> {
    for _ in 0..texts {
        let (len, rest) = data.split_first_chunk::<4>()?;
        data = rest.get(usize::try_from(u32::from_le_bytes(*len)).ok()?..)?;
    }
    Some(data)
}

/// Whether `data` begins with a complete map of strings.
fn is_map(data: &[u8]) -> bool {
    let Some((len, rest)) = data.split_first_chunk::<4>() else { return false };
    let len = usize::try_from(u32::from_le_bytes(*len)).ok();
    let Some(mut pairs) = len.and_then(|len| rest.get(..len)) else { return false };
    while !pairs.is_empty() {
        match skip_texts(pairs, 2) {
            Some(rest) => pairs = rest,
            None => return false,
        }
    }
    true
}

fn take(topics: &mut HashMap<u16, Arc<str>>, record: Record<'_>) -> Option<Entry> {
    match record {
        Record::Channel(channel) => {
            topics.insert(channel.id, channel.topic.into());
            None
        }
        Record::Message { header, data } => {
            let topic = Arc::clone(topics.get(&header.channel_id)?);
            let data = data.into_owned();
            Some(Entry::Message(LogMessage { topic, log_time_ns: header.log_time, data }))
        }
        Record::Metadata(metadata) if metadata.name == FLIGHT => {
            Some(Entry::Flight(metadata.metadata))
        }
        _ => None,
    }
}

/// Reads the timing of a flight from its log: of the complete flight, or, if the runtime was killed, of
/// the last seconds. `None` if the log has none.
///
/// # Errors
/// If the file cannot be read or is not an MCAP file.
pub fn read_timing(path: &Path) -> Result<Option<Timing>, LogError> {
    let mut reader = LogReader::open(path)?;
    let topic = Channel::Timing.topic("");
    let mut found: Option<Timing> = None;
    while let Some(entry) = reader.next()? {
        if let Entry::Message(message) = entry
            && *message.topic == *topic
            && let Ok(timing) = serde_json::from_slice::<Timing>(&message.data)
            && found.as_ref().is_none_or(|best| timing.seconds >= best.seconds)
        {
            found = Some(timing);
        }
    }
    Ok(found)
}

/// One localized pose of a flight.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RecordedPose {
    /// Instant of the pose, since 1970. [ns]
    pub at_ns: u64,
    pub world_from_body: Pose<World, Body>,
}

/// Reads the localized poses of a flight, in the order in which they were written.
pub struct RecordedPoses<R> {
    reader: LogReader<R>,
    topic: String,
}

impl<R: Read> RecordedPoses<R> {
    pub fn new(reader: LogReader<R>) -> Self {
        Self::of_topic(reader, Channel::Pose.topic(""))
    }

    /// Reads the poses of another topic of foxglove.PoseInFrame.
    pub fn of_topic(reader: LogReader<R>, topic: impl Into<String>) -> Self {
        Self { reader, topic: topic.into() }
    }

    /// Returns the next pose; `None` at the end. Skips invalid messages.
    ///
    /// # Errors
    /// If the file cannot be read.
    #[allow(clippy::should_implement_trait)] // Why: `Result<Option>` ends at an error.
    pub fn next(&mut self) -> Result<Option<RecordedPose>, LogError> {
        while let Some(entry) = self.reader.next()? {
            let Entry::Message(message) = entry else { continue };
            if *message.topic != *self.topic {
                continue;
            }
            if let Some((at_ns, world_from_body)) = pose_of(&message) {
                return Ok(Some(RecordedPose { at_ns, world_from_body }));
            }
        }
        Ok(None)
    }
}

/// Poses and events of a flight, by which it is judged.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RecordedTrack {
    /// Localized poses in the order of arrival.
    pub poses: Vec<(ServerTime, Pose<World, Body>)>,
    /// Events as sent to the plugin; without positions if the course withholds them.
    pub events: Vec<Event>,
}

impl RecordedTrack {
    /// Reads a track from a log. Poses have stamps of the runtime's clock, events also of the server's: the smallest
    /// difference of an event's two stamps is used as the clock offset.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn read<R: Read>(mut reader: LogReader<R>) -> Result<Self, LogError> {
        let (of_poses, of_plugin) = (Channel::Pose.topic(""), Channel::Plugin.topic(""));
        let (mut poses, mut events) = (Vec::new(), Vec::new());
        let mut ahead_ns = i64::MAX;
        while let Some(entry) = reader.next()? {
            let Entry::Message(message) = entry else { continue };
            if *message.topic == *of_poses {
                poses.extend(pose_of(&message));
            } else if *message.topic == *of_plugin
                && let Ok(plugin) = PluginMessage::decode(&*message.data)
                && plugin.is_to_plugin
                && plugin.protocol == u32::from(PROTOCOL_VERSION)
                && let Ok(ToPlugin::Event(event)) = decode_body(&plugin.body)
            {
                let event_ns = event.stamp.as_ns();
                ahead_ns = ahead_ns.min(message.log_time_ns.wrapping_sub(event_ns).cast_signed());
                events.push(event);
            }
        }
        let stamp = |at_ns: u64| ServerTime::from_ns(at_ns.saturating_add_signed(-ahead_ns));
        poses.retain(|_| !events.is_empty());
        let poses = poses.into_iter().map(|(at_ns, pose)| (stamp(at_ns), pose)).collect();
        Ok(Self { poses, events })
    }
}

/// Returns the pose of a foxglove.PoseInFrame message, and its instant. [ns, since 1970]
pub(super) fn pose_of(message: &LogMessage) -> Option<(u64, Pose<World, Body>)> {
    let logged = PoseInFrame::decode(&*message.data).ok()?;
    let stamp = logged.timestamp.as_ref();
    let at_ns = stamp.map_or(message.log_time_ns, |at| {
        u64::from(at.sec()) * 1_000_000_000 + u64::from(at.nsec())
    });
    let (p, q) = logged.pose.and_then(|pose| pose.position.zip(pose.orientation))?;
    let rotation = DQuat::from_xyzw(q.x, q.y, q.z, q.w);
    let pose = Some(Pose::new(DVec3::new(p.x, p.y, p.z), rotation)).filter(Pose::is_valid)?;
    Some((at_ns, pose))
}

/// Entry of a log for replay.
#[derive(Clone, Debug, PartialEq)]
pub enum Recorded {
    /// Names and values that identify the flight.
    Flight(std::collections::BTreeMap<String, String>),
    /// A message to or from the plugin.
    Plugin(PluginMessage),
    /// An observation of the plugin, with complete bitstreams.
    Observation(Observation),
    /// Number of an observation that is incomplete in the log.
    Broken(u64),
}

/// Next entry of a log.
pub(super) enum Next {
    /// An entry for replay.
    Recorded(Recorded),
    /// Another message, except colour images.
    Other(LogMessage),
}

/// Reads the entries of a log that a replay uses.
pub struct RecordedFlight<R> {
    reader: LogReader<R>,
    topics: [String; 2],
    /// Newest colour message of each camera, by topic.
    colors: HashMap<Arc<str>, (u64, Vec<u8>)>,
    /// Newest message of each sensor, by topic.
    points: HashMap<Arc<str>, Vec<u8>>,
    with_images: bool,
}

impl<R: Read> RecordedFlight<R> {
    /// Reads from `reader`; without images, the bitstreams of observations are empty.
    pub fn new(reader: LogReader<R>, with_images: bool) -> Self {
        let topics = [Channel::Observation, Channel::Plugin].map(|channel| channel.topic(""));
        let (colors, points) = (HashMap::new(), HashMap::new());
        Self { reader, topics, colors, points, with_images }
    }

    /// Whether the log is truncated or damaged.
    pub fn is_cut(&self) -> bool {
        self.reader.is_cut()
    }

    /// Returns the next entry; `None` at the end.
    ///
    /// # Errors
    /// If the file cannot be read.
    #[allow(clippy::should_implement_trait)] // Why: `Result<Option>` ends at an error.
    pub fn next(&mut self) -> Result<Option<Recorded>, LogError> {
        while let Some((_, next)) = self.next_of_all()? {
            if let Next::Recorded(recorded) = next {
                return Ok(Some(recorded));
            }
        }
        Ok(None)
    }

    /// Returns the log time and the next entry, for replay or other; `None` at the end. [ns, since 1970]
    pub(super) fn next_of_all(&mut self) -> Result<Option<(u64, Next)>, LogError> {
        while let Some(entry) = self.reader.next()? {
            let message = match entry {
                Entry::Flight(values) => {
                    return Ok(Some((0, Next::Recorded(Recorded::Flight(values)))));
                }
                Entry::Message(message) => message,
            };
            let at_ns = message.log_time_ns;
            let [observation, plugin] = &self.topics;
            if *message.topic == **observation {
                return Ok(Some((at_ns, Next::Recorded(self.observation(&message)))));
            } else if *message.topic == **plugin {
                if let Ok(decoded) = PluginMessage::decode(&*message.data) {
                    return Ok(Some((at_ns, Next::Recorded(Recorded::Plugin(decoded)))));
                }
            } else if is_color(&message.topic) {
                if self.with_images {
                    self.colors.insert(message.topic, (at_ns, message.data));
                }
            } else {
                if self.with_images && message.topic.starts_with("/sensor/") {
                    self.points.insert(Arc::clone(&message.topic), message.data.clone());
                }
                return Ok(Some((at_ns, Next::Other(message))));
            }
        }
        Ok(None)
    }

    fn observation(&mut self, message: &LogMessage) -> Recorded {
        let Ok(mut observation) = Observation::decode(&*message.data) else {
            return Recorded::Broken(0);
        };
        for image in &mut observation.images {
            if !self.with_images {
                image.bitstream = Vec::new();
            } else if image.is_color_apart
                && self.join(message.log_time_ns, image).is_none_or(|joined| joined.is_err())
            {
                return Recorded::Broken(observation.seq);
            }
        }
        for records in observation.records.iter_mut().filter(|one| one.is_apart) {
            if !self.with_images {
                continue;
            }
            let topic = Channel::Points(0).topic(&records.name);
            let points = self.points.get(&*topic).and_then(|message| points_of(message));
            // A reduced log that omits the images also omits the points.
            let is_left_out = observation.images.is_empty();
            match points {
                Some(points) => (records.bytes, records.is_apart) = (points, false),
                None if is_left_out => {}
                None => return Recorded::Broken(observation.seq),
            }
        }
        Recorded::Observation(observation)
    }

    /// Joins an image's colour with its bitstream; `None` if the log does not contain the colour.
    fn join(&self, at_ns: u64, image: &mut ObservedImage) -> Option<Result<(), DecodeError>> {
        let topic = Channel::Color(0).topic(&image.name);
        let (color_at_ns, color) = self.colors.get(&*topic)?;
        if *color_at_ns != at_ns {
            return None;
        }
        let color = CompressedImage::decode(&**color).ok()?;
        let mut whole = Vec::with_capacity(color.data.len() + image.bitstream.len());
        let joined = join_jpeg(&color.data, &image.bitstream, &mut whole);
        (image.bitstream, image.is_color_apart) = (whole, false);
        Some(joined)
    }
}

fn is_color(topic: &str) -> bool {
    topic.starts_with("/camera/") && topic.ends_with("/image")
}
