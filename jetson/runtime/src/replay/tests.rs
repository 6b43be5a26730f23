//! Tests that write logs and replay them to a real plugin process, the example `misbehave`.

use std::collections::BTreeMap;
use std::fs;
use std::io::Cursor;
use std::path::PathBuf;
use std::sync::Arc;

use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_protocol::messages::{Event, EventKind, FromPlugin, ToPlugin, YawTarget, bounded};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::time::ServerTime;
use vizflyt_rgbd::{EncodeOptions, Encoder, RgbdView, peek, slice_len};
use vizflyt_sdk::glam::DVec3;
use vizflyt_sdk::{CameraInfo, ImageStamps, ObservationBuffer};

use prost::Message as _;

use super::*;
use crate::log::{
    FlightLog, LogSettings, LoggedImage, LoggedSensors, PluginMessage, observation_head,
};

fn camera() -> CameraInfo {
    CameraInfo::forward("front", Intrinsics::from_horizontal_fov(32, 24, 1.5))
}

fn at(ms: u64) -> HostTime {
    HostTime::from_ns(ms * 1_000_000)
}

/// Log that is being written.
struct Flight {
    log: FlightLog,
    folder: tempfile::TempDir,
}

impl Flight {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        Self { log: FlightLog::open(&LogSettings::full(folder.path()), None), folder }
    }

    fn start(&self, ms: u64) {
        let mut arena = crate::flight::tests::arena();
        arena.cameras.clear();
        let _ = arena.cameras.push(camera());
        self.log.to_plugin(at(ms), &ToPlugin::Start(arena));
    }

    fn event(&self, ms: u64) {
        let text = bounded("the plugin flies");
        let kind = EventKind::Phase(vizflyt_protocol::messages::FlightPhase::Flying);
        let event = Event { stamp: ServerTime::ZERO, kind, text };
        self.log.to_plugin(at(ms), &ToPlugin::Event(event));
    }

    fn image(&self, seq: u64, ms: u64) {
        let (rgb, depth) = (vec![seq as u8; 32 * 24 * 3], vec![seq as u16; 32 * 24]);
        let view = RgbdView { width: 32, height: 24, rgb: &rgb, depth_mm: &depth };
        let mut all = Vec::new();
        Encoder::new(EncodeOptions::default()).encode(&view, &mut all).unwrap();
        let (head, mut rest) = all.split_at(peek(&all).unwrap().header_len);
        let mut pieces = vec![head.to_vec()];
        while !rest.is_empty() {
            let (slice, after) = rest.split_at(slice_len(rest).unwrap() as usize);
            pieces.push(slice.to_vec());
            rest = after;
        }
        let mut buffer = ObservationBuffer::new(&[camera()]);
        buffer.clear(seq);
        let stamps = ImageStamps { seq, pose: at(ms), ready: at(ms), ahead_ns: 0 };
        buffer.set_image(0, stamps, |_| {});
        let k = camera().intrinsics;
        let (mount, body) = (Pose::IDENTITY, Pose::IDENTITY);
        let header = ImageHeader::new(seq, 0, ServerTime::ZERO, &k, &mount, &body);
        let image = LoggedImage {
            camera: 0,
            name: "front".into(),
            header,
            pose: at(ms),
            received: at(ms),
            pieces,
        };
        let images = self.log.images(&Arc::default()).unwrap();
        images.observation(
            at(ms),
            seq,
            observation_head(buffer.as_bytes()).to_vec(),
            vec![image],
            LoggedSensors::default(),
        );
    }

    /// Writes an observation without its image, as in a reduced log.
    fn left_out(&self, seq: u64, ms: u64) {
        let mut buffer = ObservationBuffer::new(&[camera()]);
        buffer.clear(seq);
        let images = self.log.images(&Arc::default()).unwrap();
        images.observation(
            at(ms),
            seq,
            observation_head(buffer.as_bytes()).to_vec(),
            vec![],
            LoggedSensors::default(),
        );
    }

    fn answer(&self, seq: u64, ms: u64, setpoint: Option<Setpoint>) {
        let (entered, returned) = (at(ms), at(ms + 1));
        let answer = FromPlugin::Reply { seq, entered, returned, setpoint };
        self.log.from_plugin(returned, &answer);
    }

    fn close(self) -> (PathBuf, tempfile::TempDir) {
        let path = self.log.path().unwrap().to_owned();
        drop(self.log);
        (path, self.folder)
    }
}

