//! The flight log: one MCAP file with JSON channels, written by a thread of its own.
//!
//! Chunks are closed and flushed every second, so a killed process leaves all but the last one
//! readable. A disk that is full or a folder that cannot be written costs a warning, never the
//! flight. Opens in Foxglove and Rerun.

use std::collections::BTreeMap;
use std::fs::{File, create_dir_all};
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use mcap::records::MessageHeader;
use mcap::{WriteOptions, Writer};
use serde::Serialize;
use serde_json::{Value, json};
use vizflyt_protocol::messages::Timing;
use vizflyt_protocol::time::HostTime;
use vizflyt_sdk::host_now;

/// What is logged; each has its channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Channel {
    /// Localized pose and velocity.
    Pose,
    /// What the plugin asked for.
    Asked,
    /// What the guard sent on.
    Sent,
    /// Events of server and runtime.
    Event,
    /// The runtime's regular report.
    Telemetry,
    /// Lines the plugin printed.
    PluginOutput,
    /// Stamps of each image on its way.
    Image,
    /// Where images get their age, over the last seconds.
    Timing,
}

impl Channel {
    const ALL: [Self; 8] = [
        Self::Pose,
        Self::Asked,
        Self::Sent,
        Self::Event,
        Self::Telemetry,
        Self::PluginOutput,
        Self::Image,
        Self::Timing,
    ];

    /// Topic and schema name.
    fn names(self) -> (&'static str, &'static str) {
        match self {
            Self::Pose => ("/pose", "vizflyt.Pose"),
            Self::Asked => ("/setpoint/asked", "vizflyt.Setpoint"),
            Self::Sent => ("/setpoint/sent", "vizflyt.GuidedSetpoint"),
            Self::Event => ("/event", "vizflyt.Event"),
            Self::Telemetry => ("/telemetry", "vizflyt.Telemetry"),
            Self::PluginOutput => ("/plugin/output", "vizflyt.PluginOutput"),
            Self::Image => ("/image/timing", "vizflyt.ImageTiming"),
            Self::Timing => ("/timing", "vizflyt.Timing"),
        }
    }

    /// JSON schema of the channel's messages, as far as viewers use it.
    fn schema(self) -> Value {
        let number = json!({"type": "number"});
        let text = json!({"type": "string"});
        let vector = json!({"type": "array", "items": {"type": "number"}});
        let properties = match self {
            Self::Pose => json!({
                "stamp_ns": number, "p_world_m": vector, "q_world_from_body_xyzw": vector,
                "v_world_mps": vector, "omega_body_radps": vector, "age_ms": number
            }),
            Self::Asked => json!({"seq": number, "setpoint": {}}),
            Self::Sent => {
                json!({"v_world_mps": vector, "yaw_rad": number, "yaw_rate_radps": number})
            }
            Self::Event => json!({"stamp": number, "kind": {}, "text": text}),
            Self::Telemetry => json!({"phase": text, "vehicle": {"type": "object"},
                "images": {"type": "object"}, "setpoint": {}}),
            Self::PluginOutput => json!({"stream": text, "line": text, "image_seq": number}),
            Self::Image => json!({
                "seq": number, "pose_ns": number, "received_ns": number, "ready_ns": number,
                "entered_ns": number, "returned_ns": number, "age_ms": number
            }),
            Self::Timing => json!({
                "seconds": number, "waterfall": {"type": "object"},
                "intervals": {"type": "object"}, "clock": {}, "cameras": {"type": "array"}
            }),
        };
        json!({"type": "object", "title": self.names().1, "properties": properties})
    }
}

struct Record {
    channel: Channel,
    at: HostTime,
    json: Vec<u8>,
}

/// The log of one flight. Cheap to call from the control loop; dropping it closes the file.
#[derive(Debug)]
pub struct FlightLog {
    records: Option<SyncSender<Record>>,
    writer: Option<JoinHandle<()>>,
    path: Option<PathBuf>,
    dropped: Arc<AtomicU64>,
}

impl std::fmt::Debug for Record {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:?} at {:?}", self.channel, self.at)
    }
}

/// Records waiting for the disk at most: some 10 s of flight. Beyond, they are dropped, counted.
const QUEUE: usize = 8192;
/// A chunk is closed this often.
const CHUNK_PERIOD: Duration = Duration::from_secs(1);

