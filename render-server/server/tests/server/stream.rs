//! The real binary, a Vicon emitter and a runtime's client over loopback.

use std::sync::atomic::Ordering;

use crate::support::{
    Client, Emitter, HEIGHT_M, PATIENCE, STEP_M, Server, connect, hello, send_json, write_arena,
};
use quinn::{TransportConfig, VarInt};
use vizflyt_protocol::PROTOCOL_VERSION;
use vizflyt_protocol::messages::{
    ClockRequest, Event, EventKind, FlightPhase, Hello, Purpose, ReceivedEvents, Telemetry,
    ToRuntime, ToServer, bounded,
};
use vizflyt_protocol::packet::{ImageHeader, Preamble};
use vizflyt_protocol::time::HostTime;
use vizflyt_rgbd::{Decoder, peek};

fn usual() -> TransportConfig {
    TransportConfig::default()
}

/// Images are predicted up to 0.2 s ahead, at up to 200 frames per second.
const AHEAD_FRAMES: f64 = 40.0;

#[tokio::test]
async fn images_follow_the_poses() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let emitter = Emitter::start(server.vicon, "vizflyt");
    let (mut client, arena) = Client::welcomed(&server, usual()).await;
    assert_eq!((arena.name.as_str(), arena.cameras.len()), ("wall", 1));

    let (mut seq, mut pose_ns) = (0, 0);
    for _ in 0..20 {
        let (header, payload, trailer) = client.whole_image().await;
        // Streams may finish out of order, but the stamps within an image never do.
        assert!(header.exposure_stamp() > header.pose_stamp(), "the exposure is predicted");
        let stamps = [header.pose_ns, header.render_start_ns, header.render_end_ns]
            .map(zerocopy::byteorder::little_endian::U64::get);
        assert!(stamps.is_sorted(), "{stamps:?}");
        // The first byte may be sent before or after the last is encoded.
        let ends = [trailer.send_ns.get(), trailer.encode_end_ns.get()];
        assert!(ends.iter().all(|&end| end >= stamps[2]), "{stamps:?} {ends:?}");
        assert!(header.seq.get() > seq || header.pose_ns.get() < pose_ns);
        (seq, pose_ns) = (header.seq.get(), header.pose_ns.get());
        // Rendered from the vehicle's pose, through the camera's extrinsics.
        let p = header.world_from_cam().translation_m;
        let frame = (0.06 - p.x) / STEP_M;
        let sent = f64::from(emitter.sent.load(Ordering::Relaxed));
        assert!((-1.0..=sent + AHEAD_FRAMES).contains(&frame), "x = {}", p.x);
        assert!(p.y.abs() < 1e-3 && (p.z - HEIGHT_M - 0.02).abs() < 1e-3, "{p}");
        // The wall has the right depth: camera z of its centre.
        let info = peek(&payload).unwrap();
        assert_eq!((info.width, info.height), (160, 120));
        let (mut rgb, mut depth_mm) = (vec![0; 160 * 120 * 3], vec![0u16; 160 * 120]);
        Decoder::new().decode(&payload, &mut rgb, &mut depth_mm).unwrap();
        let middle = 60 * 160 + 80;
        let expected_mm = (5.0 - p.x) * 1e3;
        assert!((f64::from(depth_mm[middle]) - expected_mm).abs() < 40.0, "{}", depth_mm[middle]);
        assert!(rgb[middle * 3] > 200, "the wall is red");
    }

    let sent = HostTime::from_ns(77);
    client.send(&ToServer::Clock(ClockRequest { sent })).await;
    let reply = client
        .until(|message| match message {
            ToRuntime::Clock(reply) => Some(reply),
            _ => None,
        })
        .await;
    assert_eq!(reply.sent, sent);
    assert!(reply.answered.as_ns() > pose_ns);
    let mut last_ns = 0;
    for _ in 0..20 {
        let pose = client.pose().await;
        assert!(pose.stamp.as_ns() > last_ns);
        last_ns = pose.stamp.as_ns();
    }
    client.close().await;
    let report = server.finish();
    assert!(report["images_sent"].as_u64().unwrap() >= 20, "{report}");
    assert!(report["render_ms_p50"].as_f64().unwrap() > 0.0);
    assert!(report["peak_rss_mb"].as_f64().unwrap() > 1.0);
    assert!(!report["renderer"].as_str().unwrap().is_empty());
}