fn plan(log: &Path) -> Result<ReplayPlan, ReplayError> {
    ReplayPlan::read(RecordedFlight::new(LogReader::open(log)?, false))
}

fn forward(x_mps: f64) -> Setpoint {
    let axes = vizflyt_protocol::messages::Axes::Heading;
    Setpoint::Velocity { v_mps: DVec3::X * x_mps, axes, yaw: YawTarget::Keep }
}

#[test]
fn feeds_answered_images_and_all_after_the_last_reply() {
    let flight = Flight::new();
    flight.start(5);
    for seq in 1..=6 {
        flight.image(seq, 10 * seq);
    }
    flight.answer(2, 22, Some(Setpoint::Hold));
    flight.answer(4, 43, None);
    let (path, _folder) = flight.close();
    let mut plan = plan(&path).unwrap();
    assert_eq!((plan.observations, plan.is_cut), (6, false));
    let mut feed = |seq: u64, all| match plan.feed(seq, at(10 * seq), all) {
        FeedAction::Skip => "skip".to_owned(),
        FeedAction::After(time, answer) => format!(
            "{} {}",
            time.as_ns() / 1_000_000,
            answer.map_or("-".into(), |answer| answer.seq.to_string())
        ),
    };
    assert_eq!(feed(1, false), "skip");
    assert_eq!(feed(2, false), "22 2");
    assert_eq!(feed(3, false), "skip");
    assert_eq!(feed(3, true), "30 -");
    assert_eq!(feed(4, false), "43 4");
    assert_eq!(feed(5, false), "50 -");
    assert_eq!(feed(2, false), "skip", "the reply is used up");
}

#[test]
fn separates_replies_of_a_restarted_plugin() {
    let flight = Flight::new();
    flight.start(5);
    flight.image(1, 10);
    flight.answer(1, 12, Some(Setpoint::Hold));
    flight.start(100);
    flight.image(1, 110);
    flight.answer(1, 112, Some(Setpoint::Land));
    let (path, _folder) = flight.close();
    let mut plan = plan(&path).unwrap();
    let mut answer = |ms| match plan.feed(1, at(ms), false) {
        FeedAction::After(_, Some(answer)) => answer.setpoint,
        other => panic!("{other:?}"),
    };
    assert_eq!((answer(10), answer(110)), (Some(Setpoint::Hold), Some(Setpoint::Land)));
}

#[test]
fn reports_why_a_log_cannot_be_replayed() {
    let check = |flight: Flight, expected: &str| {
        let (path, _folder) = flight.close();
        let error = plan(&path).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    };
    check(Flight::new(), "no images");
    let flight = Flight::new();
    flight.image(1, 10);
    check(flight, "never attached");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.mcap");
    fs::write(&path, "no log").unwrap();
    assert!(plan(&path).unwrap_err().to_string().contains("not an MCAP file"));
}