impl FlightLog {
    /// Opens a log in `folder`, named by the time of day (UTC). If it cannot be written, says so
    /// in a warning and logs nothing.
    pub fn open(folder: &Path) -> Self {
        let path = folder.join(format!("{}.mcap", utc_name(SystemTime::now())));
        match Self::start(folder, &path) {
            Ok(log) => log,
            Err(error) => {
                tracing::warn!("no flight log: {}: {error}", path.display());
                Self { records: None, writer: None, path: None, dropped: Arc::default() }
            }
        }
    }

    fn start(folder: &Path, path: &Path) -> mcap::McapResult<Self> {
        create_dir_all(folder)?;
        let file = BufWriter::new(File::create(path)?);
        let mut writer = WriteOptions::new()
            .compression(None)
            .profile("")
            .library(concat!("vizflyt ", env!("CARGO_PKG_VERSION")))
            // Closed by time, not by size.
            .chunk_size(None)
            .create(file)?;
        let mut ids = BTreeMap::new();
        for channel in Channel::ALL {
            let (topic, name) = channel.names();
            let schema = serde_json::to_vec(&channel.schema()).unwrap_or_default();
            let schema = writer.add_schema(name, "jsonschema", &schema)?;
            ids.insert(channel, writer.add_channel(schema, topic, "json", &BTreeMap::new())?);
        }
        writer.flush()?;
        let (records, receiver) = sync_channel(QUEUE);
        let handle = thread::Builder::new()
            .name("flight-log".into())
            .spawn(move || write_all(writer, &ids, &receiver))?;
        Ok(Self {
            records: Some(records),
            writer: Some(handle),
            path: Some(path.to_owned()),
            dropped: Arc::default(),
        })
    }