#[tokio::test]
async fn rejects_unsupported_clients_with_a_reason() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let refusal = |message| match message {
        ToRuntime::Refused(text) => Some(text),
        _ => None,
    };

    // Another protocol version.
    let connection = connect(&server, usual()).await.unwrap();
    let (mut send, mut recv) = connection.open_bi().await.unwrap();
    send.write_all(b"VZFL\x63\x00\x02\x00").await.unwrap();
    let mut theirs = [0; Preamble::SIZE];
    recv.read_exact(&mut theirs).await.unwrap();
    assert_eq!(&theirs[..4], b"VZFL");
    let closed = tokio::time::timeout(PATIENCE, connection.closed()).await.unwrap().to_string();
    assert!(
        closed.contains(&format!(
            "runtime speaks protocol 99, this server {PROTOCOL_VERSION}: update the server"
        )),
        "{closed}"
    );

    // Another protocol.
    let connection = connect(&server, usual()).await.unwrap();
    let (mut send, _recv) = connection.open_bi().await.unwrap();
    send.write_all(b"GET / HT").await.unwrap();
    let closed = tokio::time::timeout(PATIENCE, connection.closed()).await.unwrap().to_string();
    assert!(closed.contains("does not speak VizFlyt"), "{closed}");

    // Another vehicle.
    let mut other = Client::hello(&server, "wasp", usual()).await;
    let text = other.until(refusal).await;
    assert!(text.starts_with("no vehicle 'wasp' here, only 'vizflyt'"), "{text}");

    // A second runtime while the first is alive.
    let (mut first, _) = Client::welcomed(&server, usual()).await;
    let mut second = Client::hello(&server, "vizflyt", usual()).await;
    // The first keeps reporting, so that it stays alive on a loaded machine.
    first.send(&ToServer::Telemetry(Telemetry::default())).await;
    let text = second.until(refusal).await;
    assert!(text.starts_with("vehicle 'vizflyt' is flown by test 1 at 127.0.0.1:"), "{text}");

    // It can connect once the first has closed.
    first.close().await;
    loop {
        let mut again = Client::hello(&server, "vizflyt", usual()).await;
        if let ToRuntime::Welcome(_) = again.next().await {
            break;
        }
    }
}

#[tokio::test]
async fn a_stalled_runtime_delays_no_other_and_then_gets_the_newest_images() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let _emitter = Emitter::start(server.vicon, "vizflyt");
    // One stream at a time, and none accepted: images cannot leave.
    let mut transport = usual();
    transport.max_concurrent_uni_streams(VarInt::from_u32(1));
    let (client, _) = Client::welcomed(&server, transport).await;
    let mut stalled_until_ns = 0;
    for _ in 0..100 {
        stalled_until_ns = client.pose().await.stamp.as_ns();
    }
    // The first stream was filled at the start; images after it are fresh.
    let mut stream = client.connection.accept_uni().await.unwrap();
    let _ = stream.read_to_end(1 << 22).await;
    drop(stream);
    let mut headers = Vec::new();
    for _ in 0..12 {
        headers.push(client.image().await.0);
    }
    let fresh = headers.iter().filter(|h| h.pose_ns.get() > stalled_until_ns).count();
    // At most K images waited for a stream when the stall ended; one was rendered, one was being rendered.
    assert!(fresh >= 6, "{fresh} of 12 are newer than the stall");
    drop(client);
    let report = server.finish();
    assert!(report["ticks_skipped"].as_u64().unwrap() > 10, "{report}");
}

