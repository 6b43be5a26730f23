//! Flight log: one MCAP file with Foxglove's schemas, and the same channels live over WebSocket
//! (`--foxglove`). See `docs/guides/logs.md`.
//!
//! ```text
//! control loop ── poses, setpoints, events, messages ─┐          ┌─▶ SafeFile ─▶ flights/*.mcap
//! image thread ── pieces of each image, as received ──┴─▶ Queue ─┤     (chunk a second)
//!                  (their buffers are reused)            bounded └─▶ Live ─▶ viewers
//! ```
//! The flight never waits for the log: records that do not fit are dropped, counted and reported. If the
//! process is killed, the file is complete, except during the single write of a chunk ([`file`]). Images are
//! written as received: the log neither decodes nor encodes them. A reduced log omits some images
//! ([`budget`]), but keeps the rest of each observation. When a flight begins, the oldest logs are deleted
//! ([`retention`]). [`read`] reads logs, and [`crate::replay`] replays them.

mod budget;
mod channels;
mod convert;
pub mod data;
mod depth;
mod file;
#[cfg(feature = "foxglove")]
mod live;
#[cfg(not(feature = "foxglove"))]
#[path = "live_absent.rs"]
mod live;
mod messages;
mod queue;
pub mod read;
mod retention;
mod sensors;
#[cfg(test)]
mod tests;
mod virtual_log;
mod writer;

use std::ffi::OsString;
use std::fs::{File, create_dir_all};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::{self, JoinHandle};
use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};
use serde_json::json;
use vizflyt_protocol::PROTOCOL_VERSION;
use vizflyt_protocol::flight_end::EndReason;
use vizflyt_protocol::mavlink::{GuidedMotion, GuidedSetpoint};
use vizflyt_protocol::messages::{
    Event, EventKind, FromPlugin, Odometry, PoseSample, ToPlugin, YawTarget,
};
use vizflyt_protocol::packet::ObservationHeader;
use vizflyt_protocol::packet::framing::{MAX_FRAMED, encode_body};
use vizflyt_protocol::time::{Civil, HostTime};
use vizflyt_sdk::ImuSample;

use self::budget::Budget;
pub use self::channels::Channel;
use self::file::RealFile;
pub use self::file::keep_going_when_files_are_full;
pub use self::live::Live;
pub use self::messages::{Observation, ObservedImage, ObservedRecords, PluginMessage};
pub use self::queue::{Dropped, LoggedImage};
use self::queue::{ObservationRecord, Queue, Record};
pub use self::read::read_timing;
pub use self::retention::Retention;
pub use self::sensors::{LoggedReading, LoggedSensors};
pub use self::virtual_log::{GivenImage, VirtualLog};
use self::writer::{LogSinks, LogWriter};
use crate::stream::Mailbox;

/// Severity of a line, with the values of foxglove.Log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// Normal operation.
    Info = 2,
    /// Needs attention.
    Warning = 3,
    /// Ended the flight, or should have ended it.
    Error = 4,
}

/// Images that a log keeps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum LoggedImages {
    /// Evenly spaced images, unchanged, up to a log size of 60 MB a minute.
    #[default]
    Reduced,
    /// All images, so that a replay is bit-exact.
    Full,
}

/// Settings of the flight log.
#[derive(Clone, Debug)]
pub struct LogSettings {
    /// Folder of the logs; without one, only live viewers receive the log.
    pub folder: Option<PathBuf>,
    /// Images to keep.
    pub images: LoggedImages,
    /// Whether depth is also written in a format for viewers.
    pub depth: bool,
    /// Maximum size and age of logs.
    pub retention: Retention,
}

impl LogSettings {
    /// Returns settings that keep every image and every log in `folder`.
    pub fn full(folder: impl Into<PathBuf>) -> Self {
        let (images, retention) = (LoggedImages::Full, Retention::FOREVER);
        Self { folder: Some(folder.into()), images, depth: false, retention }
    }
}

