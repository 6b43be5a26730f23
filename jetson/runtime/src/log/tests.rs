//! The log as a whole: what is written is read back, and nothing that happens to the disk reaches
//! those who fly.

use std::fs;
use std::io::{self, Cursor, ErrorKind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, UNIX_EPOCH};

use proptest::prelude::*;
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_protocol::messages::{Arrivals, Setpoint, Timing, bounded};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::time::ServerTime;
use vizflyt_rgbd::{ColorMode, EncodeOptions, Encoder, RgbdView, peek, slice_len};
use vizflyt_sdk::host_now;

use super::file::{Disk, SafeFile};
use super::read::{Entry, LogMessage, LogReader, Recorded, RecordedFlight};
use super::*;

fn messages(path: &Path) -> (Vec<LogMessage>, bool) {
    let mut reader = LogReader::open(path).unwrap();
    let mut found = Vec::new();
    while let Some(entry) = reader.next().unwrap() {
        if let Entry::Message(message) = entry {
            found.push(message);
        }
    }
    (found, reader.is_cut())
}

fn recorded(path: &Path) -> Vec<Recorded> {
    let mut flight = RecordedFlight::new(LogReader::open(path).unwrap(), true);
    std::iter::from_fn(|| flight.next().unwrap()).collect()
}

/// An image of this colour mode, cut into pieces.
fn image(seq: u64, color_mode: ColorMode) -> LoggedImage {
    let (width, height) = (64u32, 96u32);
    let pixels = (width * height) as usize;
    let rgb: Vec<u8> = (0..3 * pixels).map(|n| (n as u64 * (7 + seq) / 5) as u8).collect();
    let depth_mm: Vec<u16> = (0..pixels).map(|n| (n as u64 * seq) as u16).collect();
    let view = RgbdView { width, height, rgb: &rgb, depth_mm: &depth_mm };
    let mut all = Vec::new();
    let options = EncodeOptions { color_mode, ..EncodeOptions::default() };
    Encoder::new(options).encode(&view, &mut all).unwrap();
    let (head, mut rest) = all.split_at(peek(&all).unwrap().header_len);
    let mut pieces = vec![head.to_vec()];
    while !rest.is_empty() {
        let (slice, after) = rest.split_at(slice_len(rest).unwrap() as usize);
        pieces.push(slice.to_vec());
        rest = after;
    }
    let k = Intrinsics::from_horizontal_fov(width, height, 1.5);
    let (mount, body) = (Pose::IDENTITY, Pose::IDENTITY);
    let header = ImageHeader::new(seq, 0, ServerTime::ZERO, &k, &mount, &body);
    let (pose, received) = (HostTime::from_ns(5), HostTime::from_ns(6));
    LoggedImage { camera: 0, name: "front".into(), header, pose, received, pieces }
}

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
fn records_survive_the_log() {
    let folder = tempfile::tempdir().unwrap();
    let log = FlightLog::open(&LogSettings::full(folder.path().join("flights")), None);
    let path = log.path().unwrap().to_owned();
    log.flight(&"avoid".into(), &["--gain=2".into()]);
    for n in 0..100 {
        log.write(Channel::Requested, host_now(), &json!({"seq": n}));
    }
    log.line(host_now(), "stdout", "hello", 7);
    let answer = FromPlugin::Reply {
        seq: 3,
        entered: HostTime::from_ns(1),
        returned: HostTime::from_ns(2),
        setpoint: Some(Setpoint::Hold),
    };
    log.from_plugin(host_now(), &answer);
    drop(log);
    let (found, is_cut) = messages(&path);
    assert!(!is_cut);
    assert_eq!(found.iter().filter(|message| &*message.topic == "/setpoint/asked").count(), 100);
    assert!(found[0].log_time_ns > 1_600_000_000_000_000_000, "since 1970");
    let line = found.iter().find(|message| &*message.topic == "/plugin/output").unwrap();
    let line = <foxglove::messages::Log as prost::Message>::decode(&*line.data).unwrap();
    assert_eq!((&*line.message, &*line.name), ("hello", "stdout at tick 7"));
    // An independent reader finds it in order, with an index and all schemas.
    let bytes = fs::read(&path).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    assert!(summary.channels.values().all(|channel| channel.schema.is_some()));
    assert!(mcap::MessageStream::new(&bytes).unwrap().all(|message| message.is_ok()));
    let recorded = recorded(&path);
    assert!(matches!(&recorded[0], Recorded::Flight(values) if values["plugin"] == "avoid"
        && values["arguments"] == r#"["--gain=2"]"#));
    let Recorded::Plugin(message) = &recorded[1] else { panic!("{recorded:?}") };
    assert!(!message.is_to_plugin);
    let body = vizflyt_protocol::packet::framing::decode_body::<FromPlugin>(&message.body);
    assert_eq!(body.unwrap(), answer);
}

#[test]
fn images_are_logged_as_they_came_and_their_memory_goes_back() {
    let folder = tempfile::tempdir().unwrap();
    let log = FlightLog::open(&LogSettings::full(folder.path()), None);
    let path = log.path().unwrap().to_owned();
    let home = Arc::new(Mailbox::default());
    let images = log.images(&home).unwrap();
    let modes = [ColorMode::Jpeg444, ColorMode::Lossless, ColorMode::Jpeg420, ColorMode::Jpeg444];
    for (seq, mode) in (1..).zip(modes) {
        let head = vec![seq as u8; 2000];
        images.observation(host_now(), seq, head, vec![image(seq, mode)]);
    }
    drop((log, images));
    let recorded = recorded(&path);
    assert_eq!(recorded.len(), 4);
    for ((seq, mode), found) in (1..).zip(modes).zip(&recorded) {
        let Recorded::Observation(found) = found else { panic!("{found:?}") };
        assert_eq!((found.seq, &found.head), (seq, &vec![seq as u8; 2000]));
        let sent = image(seq, mode);
        assert_eq!(found.images[0].bitstream, sent.pieces.concat(), "{mode:?}: bit by bit");
        assert!(ImageHeader::parse(&found.images[0].header).is_ok());
    }
    // What viewers open is a JPEG of its own; it is not in the log a second time.
    let (found, _) = messages(&path);
    let colors: Vec<_> =
        found.iter().filter(|message| &*message.topic == "/camera/front/image").collect();
    assert_eq!(colors.len(), 3, "lossless colour is no JPEG");
    let color =
        <foxglove::messages::CompressedImage as prost::Message>::decode(&*colors[0].data).unwrap();
    assert!(color.data.starts_with(&[0xff, 0xd8]) && color.data.ends_with(&[0xff, 0xd9]));
    assert_eq!((&*color.format, &*color.frame_id), ("jpeg", "front"));
    let calibrations = found.iter().filter(|m| &*m.topic == "/camera/front/calibration").count();
    assert_eq!(calibrations, 1, "once while it stays the same");
    let spares: Vec<Vec<u8>> = std::iter::from_fn(|| home.spare()).collect();
    assert_eq!(spares.len(), 4 * image(1, ColorMode::Jpeg444).pieces.len());
}

#[test]
fn a_queue_that_is_full_drops_and_counts_and_nobody_waits() {
    let (queue, records) = Queue::of(3);
    let home = Arc::new(Mailbox::default());
    let event = || Record::Json { channel: Channel::Requested, at: HostTime::ZERO, json: vec![] };
    for _ in 0..5 {
        queue.push(event());
    }
    assert_eq!(queue.dropped(), Dropped { images: 0, records: 2 });
    assert_eq!(records.try_iter().count(), 3);
    // Images have a limit in bytes.
    let observation = |len| {
        let mut image = image(1, ColorMode::Jpeg444);
        image.pieces = vec![vec![0; len]];
        let (at, head, images) = (HostTime::ZERO, vec![], vec![image]);
        let home = Arc::clone(&home);
        Record::Observation(Box::new(ObservationRecord { at, seq: 1, head, images, home }))
    };
    queue.push(observation(queue::MAX_IMAGE_BYTES - 10));
    queue.push(observation(11));
    queue.push(event());
    assert_eq!(queue.dropped(), Dropped { images: 1, records: 2 });
    assert_eq!(home.spare().map(|piece| piece.len()), Some(11), "its memory goes back");
    queue.taken(queue::MAX_IMAGE_BYTES - 10);
    queue.push(observation(11));
    assert_eq!(queue.dropped().images, 1, "there is room again");
    drop(records);
    queue.push(event());
    assert_eq!(queue.dropped().records, 3, "a writer that is gone stops nobody");
}

#[test]
fn the_times_of_the_whole_flight_are_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let log = FlightLog::open(&LogSettings::full(folder.path()), None);
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
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    assert!(read_timing(&path).is_ok());
    fs::write(&path, b"not a log").unwrap();
    assert!(read_timing(&path).is_err());
}

#[test]
fn a_folder_that_cannot_be_written_stops_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a file");
    fs::write(&file, "x").unwrap();
    let log = FlightLog::open(&LogSettings::full(&file), None);
    assert_eq!(log.path(), None);
    log.write(Channel::Requested, host_now(), &json!({}));
    assert!(log.images(&Arc::default()).is_none());
}