/// Writes a log of another version: metadata, and one message to the plugin with version `protocol`.
fn foreign_log(path: &Path, metadata: Option<&str>, protocol: u32) {
    let file = fs::File::create(path).unwrap();
    let mut log = mcap::WriteOptions::new().compression(None).create(file).unwrap();
    if let Some(metadata) = metadata {
        let values = [("protocol", metadata), ("program", "vizflyt 0.0.7")];
        let metadata = values.map(|(key, value)| (key.to_owned(), value.to_owned())).into();
        log.write_metadata(&mcap::records::Metadata { name: "vizflyt.flight".into(), metadata })
            .unwrap();
    }
    let body = b"of another layout".to_vec();
    let message = PluginMessage { is_to_plugin: true, protocol, body, at_ns: 5 };
    let channel = log.add_channel(0, "/plugin/messages", "protobuf", &BTreeMap::new()).unwrap();
    let header = mcap::records::MessageHeader {
        channel_id: channel,
        sequence: 0,
        log_time: 5,
        publish_time: 5,
    };
    log.write_to_known_channel(&header, &message.encode_to_vec()).unwrap();
    log.finish().unwrap();
}

#[test]
fn rejects_a_log_of_another_version_and_names_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.mcap");
    let ours = u32::from(PROTOCOL_VERSION);
    for (metadata, protocol, expected) in [
        (Some("3"), ours, "of protocol 3, written by vizflyt 0.0.7, and this program"),
        (Some("3"), 3, "of protocol 3, written by vizflyt 0.0.7, and this program"),
        (None, 3, "of protocol 3, written by an unknown program"),
        // With invalid metadata, the version of the messages counts.
        (Some("x"), 70_000, "of protocol 70000, written by vizflyt 0.0.7"),
        (Some("x"), ours, "the log has no images"),
    ] {
        foreign_log(&path, metadata, protocol);
        let error = plan(&path).unwrap_err().to_string();
        assert!(error.contains(expected), "{metadata:?}, {protocol}: {error}");
    }
}

/// Returns the command of the example plugin.
fn misbehave(how: &str) -> Vec<OsString> {
    let test = std::env::current_exe().unwrap();
    let program = test.ancestors().nth(2).unwrap().join("examples/misbehave");
    assert!(program.exists(), "run `cargo build --examples` first (tests/run does)");
    vec![program.into(), how.into()]
}

fn replay_to(log: &Path, command: Vec<OsString>, answers: &str) -> (ReplayReport, Vec<String>) {
    replay_with(log, command, PluginLimits::default(), answers)
}

fn replay_with(
    log: &Path,
    command: Vec<OsString>,
    limits: PluginLimits,
    answers: &str,
) -> (ReplayReport, Vec<String>) {
    let options = ReplayOptions {
        command,
        limits,
        is_realtime: false,
        all: false,
        answer_within: Duration::from_secs(5),
        answers: log.with_extension(answers),
    };
    let mut lines = Vec::new();
    let line = &mut |_: Stream, text: &str| lines.push(text.to_owned());
    let report = replay(log, plan(log).unwrap(), &options, line).unwrap();
    (report, lines)
}

#[test]
fn passes_the_map_to_the_replayed_plugin() {
    let flight = Flight::new();
    flight.start(5);
    flight.image(1, 10);
    flight.answer(1, 12, None);
    let (path, folder) = flight.close();
    let map = folder.path().join("map.json");
    let text = r#"[{"sphere":{"center_m":[1,2,3],"radius_m":0.5}}]"#;
    fs::write(&map, text).unwrap();
    let mut limits = PluginLimits::default();
    limits.hand_map_file(&map).unwrap();
    let look = ["sh", "-c", "echo \"map: $VIZFLYT_MAP\""].map(OsString::from).to_vec();
    let (_, lines) = replay_with(&path, look.clone(), limits, "with");
    assert!(lines.contains(&format!("map: {text}")), "{lines:?}");
    let (_, lines) = replay_to(&path, look, "without");
    assert!(lines.contains(&"map: ".to_owned()), "{lines:?}");
    let error = PluginLimits::default().hand_map_file(&path).unwrap_err().to_string();
    assert!(error.contains(&*path.to_string_lossy()), "{error}");
}