/// Creates the folder and the file of a log. Returns the file twice: for reading the free disk space, and for writing.
fn open_file(folder: &Path, path: &Path) -> io::Result<(File, RealFile)> {
    create_dir_all(folder)?;
    let file = File::create(path)?;
    // The lock protects the file from deletion. Without locks, its age does, as it is the newest log.
    let _ = file.try_lock();
    Ok((file.try_clone()?, RealFile::new(file)?))
}

/// Log of one flight. Calls do not block the control loop; dropping it closes the file.
#[derive(Debug)]
pub struct FlightLog {
    queue: Option<Arc<Queue>>,
    writer: Option<JoinHandle<()>>,
    path: Option<PathBuf>,
}

impl FlightLog {
    /// Opens a log, named by date and time (UTC), also for `live`'s viewers, and deletes logs beyond the
    /// retention. If the file cannot be written, prints a warning and writes nothing.
    pub fn open(settings: &LogSettings, live: Option<Live>) -> Self {
        let LogSettings { folder, images, depth, retention } = settings;
        let now = SystemTime::now();
        let file = folder.as_deref().and_then(|folder| {
            let path = folder.join(format!("{}.mcap", utc_name(now)));
            let warn =
                |error: &io::Error| tracing::warn!("no flight log: {}: {error}", path.display());
            let (probe, file) = open_file(folder, &path).inspect_err(warn).ok()?;
            Some((path, probe, file))
        });
        let none = Self { queue: None, writer: None, path: None };
        if file.is_none() && live.is_none() {
            return none;
        }
        let (path, probe, disk) = match file {
            Some((path, probe, disk)) => (Some(path), Some(probe), Some(disk)),
            None => (None, None, None),
        };
        match Self::start(disk, probe, live, *images, *depth) {
            Ok((queue, writer)) => {
                // A folder that cannot be listed is not an error here.
                let deleted =
                    folder.as_deref().map(|folder| retention::delete_old(folder, *retention, now));
                let deleted = deleted.and_then(Result::ok).unwrap_or_default();
                deleted.sentence(*retention).into_iter().for_each(|text| queue.complain(text));
                Self { queue: Some(queue), writer: Some(writer), path }
            }
            Err(error) => {
                tracing::warn!("no flight log: {error}");
                none
            }
        }
    }

    fn start(
        disk: Option<RealFile>,
        probe: Option<File>,
        live: Option<Live>,
        images: LoggedImages,
        depth: bool,
    ) -> mcap::McapResult<(Arc<Queue>, JoinHandle<()>)> {
        let budget = (images == LoggedImages::Reduced).then(Budget::default);
        let sinks = LogSinks::new(disk, live, budget)?;
        let (queue, records) = Queue::new();
        let free_bytes = move || probe.as_ref().and_then(file::free_bytes);
        let mut writer = LogWriter::new(sinks, Arc::clone(&queue), Box::new(free_bytes));
        if depth {
            writer.show_depth();
        }
        let handle =
            thread::Builder::new().name("flight-log".into()).spawn(move || writer.run(&records))?;
        Ok((queue, handle))
    }