#[tokio::test]
async fn at_most_k_images_are_in_flight_until_the_deadline() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let _emitter = Emitter::start(server.vicon, "vizflyt");
    // A header fits into the window, an image never does: every image stays in flight.
    let mut transport = usual();
    transport.stream_receive_window(VarInt::from_u32(512));
    let (client, _) = Client::welcomed(&server, transport).await;
    let (mut drawn_ns, mut seen_ns) = (Vec::new(), Vec::new());
    let mut streams = Vec::new();
    while drawn_ns.len() < 8 {
        let mut stream = tokio::time::timeout(PATIENCE, client.connection.accept_uni())
            .await
            .expect("another image after the deadline of the last")
            .unwrap();
        let mut bytes = [0; ImageHeader::SIZE];
        // Reset before its header was read: counts as not seen.
        if stream.read_exact(&mut bytes).await.is_ok() {
            let (header, _) = ImageHeader::parse(&bytes).unwrap();
            drawn_ns.push(header.render_end_ns.get());
            // The same clock on the same machine.
            seen_ns.push(vizflyt_server::clock::now().as_ns());
        }
        streams.push(stream);
    }
    // K is 2 on loopback: the third image is sent only when the first is reset, 150 ms after it was sent, and therefore
    // more than that after it was rendered.
    drawn_ns.sort_unstable();
    seen_ns.sort_unstable();
    for (drawn, seen) in drawn_ns.iter().zip(&seen_ns[2..]) {
        assert!(seen - drawn >= 150_000_000, "{drawn_ns:?} {seen_ns:?}");
    }
}

#[tokio::test]
async fn a_restarted_runtime_gets_images_again() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let _emitter = Emitter::start(server.vicon, "vizflyt");
    let mut seq = 0;
    for _ in 0..3 {
        let mut client = loop {
            let mut client = Client::hello(&server, "vizflyt", usual()).await;
            // Rejected only until the server has noticed the end of the previous one.
            if matches!(client.next().await, ToRuntime::Welcome(_)) {
                break client;
            }
        };
        let (header, _) = client.image().await;
        assert!(header.seq.get() > seq);
        seq = header.seq.get();
        client.send(&ToServer::Telemetry(Telemetry::default())).await;
        client.close().await;
    }
}

#[tokio::test]
async fn a_reconnected_runtime_receives_lost_pose_events_again() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let emitter = Emitter::start(server.vicon, "vizflyt");
    let (mut client, _) = Client::welcomed(&server, usual()).await;
    client.image().await;
    let flying = Telemetry { phase: FlightPhase::Flying, ..Telemetry::default() };
    client.send(&ToServer::Telemetry(flying)).await;
    emitter.pause(true);
    let lost = |message| match message {
        ToRuntime::Event { event, .. } => {
            matches!(event.kind, EventKind::PoseLost { .. }).then_some(event)
        }
        _ => None,
    };
    let event = client.until(lost).await;
    let printed = server.line(|line| line.get("event").cloned());
    assert_eq!(printed["text"], event.text.as_str());
    // The connection is lost in flight; the next one receives the events since take-off.
    client.close().await;
    let mut again = loop {
        let mut client = Client::hello(&server, "vizflyt", usual()).await;
        if matches!(client.next().await, ToRuntime::Welcome(_)) {
            break client;
        }
    };
    assert_eq!(again.until(lost).await, event);
    emitter.pause(false);
    again
        .until(|message| match message {
            ToRuntime::Event { event, .. } => (event.kind == EventKind::PoseRegained).then_some(()),
            _ => None,
        })
        .await;
}