#[test]
fn finds_where_another_plugin_replies_differently() {
    let forward_plugin = misbehave("forward");
    let flight = Flight::new();
    flight.start(5);
    flight.event(6);
    for seq in 1..=40 {
        flight.image(seq, 10 * seq);
        // One reply of the flight differs.
        let x_mps = if seq == 30 { 0.25 } else { 0.5 };
        if seq % 3 != 0 || seq == 30 {
            flight.answer(seq, 10 * seq + 2, Some(forward(x_mps)));
        }
    }
    let (path, _folder) = flight.close();
    let (report, lines) = replay_to(&path, forward_plugin.clone(), "one");
    assert_eq!(report.plugin_failed, None, "{lines:?}");
    assert_eq!((report.images_logged, report.images_fed, report.compared), (40, 28, 28));
    assert_eq!(report.differ, 1);
    let first = report.first.unwrap();
    assert_eq!((first.image, first.difference.amount), (30, 0.25));
    assert_eq!(first.difference.field, "velocity.v_mps.0");
    assert!(lines.iter().any(|line| line.contains("flying in")), "{lines:?}");
    replay_to(&path, forward_plugin, "two");
    let read = |name| fs::read(path.with_extension(name)).unwrap();
    assert_eq!(read("one"), read("two"), "byte by byte");
    assert_eq!(String::from_utf8(read("one")).unwrap().lines().count(), 28);
    let (report, _) = replay_to(&path, misbehave("hover"), "three");
    assert_eq!((report.compared, report.differ), (28, 28));
    assert_eq!(report.largest.unwrap().difference.amount, f64::INFINITY);
}

#[test]
fn replays_the_images_in_a_reduced_log() {
    let flight = Flight::new();
    flight.start(5);
    flight.event(6);
    for seq in 1..=40 {
        if seq % 4 == 1 {
            flight.image(seq, 10 * seq);
        } else {
            flight.left_out(seq, 10 * seq);
        }
        flight.answer(seq, 10 * seq + 2, Some(forward(0.5)));
    }
    let (path, _folder) = flight.close();
    assert_eq!(plan(&path).unwrap().without_images, 30);
    let (report, lines) = replay_to(&path, misbehave("forward"), "reduced");
    assert_eq!(report.plugin_failed, None, "{lines:?}");
    assert_eq!((report.images_logged, report.images_left_out), (40, 30));
    assert_eq!((report.images_fed, report.compared, report.differ), (10, 10, 0));
    assert_eq!(report.images_missing, 0, "omitted images are not missing");
    // A log with only omitted images is rejected.
    let flight = Flight::new();
    flight.start(5);
    flight.left_out(1, 10);
    let (path, _folder) = flight.close();
    assert!(plan(&path).unwrap_err().to_string().contains("no images"));
}

#[test]
fn ends_the_replay_with_the_reason_if_the_plugin_fails() {
    let flight = Flight::new();
    flight.start(5);
    flight.event(6);
    for seq in 1..=5 {
        flight.image(seq, 10 * seq);
    }
    let (path, _folder) = flight.close();
    let (report, _) = replay_to(&path, misbehave("panic"), "answers");
    let why = report.plugin_failed.unwrap();
    assert!(why.contains("out of range"), "{why}");
    assert_eq!(report.images_fed, 0);
}

#[test]
fn does_not_feed_an_invalid_head() {
    let flight = Flight::new();
    flight.start(5);
    flight.image(1, 10);
    let (path, _folder) = flight.close();
    let bytes = fs::read(&path).unwrap();
    let mut flight = RecordedFlight::new(LogReader::new(Cursor::new(bytes)).unwrap(), true);
    let observation = std::iter::from_fn(|| flight.next().unwrap())
        .find_map(|recorded| match recorded {
            Recorded::Observation(observation) => Some(observation),
            _ => None,
        })
        .unwrap();
    feeder::tests::check(&observation);
}