/// A disk that only counts how long the file gets.
#[derive(Clone, Default)]
struct Counting(Arc<AtomicU64>);

impl Disk for Counting {
    fn write_at(&mut self, bytes: &[u8], offset: u64) -> io::Result<()> {
        self.0.fetch_max(offset + bytes.len() as u64, Ordering::Relaxed);
        Ok(())
    }

    fn cut(&mut self, _: u64) -> io::Result<()> {
        Ok(())
    }
}

/// Returns the megabytes of a minute at 60 Hz with images of 79 kB, what the demo's take at 320x240,
/// and all that is logged beside them.
fn minute_mb(budget: Option<Budget>) -> f64 {
    let disk = Counting::default();
    let sinks = LogSinks::new(Some(disk.clone()), None, budget).unwrap();
    let mut writer = LogWriter::new(sinks, Queue::new().0, Box::new(|| None));
    let sample = PoseSample::still(ServerTime::ZERO, Pose::IDENTITY);
    for tick in 0..3600 {
        let at = HostTime::from_ns(tick * 1_000_000_000 / 60);
        for _ in 0..4 {
            writer.take(Record::Pose { at, stamp: at, sample }).unwrap();
        }
        for channel in [Channel::Requested, Channel::Sent, Channel::Image] {
            writer.take(Record::Json { channel, at, json: vec![b' '; 200] }).unwrap();
        }
        writer.take(Record::Plugin { at, is_to_plugin: false, body: vec![0; 60] }).unwrap();
        let mut image = image(1, ColorMode::Jpeg444);
        image.pieces = vec![vec![0; 79_000]];
        let head = vec![0; size_of::<ObservationHeader>()];
        let home = Arc::default();
        let record = ObservationRecord { at, seq: tick, head, images: vec![image], home };
        writer.take(Record::Observation(Box::new(record))).unwrap();
        if tick % 60 == 59 {
            writer.check_health().unwrap();
            writer.sinks.flush().unwrap();
        }
    }
    disk.0.load(Ordering::Relaxed) as f64 / 1e6
}

