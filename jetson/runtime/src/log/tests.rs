//! Tests of the complete log: records can be read back, and disk errors do not affect the flight.

use std::fs;
use std::io::{self, Cursor, ErrorKind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, UNIX_EPOCH};

use glam::{DQuat, DVec3};
use proptest::prelude::*;
use vizflyt_protocol::geometry::{Body, Intrinsics, Pose, World, body_from_forward_cam};
use vizflyt_protocol::messages::{Arrivals, Setpoint, Timing, bounded};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::time::ServerTime;
use vizflyt_rgbd::{ColorMode, EncodeOptions, Encoder, RgbdView, peek, slice_len};
use vizflyt_sdk::host_now;

use super::file::{Disk, SafeFile};
use super::read::{
    Entry, LogMessage, LogReader, Recorded, RecordedFlight, RecordedPose, RecordedPoses,
};
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

/// Returns an image with this colour mode, split into pieces.
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
    // The file is valid for an independent reader, with an index and all schemas.
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
fn logs_images_as_received_and_returns_their_buffers() {
    let folder = tempfile::tempdir().unwrap();
    let log = FlightLog::open(&LogSettings::full(folder.path()), None);
    let path = log.path().unwrap().to_owned();
    let home = Arc::new(Mailbox::default());
    let images = log.images(&home).unwrap();
    let modes = [ColorMode::Jpeg444, ColorMode::Lossless, ColorMode::Jpeg420, ColorMode::Jpeg444];
    for (seq, mode) in (1..).zip(modes) {
        let head = vec![seq as u8; 2000];
        images.observation(host_now(), seq, head, vec![image(seq, mode)], LoggedSensors::default());
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
    // The colour is a separate JPEG for viewers, and is stored only once.
    let (found, _) = messages(&path);
    let colors: Vec<_> =
        found.iter().filter(|message| &*message.topic == "/camera/front/image").collect();
    assert_eq!(colors.len(), 3, "lossless colour is not a JPEG");
    let color =
        <foxglove::messages::CompressedImage as prost::Message>::decode(&*colors[0].data).unwrap();
    assert!(color.data.starts_with(&[0xff, 0xd8]) && color.data.ends_with(&[0xff, 0xd9]));
    assert_eq!((&*color.format, &*color.frame_id), ("jpeg", "front"));
    let calibrations = found.iter().filter(|m| &*m.topic == "/camera/front/calibration").count();
    assert_eq!(calibrations, 1, "once while unchanged");
    let spares: Vec<Vec<u8>> = std::iter::from_fn(|| home.spare()).collect();
    assert_eq!(spares.len(), 4 * image(1, ColorMode::Jpeg444).pieces.len());
}

/// Returns the pose of a vehicle on a circle at 1.5 m/s at the time `at_ns`.
fn on_the_curve(at_ns: u64) -> Pose<World, Body> {
    let turn = 1.2 * at_ns as f64 * 1e-9;
    let place = DVec3::new(1.25 * turn.cos(), 1.25 * turn.sin(), 1.0);
    Pose::new(place, DQuat::from_rotation_z(turn))
}

/// Time from the newest pose to the instant of an image. [ns]
const AHEAD_NS: u64 = 48_000_000;

/// Returns an image on the curve; `pose_ns` is the measurement time of its newest pose.
fn image_on_the_curve(seq: u64, pose_ns: u64) -> LoggedImage {
    let mut image = image(seq, ColorMode::Jpeg444);
    let k = Intrinsics::from_horizontal_fov(64, 96, 1.5);
    let mount = body_from_forward_cam(DVec3::new(0.1, 0.0, 0.02), 0.2);
    let world_from_body = on_the_curve(pose_ns + AHEAD_NS);
    image.header =
        ImageHeader::new(seq, 0, ServerTime::from_ns(pose_ns), &k, &mount, &world_from_body);
    image.header.exposure_ns = (pose_ns + AHEAD_NS).into();
    image.pose = HostTime::from_ns(pose_ns);
    image.received = HostTime::from_ns(pose_ns + 40_000_000);
    image
}

/// Checks that each image of a log has the instant that it shows and the pose at that instant.
fn check_instants(path: &Path, expected: usize) {
    let (found, _) = messages(path);
    let of =
        |topic: &str| found.iter().filter(|message| &*message.topic == topic).collect::<Vec<_>>();
    let stamped = |message: &LogMessage, at: Option<foxglove::messages::Timestamp>| {
        let at = at.unwrap();
        assert!(message.log_time_ns > 0);
        u64::from(at.sec()) * 1_000_000_000 + u64::from(at.nsec())
    };
    let mut poses = RecordedPoses::new(LogReader::open(path).unwrap());
    let poses: Vec<RecordedPose> = std::iter::from_fn(|| poses.next().unwrap()).collect();
    let mut shown = RecordedPoses::of_topic(LogReader::open(path).unwrap(), "/pose_at_image");
    let images = of("/camera/front/image");
    assert_eq!(images.len(), expected);
    let stamps = of("/camera/front/stamps");
    for (image, stamps) in images.iter().zip(stamps) {
        let color =
            <foxglove::messages::CompressedImage as prost::Message>::decode(&*image.data).unwrap();
        let at_ns = stamped(image, color.timestamp);
        // True pose at that instant, interpolated from the poses of the flight.
        let next = poses.partition_point(|pose| pose.at_ns < at_ns);
        let (a, b) = (&poses[next - 1], &poses[next]);
        let share = (at_ns - a.at_ns) as f64 / (b.at_ns - a.at_ns) as f64;
        let truth = a.world_from_body.interpolate(&b.world_from_body, share);
        let at_image = shown.next().unwrap().unwrap();
        assert_eq!(at_image.at_ns, at_ns);
        let off_m = truth.translation_m.distance(at_image.world_from_body.translation_m);
        assert!(off_m < 1e-4, "{:.1} mm from where it was rendered", 1e3 * off_m);
        assert!(truth.rotation.angle_between(at_image.world_from_body.rotation) < 1e-4);
        // The image arrives before the instant that it shows, and its pose was measured before its arrival.
        let stamps: serde_json::Value = serde_json::from_slice(&stamps.data).unwrap();
        let ns = |key: &str| stamps[key].as_u64().unwrap();
        assert_eq!((ns("shown_ns"), ns("pose_ns")), (at_ns, at_ns - AHEAD_NS));
        assert_eq!(ns("received_ns"), at_ns - AHEAD_NS + 40_000_000);
    }
}

#[test]
fn stamps_images_with_the_instant_that_they_show() {
    let folder = tempfile::tempdir().unwrap();
    let log = FlightLog::open(&LogSettings::full(folder.path()), None);
    let path = log.path().unwrap().to_owned();
    let images = log.images(&Arc::default()).unwrap();
    let start_ns = host_now().as_ns();
    for n in 0..60 {
        let at_ns = start_ns + n * 10_000_000;
        let sample = PoseSample::still(ServerTime::from_ns(at_ns), on_the_curve(at_ns));
        log.pose(HostTime::from_ns(at_ns), HostTime::from_ns(at_ns), &sample);
        if n % 4 == 1 && n < 50 {
            let image = image_on_the_curve(n, at_ns);
            images.observation(
                image.received,
                n,
                vec![0; 8],
                vec![image],
                LoggedSensors::default(),
            );
        }
    }
    drop((log, images));
    check_instants(&path, 13);
}

#[test]
fn virtual_log_stamps_images_and_writes_depth_for_viewers() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("virtual.mcap");
    let file = File::create(&path).unwrap();
    let start_ns = 10_000_000_000;
    let now = HostTime::from_ns(start_ns);
    let mut log = VirtualLog::new(file, LoggedImages::Full, &"x".into(), true, now).unwrap();
    let depth_mm: Vec<u16> = (0..64 * 96).map(|n| n * 7).collect();
    for n in 0..60 {
        let at_ns = start_ns + n * 10_000_000;
        let at = HostTime::from_ns(at_ns);
        let sample = PoseSample::still(ServerTime::from_ns(at_ns), on_the_curve(at_ns));
        log.pose(at, at, &sample);
        log.imu(&ImuSample { stamp: at, accel_mps2: DVec3::Z * 9.8, gyro_radps: DVec3::X });
        if n % 4 == 1 && n < 50 {
            let LoggedImage { header, pose, received, .. } = image_on_the_curve(n, at_ns);
            let rgb = vec![n as u8; 64 * 96 * 3];
            let (header, name) = (&header, "front");
            let image = GivenImage { header, name, pose, rgb: &rgb, depth_mm: &depth_mm };
            log.observation(received, n, &[0; 8], &[image], &LoggedSensors::default());
        }
    }
    log.finish().unwrap();
    check_instants(&path, 13);
    let (found, _) = messages(&path);
    let depth = found.iter().find(|message| &*message.topic == "/camera/front/depth").unwrap();
    let depth = <foxglove::messages::RawImage as prost::Message>::decode(&*depth.data).unwrap();
    assert_eq!((depth.width, depth.height, depth.step), (64, 96, 128));
    assert_eq!(depth.encoding, "16UC1");
    let bytes: Vec<u8> = depth_mm.iter().flat_map(|mm| mm.to_le_bytes()).collect();
    assert!(depth.data == bytes, "depth in millimetres, row by row");
    let imu = found.iter().filter(|message| &*message.topic == "/imu").nth(1).unwrap();
    assert_eq!(imu.log_time_ns, start_ns + 10_000_000);
    let imu: serde_json::Value = serde_json::from_slice(&imu.data).unwrap();
    assert_eq!(imu["accel_mps2"], json!([0.0, 0.0, 9.8]));
}

