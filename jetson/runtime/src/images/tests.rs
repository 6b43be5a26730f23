//! Tests from simulated arrivals of images to the memory that a plugin reads.

use super::*;
use crate::stream::Ticket;
use vizflyt_protocol::geometry::{Intrinsics, Pose};
use vizflyt_protocol::messages::Name;
use vizflyt_protocol::packet::{ImageHeader, ImageTrailer};
use vizflyt_protocol::time::ServerTime;
use vizflyt_rgbd::{EncodeOptions, Encoder, RgbdView, peek, slice_len};
use vizflyt_sdk::Observation;
use vizflyt_sdk::glam::{DQuat, DVec3};
use vizflyt_sdk::ipc::PluginEnd;

fn camera(name: &str) -> CameraInfo {
    CameraInfo::forward(name, Intrinsics::from_horizontal_fov(32, 24, 1.5))
}

struct TestImage {
    header: ImageHeader,
    payload: Vec<u8>,
    pose: HostTime,
    session: u64,
}

fn image(camera: u8, tick: u64, depth_mm: u16) -> TestImage {
    sized_image(camera, tick, depth_mm, [32, 24])
}

fn sized_image(camera: u8, tick: u64, depth_mm: u16, [width, height]: [u32; 2]) -> TestImage {
    let k = Intrinsics::from_horizontal_fov(width, height, 1.5);
    let pixels = k.pixels();
    let (rgb, depth_mm) = (vec![90; pixels * 3], vec![depth_mm; pixels]);
    let view = RgbdView { width, height, rgb: &rgb, depth_mm: &depth_mm };
    let mut payload = Vec::new();
    Encoder::new(EncodeOptions::default()).encode(&view, &mut payload).unwrap();
    // Mounted `tick` metres ahead, so that each image has another camera.
    let mount = Pose::new(DVec3::X * tick as f64, DQuat::IDENTITY);
    let world_from_body = Pose::IDENTITY;
    TestImage {
        header: ImageHeader::new(tick, camera, ServerTime::ZERO, &k, &mount, &world_from_body),
        payload,
        pose: HostTime::from_ns(1000 * tick),
        session: 1,
    }
}

/// Name, tick, depth. [m]
type Seen = (String, u64, f32);

struct Rig {
    publisher: ImagePublisher,
    plugin: PluginEnd,
    names: Vec<Name>,
    mailbox: Mailbox,
}

impl Rig {
    fn new(names: &[&str]) -> Self {
        let cameras: Vec<_> = names.iter().map(|name| camera(name)).collect();
        let len = ObservationWriter::len_for(&cameras);
        let ipc = Arc::new(RuntimeEnd::new(len));
        let plugin = PluginEnd::attach(ipc.connect().unwrap()).unwrap();
        let names = cameras.iter().map(|camera| camera.name.clone()).collect();
        let publisher = ImagePublisher::new(ipc, cameras, Arc::default());
        Self { publisher, plugin, names, mailbox: Mailbox::default() }
    }

    /// Begins the arrival of an image.
    fn open(&self, image: &TestImage) -> Option<Ticket> {
        let TestImage { header, pose, session, .. } = *image;
        self.mailbox.open(&Arrival { session, header, pose, first: pose })
    }

    /// Delivers pieces of an image; a truncated slice counts as a piece.
    fn push(&self, ticket: Ticket, image: &TestImage, pieces: std::ops::Range<usize>) {
        let mut all = Vec::new();
        let head_len = peek(&image.payload).unwrap().header_len;
        let (head, mut rest) = image.payload.split_at(head_len.min(image.payload.len()));
        all.push(head.to_vec());
        while let Some(len) = slice_len(rest) {
            let (slice, after) = rest.split_at(rest.len().min(len as usize));
            all.push(slice.to_vec());
            rest = after;
        }
        let end = pieces.end.min(all.len());
        for piece in &mut all[pieces.start..end] {
            self.mailbox.push(ticket, piece);
        }
    }