    /// Returns the file, if one is written.
    pub fn path(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// Logs `message` as of `at`. Never waits for the disk.
    pub fn write(&self, channel: Channel, at: HostTime, message: &impl Serialize) {
        let Some(records) = &self.records else { return };
        let Ok(json) = serde_json::to_vec(message) else { return };
        if records.try_send(Record { channel, at, json }).is_err() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Drop for FlightLog {
    fn drop(&mut self) {
        drop(self.records.take());
        if let Some(writer) = self.writer.take() {
            let _ = writer.join();
        }
        let dropped = self.dropped.load(Ordering::Relaxed);
        if dropped > 0 {
            tracing::warn!("flight log: {dropped} records were dropped; the disk is too slow");
        }
    }
}

/// Reads the times of a flight from its log: of the whole flight, or, where the runtime was killed
/// in it, of its last seconds. `None` if the log has none.
///
/// # Errors
/// If the file cannot be read or is no MCAP file.
pub fn read_timing(path: &Path) -> mcap::McapResult<Option<Timing>> {
    let bytes = std::fs::read(path)?;
    if !bytes.starts_with(mcap::MAGIC) {
        return Err(mcap::McapError::BadMagic);
    }
    // A killed runtime leaves a file without an end.
    let options = mcap::read::Options::IgnoreEndMagic.into();
    let messages = mcap::read::MessageStream::new_with_options(&bytes, options)?;
    let mut found: Option<Timing> = None;
    for message in messages.map_while(Result::ok) {
        if message.channel.topic == Channel::Timing.names().0
            && let Ok(timing) = serde_json::from_slice::<Timing>(&message.data)
            && found.as_ref().is_none_or(|best| timing.seconds >= best.seconds)
        {
            found = Some(timing);
        }
    }
    Ok(found)
}

/// Writes records until the log is dropped or the disk refuses.
fn write_all(
    mut writer: Writer<BufWriter<File>>,
    ids: &BTreeMap<Channel, u16>,
    records: &Receiver<Record>,
) {
    // MCAP wants times since 1970.
    let wall_ns = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos() as u64);
    let offset_ns = wall_ns.wrapping_sub(host_now().as_ns());
    let mut sequence = 0u32;
    let mut flushed = Instant::now();
    loop {
        let outcome = match records.recv_timeout(CHUNK_PERIOD) {
            Ok(record) => {
                sequence = sequence.wrapping_add(1);
                let at_ns = record.at.as_ns().wrapping_add(offset_ns);
                let header = MessageHeader {
                    channel_id: ids[&record.channel],
                    sequence,
                    log_time: at_ns,
                    publish_time: at_ns,
                };
                writer.write_to_known_channel(&header, &record.json)
            }
            Err(RecvTimeoutError::Timeout) => Ok(()),
            Err(RecvTimeoutError::Disconnected) => break,
        };
        let outcome = outcome.and_then(|()| {
            if flushed.elapsed() < CHUNK_PERIOD {
                return Ok(());
            }
            flushed = Instant::now();
            writer.flush()
        });
        if let Err(error) = outcome {
            tracing::warn!("flight log ends here: {error}");
            return;
        }
    }
    if let Err(error) = writer.finish() {
        tracing::warn!("flight log: closing failed: {error}");
    }
}

/// Returns `2026-11-21T04-09-21.123Z`: sorts by time, and is a file name everywhere.
fn utc_name(time: SystemTime) -> String {
    let since = time.duration_since(UNIX_EPOCH).unwrap_or_default();
    let (days, second) = (since.as_secs() / 86_400, since.as_secs() % 86_400);
    // Civil date from days since 1970, after H. Hinnant, "chrono-compatible low-level date
    // algorithms", civil_from_days, for dates after 1970.
    let z = days + 719_468;
    let (era, day_of_era) = (z / 146_097, z % 146_097);
    let year_of_era =
        (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * shifted + 2) / 5 + 1;
    let month = if shifted < 10 { shifted + 3 } else { shifted - 9 };
    let year = year_of_era + era * 400 + u64::from(month <= 2);
    let (hour, minute, second) = (second / 3600, second / 60 % 60, second % 60);
    let ms = since.subsec_millis();
    format!("{year:04}-{month:02}-{day:02}T{hour:02}-{minute:02}-{second:02}.{ms:03}Z")
}

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::messages::Arrivals;

    #[test]
    fn names_are_utc() {
        let check = |seconds, expected: &str| {
            assert_eq!(utc_name(UNIX_EPOCH + Duration::from_secs(seconds)), expected);
        };
        check(0, "1970-01-01T00-00-00.000Z");
        check(951_782_400, "2000-02-29T00-00-00.000Z");
        check(1_795_234_161, "2026-11-21T04-09-21.000Z");
    }

    #[test]
    fn what_is_logged_is_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let log = FlightLog::open(&folder.path().join("flights"));
        let path = log.path().unwrap().to_owned();
        for n in 0..100 {
            log.write(Channel::Asked, host_now(), &json!({"seq": n}));
        }
        log.write(Channel::PluginOutput, host_now(), &json!({"line": "hello"}));
        drop(log);
        let bytes = std::fs::read(path).unwrap();
        let messages: Vec<_> =
            mcap::read::MessageStream::new(&bytes).unwrap().map(Result::unwrap).collect();
        assert_eq!(messages.len(), 101);
        let last = &messages[100];
        assert_eq!(last.channel.topic, "/plugin/output");
        assert_eq!(last.channel.schema.as_ref().unwrap().encoding, "jsonschema");
        assert_eq!(&*last.data, br#"{"line":"hello"}"#);
        assert!(last.log_time > 1_600_000_000_000_000_000, "since 1970");
    }

    #[test]
    fn the_times_of_the_whole_flight_are_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let log = FlightLog::open(folder.path());
        let path = log.path().unwrap().to_owned();
        for (seconds, images) in [(5.0, 1), (90.0, 2), (5.0, 3)] {
            let mut timing = Timing { seconds, ..Timing::default() };
            timing.waterfall.images = images;
            timing.cameras.push(Arrivals { arrived: images, ..Arrivals::default() }).unwrap();
            log.write(Channel::Timing, host_now(), &timing);
        }
        drop(log);
        let found = read_timing(&path).unwrap().unwrap();
        assert_eq!((found.seconds, found.waterfall.images), (90.0, 2));
        assert_eq!(found.cameras[0].arrived, 2);
        // Cut off, it has what was written before.
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        assert!(read_timing(&path).is_ok());
        std::fs::write(&path, b"not a log").unwrap();
        assert!(read_timing(&path).is_err());
    }

    #[test]
    fn a_folder_that_cannot_be_written_stops_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a file");
        std::fs::write(&file, "x").unwrap();
        let log = FlightLog::open(&file);
        assert_eq!(log.path(), None);
        log.write(Channel::Event, host_now(), &json!({}));
    }

    #[test]
    fn a_full_disk_stops_nothing() {
        // A device that is always full, where the system has one.
        let Ok(full) = File::options().write(true).open("/dev/full") else { return };
        let writer = WriteOptions::new().compression(None).create(BufWriter::new(full)).unwrap();
        let (records, receiver) = sync_channel(4);
        let ids = Channel::ALL.iter().map(|&channel| (channel, 1)).collect();
        records
            .send(Record { channel: Channel::Event, at: host_now(), json: vec![b'x'; 99] })
            .unwrap();
        drop(records);
        write_all(writer, &ids, &receiver);
    }
}