#[test]
fn full_queue_drops_and_counts_without_waiting() {
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
        Record::Observation(Box::new(ObservationRecord {
            at,
            seq: 1,
            head,
            images,
            sensors: LoggedSensors::default(),
            home,
        }))
    };
    queue.push(observation(queue::MAX_IMAGE_BYTES - 10));
    queue.push(observation(11));
    queue.push(event());
    assert_eq!(queue.dropped(), Dropped { images: 1, records: 2 });
    assert_eq!(home.spare().map(|piece| piece.len()), Some(11), "the buffer is returned");
    queue.taken(queue::MAX_IMAGE_BYTES - 10);
    queue.push(observation(11));
    assert_eq!(queue.dropped().images, 1, "the queue has free space again");
    drop(records);
    queue.push(event());
    assert_eq!(queue.dropped().records, 3, "without a writer, `push` does not block");
}

#[test]
fn reads_the_timing_of_the_complete_flight() {
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
    // A truncated log can be read up to its end.
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    assert!(read_timing(&path).is_ok());
    fs::write(&path, b"not a log").unwrap();
    assert!(read_timing(&path).is_err());
}

#[test]
fn flies_without_a_log_if_the_folder_is_not_writable() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a file");
    fs::write(&file, "x").unwrap();
    let log = FlightLog::open(&LogSettings::full(&file), None);
    assert_eq!(log.path(), None);
    log.write(Channel::Requested, host_now(), &json!({}));
    assert!(log.images(&Arc::default()).is_none());
}