    fn end(&self, ticket: Ticket, image: &TestImage) {
        let trailer = ImageTrailer::new(0, ServerTime::ZERO, ServerTime::ZERO);
        let received = image.pose.plus_ns(500);
        self.mailbox.end(ticket, Some(Whole { trailer, received }));
    }

    /// Delivers an image; returns the published observation and the images that the plugin sees.
    fn take(&mut self, image: &TestImage) -> Option<(Published, Vec<Seen>)> {
        let ticket = self.open(image)?;
        self.push(ticket, image, 0..99);
        self.end(ticket, image);
        self.step()
    }

    /// Runs all possible steps; returns the published observation and the images that the plugin sees.
    fn step(&mut self) -> Option<(Published, Vec<Seen>)> {
        let mut notified = None;
        let notify = &mut |notice| notified = Some(notice);
        while self.publisher.step(&self.mailbox, Duration::ZERO, notify).unwrap() {}
        let sample = self.plugin.observation().unwrap();
        assert_eq!(notified.is_some(), sample.is_some(), "notified of each publication");
        let sample = sample?;
        let observation = Observation::from_bytes(sample.bytes(), &self.names).unwrap();
        let seen = observation
            .cameras()
            .map(|c| {
                (c.name.to_owned(), c.seq, c.depth_m(c.width_px - 1, c.height_px - 1).unwrap())
            })
            .collect();
        assert_eq!(observation.seq(), notified.as_ref().unwrap().seq);
        for camera in observation.cameras() {
            let (k, x_m) = (camera.intrinsics, camera.body_from_cam.translation_m.x);
            assert_eq!((k.width_px, k.height_px), (camera.width_px, camera.height_px));
            assert_eq!(x_m, camera.seq as f64, "mounting of the image");
        }
        Some((notified.unwrap(), seen))
    }
}

#[test]
fn decodes_an_image_into_the_plugins_memory() {
    let mut rig = Rig::new(&["front"]);
    let (published, seen) = rig.take(&image(0, 5, 1250)).unwrap();
    assert_eq!(seen, [("front".to_owned(), 5, 1.25)]);
    assert_eq!((published.seq, published.pose.as_ns()), (1, 5000));
    assert!(published.ready > published.received);
    assert!(rig.take(&image(0, 4, 9)).is_none(), "stale");
    assert_eq!(rig.take(&image(0, 6, 2000)).unwrap().0.seq, 2);
    let restarted = TestImage { pose: HostTime::from_ns(99_000), session: 2, ..image(0, 1, 2000) };
    assert_eq!(rig.take(&restarted).unwrap().0.seq, 3, "restarted server");
}

#[test]
fn publishes_cameras_of_a_tick_together_without_waiting_for_a_missing_one() {
    let mut rig = Rig::new(&["front", "rear"]);
    assert!(rig.take(&image(0, 1, 1000)).is_none());
    let (_, seen) = rig.take(&image(1, 1, 2000)).unwrap();
    assert_eq!(seen, [("front".to_owned(), 1, 1.0), ("rear".to_owned(), 1, 2.0)]);
    // The rear image of tick 2 is lost.
    assert!(rig.take(&image(0, 2, 1100)).is_none());
    let (_, seen) = rig.take(&image(1, 3, 2200)).unwrap();
    assert_eq!(seen, [("front".to_owned(), 2, 1.1)]);
    let (_, seen) = rig.take(&image(0, 3, 1200)).unwrap();
    assert_eq!(seen.len(), 2);
}

#[test]
fn loses_no_image_if_a_camera_changes_its_size() {
    let mut rig = Rig::new(&["front"]);
    let mut at = 0;
    // Grows beyond the allocated memory, shrinks, and grows by large factors.
    for size in [[32, 24], [640, 480], [8, 8], [32, 24], [1280, 720], [1, 1], [1920, 1080]] {
        at += 1;
        let depth_mm = 1000 + at as u16;
        let (published, seen) = rig.take(&sized_image(0, at, depth_mm, size)).unwrap();
        assert_eq!(published.seq, at, "no observation is skipped");
        assert_eq!(seen, [("front".to_owned(), at, f32::from(depth_mm) / 1000.0)]);
    }
    assert_eq!(rig.publisher.rejected, 0);
}