#[test]
fn a_reduced_log_takes_at_most_60_mb_a_minute() {
    let (reduced, full) = (minute_mb(Some(Budget::default())), minute_mb(None));
    println!("reduced {reduced:.1} MB, full {full:.1} MB a minute");
    assert!((50.0..60.0).contains(&reduced), "{reduced} MB");
    assert!(full > 280.0, "{full} MB");
}

#[test]
fn a_reduced_log_has_the_head_of_every_observation_and_some_images_bit_by_bit() {
    let folder = tempfile::tempdir().unwrap();
    let settings =
        LogSettings { images: LoggedImages::Reduced, ..LogSettings::full(folder.path()) };
    let log = FlightLog::open(&settings, None);
    let path = log.path().unwrap().to_owned();
    log.flight(&"avoid".into(), &[]);
    let images = log.images(&Arc::default()).unwrap();
    let mut large = image(1, ColorMode::Lossless).pieces;
    large.push(vec![7; 2 << 20]);
    for seq in 0..10 {
        let image = LoggedImage { pieces: large.clone(), ..image(1, ColorMode::Lossless) };
        images.observation(HostTime::from_ns(seq), seq, vec![seq as u8; 2000], vec![image]);
    }
    drop((log, images));
    let found = recorded(&path);
    assert!(matches!(&found[0], Recorded::Flight(values) if values["images"] == "reduced"));
    let observations: Vec<&Observation> = found
        .iter()
        .filter_map(|recorded| match recorded {
            Recorded::Observation(observation) => Some(observation),
            _ => None,
        })
        .collect();
    assert_eq!(observations.len(), 10);
    // The first spends more than the second that a log begins with.
    assert_eq!(observations[0].images[0].bitstream, large.concat(), "bit by bit");
    for (seq, observation) in observations.iter().enumerate() {
        assert_eq!(observation.head, vec![seq as u8; 2000]);
        assert_eq!(observation.images.is_empty(), seq > 0, "{seq}");
    }
    let (found, _) = messages(&path);
    let status = found.iter().rfind(|message| &*message.topic == "/log").unwrap();
    let status: serde_json::Value = serde_json::from_slice(&status.data).unwrap();
    assert_eq!(status["left_out_images"], 9);
}