    /// Returns the path of the file, if one is written.
    pub fn path(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// Returns the counts of records dropped because of a slow disk.
    pub fn dropped(&self) -> Dropped {
        self.queue.as_ref().map_or_else(Dropped::default, |queue| queue.dropped())
    }

    /// Returns the newest problem of the log as a sentence, once.
    pub fn poll_trouble(&self) -> Option<String> {
        self.queue.as_ref()?.poll_trouble()
    }

    /// Logs `message` on a JSON channel with the time `at`.
    pub fn write(&self, channel: Channel, at: HostTime, message: &impl Serialize) {
        let Some(queue) = &self.queue else { return };
        let Ok(json) = serde_json::to_vec(message) else { return };
        queue.push(Record::Json { channel, at, json });
    }

    /// Logs the identity of the flight: program, plugin and arguments.
    pub fn flight(&self, plugin: &OsString, arguments: &[OsString]) {
        let Some(queue) = &self.queue else { return };
        queue.push(flight_record(plugin, arguments));
    }

    /// Logs a pose of the instant `stamp` that arrived at `at`.
    pub fn pose(&self, at: HostTime, stamp: HostTime, sample: &PoseSample) {
        let Some(queue) = &self.queue else { return };
        queue.push(Record::Pose { at, stamp, sample: *sample });
    }

    /// Logs an odometry estimate of the plugin that arrived at `at`.
    pub fn odometry(&self, at: HostTime, odometry: &Odometry) {
        let Some(queue) = &self.queue else { return };
        queue.push(Record::Odometry { at, odometry: *odometry });
    }

    pub fn imu(&self, sample: &ImuSample) {
        self.write(Channel::Imu, sample.stamp, &imu_message(sample));
    }

    pub fn event(&self, at: HostTime, event: &Event) {
        let Some(queue) = &self.queue else { return };
        queue.push(event_record(at, event));
    }

    /// Logs a line that the plugin printed on `stream` (`stdout` or `stderr`) while it processed the
    /// image of the server's `tick`.
    pub fn line(&self, at: HostTime, stream: &str, line: &str, tick: u64) {
        let Some(queue) = &self.queue else { return };
        queue.push(line_record(at, stream, line, tick));
    }

    /// Logs a message to the plugin, sent at `at`; a replay sends it again.
    pub fn to_plugin(&self, at: HostTime, message: &ToPlugin) {
        self.message(at, true, message);
    }

    /// Logs a message of the plugin; a replay compares its replies with it.
    pub fn from_plugin(&self, at: HostTime, message: &FromPlugin) {
        self.message(at, false, message);
    }

    fn message(&self, at: HostTime, is_to_plugin: bool, message: &impl Serialize) {
        let Some(queue) = &self.queue else { return };
        queue.push(plugin_record(at, is_to_plugin, message));
    }

    /// Returns the image thread's handle of the log; buffers of images return to `home`.
    pub fn images(&self, home: &Arc<Mailbox>) -> Option<ImageLog> {
        let queue = Arc::clone(self.queue.as_ref()?);
        Some(ImageLog { queue, home: Arc::clone(home) })
    }
}

impl Drop for FlightLog {
    fn drop(&mut self) {
        let Some(queue) = self.queue.take() else { return };
        queue.end();
        if let Some(writer) = self.writer.take() {
            let _ = writer.join();
        }
        let Dropped { images, records } = queue.dropped();
        if images + records > 0 {
            tracing::warn!(
                "flight log: {images} images and {records} records are missing: the disk is too slow"
            );
        }
    }
}

/// The image thread's handle of the log. Logging copies the head of the observation, and never waits.
#[derive(Clone, Debug)]
pub struct ImageLog {
    queue: Arc<Queue>,
    home: Arc<Mailbox>,
}

impl ImageLog {
    /// Logs an observation: shared memory up to the first plane, images as received, and sensor readings.
    pub fn observation(
        &self,
        at: HostTime,
        seq: u64,
        head: Vec<u8>,
        images: Vec<LoggedImage>,
        sensors: LoggedSensors,
    ) {
        let home = Arc::clone(&self.home);
        let record = ObservationRecord { at, seq, head, images, sensors, home };
        self.queue.push(Record::Observation(Box::new(record)));
    }
}

/// Returns the logged JSON of an IMU reading.
fn imu_message(sample: &ImuSample) -> serde_json::Value {
    json!({
        "stamp_ns": sample.stamp.as_ns(),
        "accel_mps2": sample.accel_mps2.to_array(),
        "gyro_radps": sample.gyro_radps.to_array()
    })
}

/// Returns the record of the flight's identity.
fn flight_record(plugin: &OsString, arguments: &[OsString]) -> Record {
    let arguments: Vec<_> = arguments.iter().map(|text| text.to_string_lossy()).collect();
    Record::Flight(vec![
        ("program", concat!("vizflyt ", env!("CARGO_PKG_VERSION")).to_owned()),
        ("protocol", PROTOCOL_VERSION.to_string()),
        ("plugin", plugin.to_string_lossy().into_owned()),
        ("arguments", json!(arguments).to_string()),
    ])
}

fn event_record(at: HostTime, event: &Event) -> Record {
    let (name, level) = match &event.kind {
        EventKind::Collision(_) => ("collision", Level::Error),
        EventKind::Geofence(_) => ("geofence", Level::Error),
        EventKind::EmergencyStop => ("stop button", Level::Error),
        EventKind::Ended(EndReason::Plugin(_)) => ("plugin", Level::Error),
        EventKind::Ended(reason) if reason.is_failure() => ("end", Level::Error),
        EventKind::Ended(_) => ("end", Level::Info),
        EventKind::PoseLost { .. } => ("pose", Level::Warning),
        EventKind::PoseRegained => ("pose", Level::Info),
        EventKind::Stage { .. } | EventKind::Finished { .. } => ("course", Level::Info),
        EventKind::TimeLimit { .. } => ("course", Level::Warning),
        EventKind::Phase(_) => ("phase", Level::Info),
        EventKind::Start => ("start button", Level::Info),
        EventKind::Land => ("land button", Level::Warning),
        EventKind::PluginOutput => ("plugin", Level::Info),
        EventKind::Note => ("note", Level::Warning),
    };
    let (name, text) = (name.to_owned(), event.text.as_str().to_owned());
    Record::Text { channel: Channel::Event, at, level, name, text }
}

fn line_record(at: HostTime, stream: &str, line: &str, tick: u64) -> Record {
    let level = if stream == "stderr" { Level::Warning } else { Level::Info };
    let (name, text) = (format!("{stream} at tick {tick}"), line.to_owned());
    Record::Text { channel: Channel::PluginOutput, at, level, name, text }
}

fn plugin_record(at: HostTime, is_to_plugin: bool, message: &impl Serialize) -> Record {
    let mut buffer = [0; MAX_FRAMED];
    let body = encode_body(message, &mut buffer).to_vec();
    Record::Plugin { at, is_to_plugin, body }
}

/// Returns the logged JSON of a setpoint accepted by the guard; `None` if it is not a velocity.
pub(crate) fn sent_message(setpoint: &GuidedSetpoint) -> Option<serde_json::Value> {
    let GuidedMotion::Velocity(v_mps) = setpoint.motion else { return None };
    let (yaw_rad, yaw_rate_radps) = match setpoint.yaw {
        YawTarget::Angle(yaw_rad) => (Some(yaw_rad), None),
        YawTarget::Rate(rate_radps) => (None, Some(rate_radps)),
        YawTarget::Keep => (None, None),
    };
    Some(json!({
        "v_world_mps": v_mps.to_array(), "yaw_rad": yaw_rad, "yaw_rate_radps": yaw_rate_radps
    }))
}

/// Returns the bytes of an observation before its first plane or sensor.
pub fn observation_head(bytes: &[u8]) -> &[u8] {
    let Ok(header) = ObservationHeader::parse(bytes) else { return &[] };
    let cameras = &header.cameras[..header.camera_count.into()];
    let sensors = (header.sensor_count > 0).then_some(header.sensors_offset as usize);
    let first = cameras.iter().map(|camera| camera.rgb_offset as usize).chain(sensors).min();
    let len = first.unwrap_or(bytes.len()).max(size_of::<ObservationHeader>());
    &bytes[..len.min(bytes.len())]
}

/// Returns `2026-11-21T04-09-21.123Z`, which sorts by time and is a valid file name on all systems.
fn utc_name(time: SystemTime) -> String {
    let since = time.duration_since(UNIX_EPOCH).unwrap_or_default();
    let Civil { year, month, day, hour, minute, second } = Civil::of_unix(since.as_secs());
    let ms = since.subsec_millis();
    format!("{year:04}-{month:02}-{day:02}T{hour:02}-{minute:02}-{second:02}.{ms:03}Z")
}