/// Regression test: the server repeated all events of the flight.
#[tokio::test]
async fn events_arrive_and_are_logged_once_despite_outages() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let emitter = Emitter::start(server.vicon, "vizflyt");
    let (boot, mut heard) = (4711, ReceivedEvents::default());
    let hello = |received_events| Hello { boot, received_events, ..hello("vizflyt", Purpose::Fly) };
    let event = |message| match message {
        ToRuntime::Event { seq, event } => Some((seq, event)),
        _ => None,
    };
    let note = |text: &str| Event {
        stamp: vizflyt_protocol::time::ServerTime::ZERO,
        kind: EventKind::Note,
        text: bounded(text),
    };
    let mut client = Client::greet(&server, hello(heard), usual()).await;
    let welcome = client.welcome().await;
    assert_eq!(welcome.received_events.of(boot), 0);
    client.image().await;
    let flying = Telemetry { phase: FlightPhase::Flying, ..Telemetry::default() };
    client.send(&ToServer::Telemetry(flying)).await;
    for (seq, text) in [(1, "one"), (2, "two"), (2, "two"), (1, "one")] {
        client.send(&ToServer::Event { seq, event: note(text) }).await;
    }
    client.until(|message| (message == ToRuntime::EventsReceived(2)).then_some(())).await;
    emitter.pause(true);
    let (seq, lost) = client.until(event).await;
    assert!(matches!(lost.kind, EventKind::PoseLost { .. }));
    assert!(heard.receive(welcome.boot, seq));
    client.close().await;
    emitter.pause(false);
    // Reconnected in flight: only events that were not received are sent.
    let mut client = loop {
        let mut client = Client::greet(&server, hello(heard), usual()).await;
        if let ToRuntime::Welcome(again) = client.next().await {
            assert_eq!((again.boot, again.received_events.of(boot)), (welcome.boot, 2));
            break client;
        }
    };
    let (next, back) = client.until(event).await;
    assert!(next > seq && back.kind == EventKind::PoseRegained, "{back:?}");
    client.send(&ToServer::Event { seq: 2, event: note("two") }).await;
    client.send(&ToServer::Event { seq: 3, event: note("three") }).await;
    client.until(|message| (message == ToRuntime::EventsReceived(3)).then_some(())).await;
    let page = server.http;
    let log = tokio::task::spawn_blocking(move || {
        let mut socket = crate::support::Socket::open(page, &format!("http://{page}")).unwrap();
        let mut texts = Vec::new();
        while !texts.iter().any(|text| text == "three") {
            let events = socket.message("events");
            for line in events["events"].as_array().unwrap() {
                texts.extend(line["text"].as_str().map(ToOwned::to_owned));
            }
        }
        texts
    });
    let log = log.await.unwrap();
    for text in ["one", "two", "three"] {
        assert_eq!(log.iter().filter(|found| *found == text).count(), 1, "{text}: {log:?}");
    }
}

#[tokio::test]
async fn watchers_receive_the_same_images_and_cannot_command() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &["--max-rate", "20"]);
    let _emitter = Emitter::start(server.vicon, "vizflyt");
    // A watcher receives images without a flying runtime.
    let mut watcher = Client::watching(&server, usual()).await;
    let (header, payload) = watcher.image().await;
    assert_eq!(peek(&payload).unwrap().width, header.width_px.get());
    watcher.pose().await;
    // Its telemetry is ignored, and it does not occupy the runtime's place.
    let landed = Telemetry { phase: FlightPhase::Flying, ..Telemetry::default() };
    watcher.send(&ToServer::Telemetry(landed)).await;
    let (runtime, _) = Client::welcomed(&server, usual()).await;
    // A third client that reads nothing.
    let mut transport = usual();
    transport.max_concurrent_uni_streams(VarInt::from_u32(1));
    let _stalled = Client::watching(&server, transport).await;
    let mut seen: std::collections::BTreeMap<u64, Vec<u8>> = std::collections::BTreeMap::new();
    let mut same = 0;
    for _ in 0..40 {
        let (header, payload) = runtime.image().await;
        seen.insert(header.seq.get(), payload);
        let (header, payload) = watcher.image().await;
        if let Some(first) = seen.get(&header.seq.get()) {
            assert!(*first == payload, "encoded once for both");
            same += 1;
        }
    }
    assert!(same >= 20, "{same} of 40 images went to both");
    // At most eight; the existing ones continue.
    let mut others = Vec::new();
    for _ in 2..8 {
        others.push(Client::watching(&server, usual()).await);
    }
    let mut ninth = Client::greet(&server, hello("vizflyt", Purpose::Watch), usual()).await;
    let ToRuntime::Refused(why) = ninth.next().await else { panic!("not refused") };
    assert!(why.contains("8 watchers already"), "{why}");
    runtime.image().await;
}