#[test]
fn old_logs_are_deleted_when_a_flight_begins_and_it_is_reported() {
    let folder = tempfile::tempdir().unwrap();
    for hour in 10..20 {
        let name = format!("2026-01-01T{hour}-00-00.000Z.mcap");
        // Larger than what every log begins with.
        File::create(folder.path().join(name)).unwrap().set_len(1_000_000).unwrap();
    }
    let retention = Retention { max_bytes: 5_500_000, max_age: None };
    let settings = LogSettings { retention, ..LogSettings::full(folder.path()) };
    let log = FlightLog::open(&settings, None);
    let notice = log.poll_trouble().unwrap();
    assert!(notice.contains("deleted the ") && notice.contains("[log] keeps"), "{notice}");
    let left = fs::read_dir(folder.path()).unwrap().count();
    assert_eq!(left, 6, "five, and this flight's");
    assert!(log.path().unwrap().exists());
}

/// A disk that fails once so much is on it.
struct Failing(u64);

impl Disk for Failing {
    fn write_at(&mut self, bytes: &[u8], offset: u64) -> io::Result<()> {
        let end = offset + bytes.len() as u64;
        if end > self.0 { Err(ErrorKind::StorageFull.into()) } else { Ok(()) }
    }

    fn cut(&mut self, _: u64) -> io::Result<()> {
        Ok(())
    }
}

#[test]
fn full_disk_ends_the_log_with_a_report_and_buffers_are_reused() {
    let (queue, records) = Queue::of(64);
    let sinks = LogSinks::new(Some(Failing(100_000)), None, None).unwrap();
    let home = Arc::new(Mailbox::default());
    // More than the disk holds, of which a chunk is made at once.
    let big = "x".repeat(5 << 20).into_bytes();
    queue.push(Record::Json { channel: Channel::Requested, at: HostTime::ZERO, json: big });
    let images = vec![image(1, ColorMode::Jpeg444)];
    let (at, head) = (HostTime::ZERO, vec![]);
    let record = ObservationRecord { at, seq: 1, head, images, home: Arc::clone(&home) };
    queue.push(Record::Observation(Box::new(record)));
    queue.end();
    LogWriter::new(sinks, Arc::clone(&queue), Box::new(|| None)).run(&records);
    let trouble = queue.poll_trouble().unwrap();
    assert!(trouble.contains("not logged any further"), "{trouble}");
    assert_eq!(queue.poll_trouble(), None, "once");
    assert!(home.spare().is_some(), "memory goes round all the same");
}