#[test]
fn restores_readings_bit_by_bit() {
    use vizflyt_protocol::packet::ObservationHeader;
    use vizflyt_protocol::sensor::{
        LidarPoint, RangeReading, ReadingHeader, SensorInfo, SensorKind,
    };
    use zerocopy::IntoBytes;

    let sensors =
        [("top", SensorKind::Lidar), ("down", SensorKind::Sonar)].map(|(name, kind)| SensorInfo {
            name: bounded(name),
            kind,
            enabled: true,
            to_autopilot: false,
            rate_hz: 10.0,
            min_range_m: 0.1,
            max_range_m: 10.0,
            horizontal_fov_rad: 0.1,
            vertical_fov_rad: 0.1,
            most_records: 40,
            body_from_sensor: Pose::IDENTITY,
        });
    let reading = |sensor: usize, ms: u64, records: &[u8]| {
        let kind = sensors[sensor].kind;
        let count = (records.len() / kind.record_len()) as u32;
        let (of, stamp) = ((sensor as u8, kind), ServerTime::from_ns(ms));
        let header = ReadingHeader::new(ms, of, stamp, &Pose::IDENTITY, &Pose::IDENTITY, count);
        let records = records.to_vec();
        Some(Arc::new(crate::stream::Reading {
            header,
            pose: at(ms),
            shown: at(ms),
            received: at(ms),
            records,
        }))
    };
    let flight = Flight::new();
    let mut shown = Vec::new();
    for seq in 1..=4_u64 {
        let mut buffer = ObservationBuffer::with_sensors(&[], &sensors);
        buffer.clear(seq);
        // A new scan every other time.
        let scan = seq.div_ceil(2);
        let points = [LidarPoint { p_m: [scan as f32; 3], ring: 3, ..LidarPoint::default() }; 33];
        let range = RangeReading { range_m: seq as f32, signal: 0.5 };
        let mut readings = crate::stream::NewestReadings::default();
        readings[0] = reading(0, scan, points[..10 + scan as usize].as_bytes());
        readings[1] = reading(1, 100 + seq, range.as_bytes());
        let given: Vec<_> =
            readings.iter().map(|one| one.as_ref().map(|one| one.given(true))).collect();
        buffer.set_readings(&given);
        let bytes = buffer.as_bytes();
        let logged = LoggedSensors::of(bytes, &sensors, &readings);
        let images = flight.log.images(&Arc::default()).unwrap();
        images.observation(at(seq), seq, observation_head(bytes).to_vec(), vec![], logged);
        shown.push(bytes.to_vec());
    }
    let (path, _folder) = flight.close();
    let mut recorded = RecordedFlight::new(LogReader::open(&path).unwrap(), true);
    let mut seen = 0;
    while let Some(next) = recorded.next().unwrap() {
        let crate::log::read::Recorded::Observation(observation) = next else { continue };
        let len = feeder::observation_len(&observation.head).unwrap();
        let mut blocks = vec![0_u64; len.div_ceil(8)];
        let memory = &mut blocks.as_mut_bytes()[..len];
        feeder::decode(&observation, memory, &mut std::collections::HashMap::new()).unwrap();
        let was = &shown[seen];
        let (found, expected) = (&*memory, &was[..len]);
        let header = ObservationHeader::parse(found).unwrap();
        assert_eq!(header.sensors(found), ObservationHeader::parse(was).unwrap().sensors(was));
        for sensor in header.sensors(found) {
            assert_eq!(sensor.records(found), sensor.records(expected));
            assert!(sensor.records(found).is_some());
        }
        seen += 1;
        // Any changed byte of the table is handled without a panic and without a write outside.
        for place in 0..observation.sensors.len() {
            let mut other = observation.clone();
            other.sensors[place] ^= 0x55;
            let _ = feeder::decode(&other, memory, &mut std::collections::HashMap::new());
        }
    }
    assert_eq!(seen, 4);
    let found = std::fs::read(&path).unwrap();
    let scans = mcap::MessageStream::new(&found)
        .unwrap()
        .filter(|message| message.as_ref().is_ok_and(|one| one.channel.topic == "/sensor/top"));
    assert_eq!(scans.count(), 2, "each scan once");
}