/// Disk that only counts the length of the file.
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

/// Returns the size of a log of one minute at 60 Hz with images of 79 kB, as those of the demo at 320x240,
/// including all other records. [MB]
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
        let record = ObservationRecord {
            at,
            seq: tick,
            head,
            images: vec![image],
            sensors: LoggedSensors::default(),
            home,
        };
        writer.take(Record::Observation(Box::new(record))).unwrap();
        if tick % 60 == 59 {
            writer.check_health().unwrap();
            writer.sinks.flush().unwrap();
        }
    }
    disk.0.load(Ordering::Relaxed) as f64 / 1e6
}

#[test]
fn reduced_log_is_at_most_60_mb_a_minute() {
    let (reduced, full) = (minute_mb(Some(Budget::default())), minute_mb(None));
    println!("reduced {reduced:.1} MB, full {full:.1} MB a minute");
    assert!((50.0..60.0).contains(&reduced), "{reduced} MB");
    assert!(full > 280.0, "{full} MB");
}

#[test]
fn reduced_log_keeps_all_heads_and_some_bit_exact_images() {
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
        images.observation(
            HostTime::from_ns(seq),
            seq,
            vec![seq as u8; 2000],
            vec![image],
            LoggedSensors::default(),
        );
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
    // The first image uses more than the initial budget.
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
fn deletes_and_reports_old_logs_when_a_flight_begins() {
    let folder = tempfile::tempdir().unwrap();
    for hour in 10..20 {
        let name = format!("2026-01-01T{hour}-00-00.000Z.mcap");
        // Larger than the start of each log.
        File::create(folder.path().join(name)).unwrap().set_len(1_000_000).unwrap();
    }
    let retention = Retention { max_bytes: 5_500_000, max_age: None };
    let settings = LogSettings { retention, ..LogSettings::full(folder.path()) };
    let log = FlightLog::open(&settings, None);
    let notice = log.poll_trouble().unwrap();
    assert!(notice.contains("deleted the ") && notice.contains("[log] keeps"), "{notice}");
    let left = fs::read_dir(folder.path()).unwrap().count();
    assert_eq!(left, 6, "five old logs and the new one");
    assert!(log.path().unwrap().exists());
}

/// Disk with a maximum file length. [bytes]
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
    // Larger than the disk, and large enough to complete a chunk.
    let big = "x".repeat(5 << 20).into_bytes();
    queue.push(Record::Json { channel: Channel::Requested, at: HostTime::ZERO, json: big });
    let images = vec![image(1, ColorMode::Jpeg444)];
    let (at, head) = (HostTime::ZERO, vec![]);
    let record = ObservationRecord {
        at,
        seq: 1,
        head,
        images,
        sensors: LoggedSensors::default(),
        home: Arc::clone(&home),
    };
    queue.push(Record::Observation(Box::new(record)));
    queue.end();
    LogWriter::new(sinks, Arc::clone(&queue), Box::new(|| None)).run(&records);
    let trouble = queue.poll_trouble().unwrap();
    assert!(trouble.contains("not logged any further"), "{trouble}");
    assert_eq!(queue.poll_trouble(), None, "once");
    assert!(home.spare().is_some(), "the buffer is returned after the error");
}