#[test]
fn one_camera_may_change_its_size_within_a_tick() {
    let mut rig = Rig::new(&["front", "rear"]);
    assert!(rig.take(&image(0, 1, 1000)).is_none());
    let (_, seen) = rig.take(&sized_image(1, 1, 2000, [400, 300])).unwrap();
    assert_eq!(seen, [("front".to_owned(), 1, 1.0), ("rear".to_owned(), 1, 2.0)]);
    // Both change in the next tick.
    assert!(rig.take(&sized_image(1, 2, 2100, [64, 48])).is_none());
    let (_, seen) = rig.take(&sized_image(0, 2, 1100, [500, 10])).unwrap();
    assert_eq!(seen, [("front".to_owned(), 2, 1.1), ("rear".to_owned(), 2, 2.1)]);
}

#[test]
fn waits_for_cameras_of_other_rates_only_in_their_ticks() {
    let mut rig = Rig::new(&["front", "rear"]);
    let together = |mut image: TestImage, cameras: u32| {
        image.header.together = cameras.into();
        image
    };
    // Only the front camera: published at once.
    assert_eq!(rig.take(&together(image(0, 1, 1000), 0b01)).unwrap().1.len(), 1);
    // Both; the rear one was rendered a tick before, which happens if the encoder was busy.
    assert!(rig.take(&together(image(0, 3, 1100), 0b11)).is_none());
    let (_, seen) = rig.take(&together(image(1, 2, 2000), 0b11)).unwrap();
    assert_eq!(seen, [("front".to_owned(), 3, 1.1), ("rear".to_owned(), 2, 2.0)]);
    assert_eq!(rig.publisher.rejected, 0);
}

#[test]
fn invalid_images_are_dropped() {
    let mut rig = Rig::new(&["front"]);
    assert!(rig.take(&image(3, 1, 1000)).is_none(), "invalid camera");
    let mut cut = image(0, 2, 1000);
    cut.payload.truncate(cut.payload.len() / 2);
    assert!(rig.take(&cut).is_none());
    let mut other_size = image(0, 3, 1000);
    other_size.header.width_px = 64.into();
    assert!(rig.take(&other_size).is_none());
    assert!(rig.take(&image(0, 4, 1000)).is_some());
    assert_eq!(rig.publisher.rejected, 3);
}

#[test]
fn decodes_an_image_while_it_arrives_and_publishes_it_when_complete() {
    let mut rig = Rig::new(&["front"]);
    let image = image(0, 1, 1500);
    let ticket = rig.open(&image).unwrap();
    rig.push(ticket, &image, 0..2);
    assert!(rig.step().is_none());
    assert_eq!(rig.publisher.lanes[0].decoded, 2, "the first slice is decoded already");
    rig.push(ticket, &image, 2..99);
    assert!(rig.step().is_none(), "not before it is complete");
    rig.end(ticket, &image);
    assert_eq!(rig.step().unwrap().1, [("front".to_owned(), 1, 1.5)]);
}

#[test]
fn truncated_image_is_not_published() {
    let mut rig = Rig::new(&["front", "rear"]);
    assert!(rig.take(&image(1, 1, 2000)).is_none());
    let (cut, next) = (image(0, 1, 1000), image(0, 2, 1100));
    let ticket = rig.open(&cut).unwrap();
    rig.push(ticket, &cut, 0..2);
    assert!(rig.step().is_none());
    rig.mailbox.end(ticket, None);
    assert!(rig.step().is_none());
    // The next tick publishes only the rear image, without the truncated front image.
    let (_, seen) = rig.take(&next).unwrap();
    assert_eq!(seen, [("rear".to_owned(), 1, 2.0)]);
    let (_, seen) = rig.take(&image(1, 2, 2100)).unwrap();
    assert_eq!(seen, [("front".to_owned(), 2, 1.1), ("rear".to_owned(), 2, 2.1)]);
    assert_eq!(rig.publisher.rejected, 0);
}