#[test]
fn a_disk_that_is_nearly_full_gets_no_images_but_the_rest() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log.mcap");
    let (queue, records) = Queue::of(64);
    let disk = RealFile::new(File::create(&path).unwrap()).unwrap();
    let sinks = LogSinks::new(Some(disk), None, None).unwrap();
    let mut writer = LogWriter::new(sinks, Arc::clone(&queue), Box::new(|| Some(1 << 20)));
    writer.check_health().unwrap();
    let trouble = queue.poll_trouble().unwrap();
    assert!(trouble.contains("no longer logged: only 1 MB"), "{trouble}");
    let home = Arc::default();
    let images = vec![image(1, ColorMode::Jpeg444)];
    let record = ObservationRecord { at: HostTime::ZERO, seq: 1, head: vec![], images, home };
    queue.push(Record::Observation(Box::new(record)));
    queue.push(Record::Json {
        channel: Channel::Requested,
        at: HostTime::ZERO,
        json: b"{}".into(),
    });
    queue.end();
    writer.run(&records);
    let topics: Vec<_> =
        messages(&path).0.iter().map(|message| message.topic.to_string()).collect();
    assert!(topics.contains(&"/setpoint/asked".into()), "{topics:?}");
    assert!(!topics.contains(&"/observation".into()), "{topics:?}");
}

#[test]
fn a_log_that_is_not_closed_is_a_whole_file() {
    // What a killed process leaves: nobody finishes the writer.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log.mcap");
    let disk = RealFile::new(File::create(&path).unwrap()).unwrap();
    let mut file = SafeFile::new(disk);
    let mut writer = mcap::WriteOptions::new().compression(None).create(&mut file).unwrap();
    let id = writer.add_channel(0, "/x", "json", &std::collections::BTreeMap::new()).unwrap();
    let header =
        mcap::records::MessageHeader { channel_id: id, sequence: 1, log_time: 1, publish_time: 1 };
    writer.write_to_known_channel(&header, b"{}").unwrap();
    writer.flush().unwrap();
    writer.write_to_known_channel(&header, b"{}").unwrap();
    std::mem::forget(writer);
    let bytes = fs::read(&path).unwrap();
    let strict: Vec<_> = mcap::MessageStream::new(&bytes).unwrap().collect();
    assert_eq!(strict.len(), 1);
    assert!(strict[0].is_ok());
    assert_eq!(messages(&path), (messages(&path).0, false), "not even cut");
}

proptest! {
    /// Damaged, cut or hostile: read as far as it goes, without a panic.
    #[test]
    fn any_file_is_read_as_far_as_it_goes(
        cut in any::<prop::sample::Index>(),
        flips in prop::collection::vec(any::<(prop::sample::Index, u8)>(), 0..8)
    ) {
        static LOG: std::sync::OnceLock<Vec<u8>> = std::sync::OnceLock::new();
        let mut bytes = LOG.get_or_init(|| {
            let folder = tempfile::tempdir().unwrap();
            let log = FlightLog::open(&LogSettings::full(folder.path()), None);
            let path = log.path().unwrap().to_owned();
            let images = log.images(&Arc::default()).unwrap();
            images.observation(host_now(), 1, vec![0; 99], vec![image(1, ColorMode::Jpeg444)]);
            let note = Event { stamp: ServerTime::ZERO, kind: EventKind::Note, text: bounded("x") };
            log.to_plugin(host_now(), &ToPlugin::Event(note));
            drop((log, images));
            fs::read(path).unwrap()
        }).clone();
        bytes.truncate(cut.index(bytes.len()) + 1);
        for (at, byte) in flips {
            let at = at.index(bytes.len());
            bytes[at] = byte;
        }
        if let Ok(reader) = LogReader::new(Cursor::new(bytes)) {
            let mut flight = RecordedFlight::new(reader, true);
            while let Ok(Some(_)) = flight.next() {}
        }
    }
}