#[test]
fn nearly_full_disk_omits_only_images() {
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
    let record = ObservationRecord {
        at: HostTime::ZERO,
        seq: 1,
        head: vec![],
        images,
        sensors: LoggedSensors::default(),
        home,
    };
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
fn unclosed_log_is_a_valid_file() {
    // As in a killed process, the writer is not finished.
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
    let (read, is_cut) = messages(&path);
    assert_eq!((read.len(), is_cut), (1, false), "not reported as cut");
}

proptest! {
    /// Reads damaged, truncated and hostile files without a panic.
    #[test]
    fn reads_damaged_files_without_a_panic(
        cut in any::<prop::sample::Index>(),
        flips in prop::collection::vec(any::<(prop::sample::Index, u8)>(), 0..8)
    ) {
        static LOG: std::sync::OnceLock<Vec<u8>> = std::sync::OnceLock::new();
        let mut bytes = LOG.get_or_init(|| {
            let folder = tempfile::tempdir().unwrap();
            let log = FlightLog::open(&LogSettings::full(folder.path()), None);
            let path = log.path().unwrap().to_owned();
            let images = log.images(&Arc::default()).unwrap();
            images.observation(host_now(), 1, vec![0; 99], vec![image(1, ColorMode::Jpeg444)], LoggedSensors::default());
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