#[test]
fn stalled_image_does_not_delay_other_cameras_and_is_published_later() {
    let mut rig = Rig::new(&["front", "rear"]);
    let stalled = image(0, 1, 1000);
    let ticket = rig.open(&stalled).unwrap();
    rig.push(ticket, &stalled, 0..2);
    assert!(rig.take(&image(1, 1, 2000)).is_none());
    // The rear camera's next image is complete: the present observation is published.
    let (_, seen) = rig.take(&image(1, 2, 2100)).unwrap();
    assert_eq!(seen, [("rear".to_owned(), 1, 2.0)]);
    // The rest of the front image arrives late: the complete image is in the next observation.
    rig.push(ticket, &stalled, 2..99);
    rig.end(ticket, &stalled);
    let (_, seen) = rig.step().unwrap();
    assert_eq!(seen, [("front".to_owned(), 1, 1.0), ("rear".to_owned(), 2, 2.1)]);
    assert_eq!(rig.publisher.rejected, 0);
}

#[test]
fn replaced_image_is_not_mixed_with_its_successor() {
    let mut rig = Rig::new(&["front"]);
    let (old, new) = (sized_image(0, 1, 1000, [64, 96]), sized_image(0, 2, 1100, [64, 96]));
    let ticket = rig.open(&old).unwrap();
    rig.push(ticket, &old, 0..3);
    assert!(rig.step().is_none());
    assert_eq!(rig.take(&new).unwrap().1, [("front".to_owned(), 2, 1.1)]);
    assert_eq!(rig.mailbox.replaced(), 1);
    assert!(!rig.mailbox.push(ticket, &mut vec![0]), "the receiver gets `false`");
}

#[test]
fn writes_the_pose_at_image_only_if_the_course_gives_the_pose() {
    // Numbers that occur nowhere else in an observation.
    let body =
        Pose::new(DVec3::new(12.345_678, -3.456_789, 2.345_678), DQuat::from_rotation_z(0.7));
    for gives_pose in [true, false] {
        let mut rig = Rig::new(&["front", "down"]);
        rig.publisher.senses.lock().unwrap().gives_pose = gives_pose;
        let mut arriving = image(1, 7, 2000);
        let k = Intrinsics::from_horizontal_fov(32, 24, 1.5);
        let mount = Pose::new(DVec3::new(0.1, 0.0, 0.0), DQuat::from_rotation_y(0.3));
        arriving.header = ImageHeader::new(7, 1, ServerTime::ZERO, &k, &mount, &body);
        arriving.header.together = 0b10.into();
        let ticket = rig.open(&arriving).unwrap();
        rig.push(ticket, &arriving, 0..99);
        rig.end(ticket, &arriving);
        while rig.publisher.step(&rig.mailbox, Duration::ZERO, &mut |_| ()).unwrap() {}
        let sample = rig.plugin.observation().unwrap().unwrap();
        let observation = Observation::from_bytes(sample.bytes(), &rig.names).unwrap();
        let found = observation.pose_at_image();
        assert_eq!(found, observation.camera("down").unwrap().pose_at_image);
        let bytes = sample.bytes();
        let holds = |number: f64| {
            // A tolerance, because the conversion over the camera's pose rounds.
            bytes
                .as_chunks::<8>()
                .0
                .iter()
                .any(|eight| (f64::from_le_bytes(*eight) - number).abs() < 1e-9)
        };
        assert_eq!(found.is_some(), gives_pose);
        for number in body.translation_m.to_array() {
            assert_eq!(holds(number), gives_pose, "{number}");
        }
        if let Some(pose) = found {
            assert!(pose.translation_m.distance(body.translation_m) < 1e-12);
            assert!(pose.rotation.angle_between(body.rotation) < 1e-7);
        }
    }
}