#[tokio::test]
async fn a_blocked_camera_does_not_delay_others() {
    let folder = tempfile::tempdir().unwrap();
    let rear = r#"priority = 5
[[cameras]]
name = "rear"
width_px = 160
height_px = 120
horizontal_fov_deg = 90.0
position_m = [0.06, 0, 0.02]
"#;
    let server = Server::start(&write_arena(folder.path(), rear), &["--max-rate", "50"]);
    let _emitter = Emitter::start(server.vicon, "vizflyt");
    // A header fits into the window, an unread image never does.
    let mut transport = usual();
    transport.stream_receive_window(VarInt::from_u32(512));
    let (client, _) = Client::welcomed(&server, transport).await;
    // Only the header of the front camera, which has the higher priority, is read.
    let (mut blocked, mut whole) = (Vec::new(), 0);
    let mut first_ns = 0;
    while whole < 40 {
        let mut stream = client.connection.accept_uni().await.unwrap();
        let mut bytes = [0; ImageHeader::SIZE];
        let Ok(()) = stream.read_exact(&mut bytes).await else { continue };
        let (header, _) = ImageHeader::parse(&bytes).unwrap();
        if header.camera == 0 {
            blocked.push(stream);
            continue;
        }
        if stream.read_to_end(1 << 22).await.is_ok() {
            whole += 1;
            if first_ns == 0 {
                first_ns = header.render_end_ns.get();
            }
        }
    }
    // Two images of the front camera are begun per 150 ms, and none is acknowledged. If the rear camera had to wait for
    // it, it would have as few.
    assert!(blocked.len() < 30, "{} images of the blocked camera", blocked.len());
    drop(client);
    let report = server.finish();
    assert!(report["images_sent"].as_u64().unwrap() >= 38, "{report}");
}

#[tokio::test]
async fn collision_with_the_twin_is_sent_to_the_runtime_and_printed() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let (mut client, _) = Client::welcomed(&server, usual()).await;
    // Half a second in place, then 1 cm per frame into the wall at x = 5 m, and stop there: even if a loaded machine
    // loses packets, the contact is seen.
    let _emitter = Emitter::along(server.vicon, "vizflyt", |frame| {
        3.0 + f64::from(frame.clamp(100, 295) - 100) * 0.01
    });
    let collision = |message| match message {
        ToRuntime::Event { event, .. } => match event.kind {
            EventKind::Collision(it) => Some((it.p_world_m, it.clearance_m)),
            _ => None,
        },
        _ => None,
    };
    let (p_world_m, clearance_m) = client.until(collision).await;
    // The body's surface, 0.12 m in front of its centre, touches the wall's front, within two voxels.
    assert!((p_world_m.x - 4.88).abs() < 0.15, "{p_world_m}");
    assert!(clearance_m <= 0.0);
    server.line(|line| line["event"]["kind"].get("collision").map(|_| ()));
}