#[test]
fn publishes_the_newest_readings_with_images() {
    use vizflyt_protocol::sensor::{
        LidarPoint, RangeReading, ReadingHeader, SensorInfo, SensorKind,
    };
    use zerocopy::IntoBytes;

    let sensor = |name: &str, kind| SensorInfo {
        name: vizflyt_protocol::messages::bounded(name),
        kind,
        enabled: true,
        to_autopilot: false,
        rate_hz: 10.0,
        min_range_m: 0.1,
        max_range_m: 10.0,
        horizontal_fov_rad: 0.1,
        vertical_fov_rad: 0.1,
        most_records: 1,
        body_from_sensor: Pose::IDENTITY,
    };
    let body = Pose::new(DVec3::new(12.345_678, -3.456_789, 2.345_678), DQuat::IDENTITY);
    let reading = |sensor: u8, kind: SensorKind, seq: u64, records: &[u8]| {
        let count = (records.len() / kind.record_len()) as u32;
        let stamp = ServerTime::from_ns(seq);
        let header = ReadingHeader::new(seq, (sensor, kind), stamp, &Pose::IDENTITY, &body, count);
        let at = HostTime::from_ns(seq);
        let records = records.to_vec();
        crate::stream::Reading { header, pose: at, shown: at, received: at, records }
    };
    let mut rig = Rig::new(&["front"]);
    let plain_len = rig.take(&image(0, 1, 900)).map(|_| rig.publisher.observation_len()).unwrap();
    assert_eq!(plain_len, ObservationWriter::len_for(&[camera("front")]), "no extra bytes");
    let readings: Arc<Readings> = Arc::default();
    let sensors = vec![sensor("top", SensorKind::Lidar), sensor("down", SensorKind::RangeFinder)];
    rig.publisher = rig.publisher.with_sensors(sensors, Arc::clone(&readings));
    let mut see = |tick: u64, gives_pose: bool| {
        rig.publisher.senses.lock().unwrap().gives_pose = gives_pose;
        let arriving = image(0, tick, 900);
        let ticket = rig.open(&arriving).unwrap();
        rig.push(ticket, &arriving, 0..99);
        rig.end(ticket, &arriving);
        while rig.publisher.step(&rig.mailbox, Duration::ZERO, &mut |_| ()).unwrap() {}
        let sample = rig.plugin.observation().unwrap().unwrap();
        let observation = Observation::from_bytes(sample.bytes(), &rig.names).unwrap();
        assert_eq!(observation.camera("front").unwrap().seq, tick);
        let top = observation.sensor("top").map(|top| (top.seq, top.points().len()));
        let down = observation.sensor("down").map(|down| {
            (down.seq, down.range_m(), down.pose_at_reading.map(|pose| pose.translation_m))
        });
        (top, down)
    };
    assert_eq!(see(2, true), (None, None), "no reading yet");
    let range = RangeReading { range_m: 1.5, signal: 1.0 };
    readings.put(reading(1, SensorKind::RangeFinder, 5, range.as_bytes()));
    assert_eq!(see(3, true), (None, Some((5, Some(1.5), Some(body.translation_m)))));
    assert_eq!(
        see(4, false),
        (None, Some((5, Some(1.5), None))),
        "the same reading; the pose is withheld"
    );
    // A scan with more points than announced.
    let points = [LidarPoint::default(); 500];
    readings.put(reading(0, SensorKind::Lidar, 6, points.as_bytes()));
    readings.put(reading(1, SensorKind::RangeFinder, 7, RangeReading::default().as_bytes()));
    assert_eq!(see(5, true), (Some((6, 500)), Some((7, None, Some(body.translation_m)))));
    // A reading of another kind than the sensor's: only this reading is missing.
    readings.put(reading(1, SensorKind::Lidar, 8, points.as_bytes()));
    assert_eq!(see(6, true), (Some((6, 500)), None));
}