#[tokio::test]
async fn changing_a_camera_in_flight_loses_no_image() {
    let folder = tempfile::tempdir().unwrap();
    // Slow enough that even a loaded machine renders, encodes and sends every tick.
    let server = Server::start(&write_arena(folder.path(), ""), &["--max-rate", "20"]);
    let _emitter = Emitter::start(server.vicon, "vizflyt");
    let (mut client, _) = Client::welcomed(&server, usual()).await;
    let mut images = Vec::new();
    let changes = [
        ((160, 120), 90.0, 0.0),
        ((320, 200), 60.0, 10.0),
        ((1280, 720), 60.0, 10.0),
        ((40, 30), 120.0, -5.0),
    ];
    for (change, ((width, height), fov_deg, tilt_deg)) in changes.into_iter().enumerate() {
        if change > 0 {
            let json = format!(
                r#"{{"width_px": {width}, "height_px": {height},
                     "horizontal_fov_deg": {fov_deg}, "tilt_deg": {tilt_deg}}}"#
            );
            let http = server.http;
            let patch =
                move || send_json(http, "PATCH /api/vehicles/vizflyt/cameras/front", None, &json);
            let (status, body) = tokio::task::spawn_blocking(patch).await.unwrap();
            assert_eq!(status, 200, "{body}");
            let (index, camera) = client
                .until(|message| match message {
                    ToRuntime::Camera { index, camera } => Some((index, camera)),
                    _ => None,
                })
                .await;
            assert_eq!((index, camera.intrinsics.width_px), (0, width));
        }
        let mut seen = 0;
        while seen < 8 {
            let (header, payload) = client.image().await;
            let k = header.intrinsics();
            seen += u32::from((k.width_px, k.height_px) == (width, height));
            images.push((header, payload));
        }
    }
    client.close().await;
    let report = server.finish();

    images.sort_by_key(|(header, _)| header.seq.get());
    let mut now = 0;
    for (header, payload) in &images {
        // Changes arrive in order, and each image is complete and contains its intrinsics.
        let k = header.intrinsics();
        while (k.width_px, k.height_px) != changes[now].0 {
            now += 1;
        }
        let (_, fov_deg, tilt_deg): (_, f64, f64) = changes[now];
        let f_px = f64::from(k.width_px) / 2.0 / (fov_deg / 2.0).to_radians().tan();
        assert!((k.fx_px - f_px).abs() < 1e-9, "{k:?}");
        let axis = header.body_from_cam().rotate(glam::DVec3::Z);
        assert!((axis.z - tilt_deg.to_radians().sin()).abs() < 1e-9, "{axis}");
        let pixels = k.pixels();
        let (mut rgb, mut depth_mm) = (vec![0; pixels * 3], vec![0u16; pixels]);
        Decoder::new().decode(payload, &mut rgb, &mut depth_mm).unwrap();
    }
    assert_eq!(now, changes.len() - 1);
    // Missing images were replaced by newer ones, as without a change.
    let (first, last) = (images[0].0.seq.get(), images[images.len() - 1].0.seq.get());
    let missing = last - first + 1 - images.len() as u64;
    let count = |key: &str| report[key].as_u64().unwrap();
    let gave_way = count("ticks_skipped") + count("images_late");
    assert!(missing <= gave_way, "{missing} images are missing, {gave_way} gave way: {report}");
}

#[tokio::test]
async fn every_camera_has_its_own_rate_and_near_plane() {
    let folder = tempfile::tempdir().unwrap();
    let second = r#"
[[cameras]]
name = "slow"
width_px = 64
height_px = 48
horizontal_fov_deg = 90.0
position_m = [0.06, 0, 0.02]
near_m = 20.0
rate_hz = 5.0
"#;
    let server = Server::start(&write_arena(folder.path(), second), &["--max-rate", "40"]);
    let _emitter = Emitter::start(server.vicon, "vizflyt");
    let begin = vizflyt_server::clock::now();
    let (client, arena) = Client::welcomed(&server, usual()).await;
    assert_eq!(arena.cameras.len(), 2);
    let mut stamps_ns = [Vec::new(), Vec::new()];
    while stamps_ns[1].len() < 9 {
        let (header, payload) = client.image().await;
        let camera = usize::from(header.camera);
        stamps_ns[camera].push(header.render_start_ns.get());
        assert!(header.together.get() & (1 << camera) != 0);
        if camera == 1 {
            // The wall is nearer than the near plane.
            let (mut rgb, mut depth_mm) = (vec![0; 64 * 48 * 3], vec![0u16; 64 * 48]);
            Decoder::new().decode(&payload, &mut rgb, &mut depth_mm).unwrap();
            assert!(depth_mm.iter().all(|&mm| mm == 0));
        }
    }
    // Images are never early. A busy server renders late and then catches up, so the times count from the start, not
    // between two images. The first image is due at once, and so is the second if the first was late.
    stamps_ns[1].sort_unstable();
    for (k, &ns) in stamps_ns[1].iter().enumerate().skip(1) {
        let since_begin_ms = ns.saturating_sub(begin.as_ns()) / 1_000_000;
        assert!(since_begin_ms >= 190 * (k as u64 - 1), "image {k} is early: {stamps_ns:?}");
    }
    // Images of the other camera arrive in between.
    let (first, last) = (stamps_ns[1][0], stamps_ns[1][8]);
    let between = stamps_ns[0].iter().filter(|&&ns| ns > first && ns < last).count();
    assert!(between > 4, "{stamps_ns:?}");
}

#[test]
fn a_signal_ends_the_server_with_its_report() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    server.terminate();
    let report = server.line(|line| line.get("report").cloned());
    assert_eq!(report["images_sent"], 0);
    assert!(server.wait().success());
}
