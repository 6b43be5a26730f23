use super::*;
use crate::poses::drivers::lost_poses;
use crate::poses::settings::Driver;
use proptest::prelude::*;
use vizflyt_arena::pose::Rejected;

fn stream(settings: &str) -> JsonStream {
    let config = LocalizationConfig::parse(&format!("json:127.0.0.1:0,{settings}")).unwrap();
    JsonStream::new(&config, 3, &["vizflyt", "wasp"])
}

fn at(ms: u64) -> ServerTime {
    ServerTime::from_ns(1_000_000_000 + ms * 1_000_000)
}

fn packet(more: &str) -> String {
    format!(
        r#"{{"vizflyt_pose":1,"object":"vizflyt","position_m":[1,2,3],"rotation_xyzw":[0,0,0,1]{more}}}"#
    )
}

/// Returns the only measurement of a packet.
fn only(stream: &mut JsonStream, now: ServerTime, text: &str) -> Option<Measurement> {
    let measured = stream.handle_packet(now, text.as_bytes());
    assert!(measured.len() <= 1);
    measured.first().copied()
}

#[test]
fn reports_each_note_of_a_sender_once() {
    let mut stream = stream("");
    let mut told = Vec::new();
    let mut send = |ms, notes: &str| {
        only(&mut stream, at(ms), &packet(&format!(r#","notes":{notes}"#))).unwrap();
        told.extend(std::iter::from_fn(|| stream.next_warning()).map(|text| (ms, text)));
    };
    let moved = |cm| format!("left camera moved by {cm} cm: survey again");
    for i in 0..100 {
        let moved = moved(f64::from(i as u32) / 10.0);
        send(
            i * 20,
            &if i < 50 {
                format!(r#"["{moved}"]"#)
            } else {
                format!(r#"["{moved}","dark\u0007"]"#)
            },
        );
    }
    // After a minute of absence it is reported again; a flood is limited.
    send(62_000, &format!(r#"["{}"]"#, moved(9.0)));
    for (i, word) in ["a", "b", "c", "d"].iter().enumerate() {
        send(62_010 + i as u64, &format!(r#"["{}"]"#, word.repeat(500)));
    }
    let [(0, first), (1000, dark), (62_000, again)] = &told[..] else { panic!("{told:?}") };
    assert_eq!(first, "vizflyt: left camera moved by 0 cm: survey again");
    assert_eq!(dark, "vizflyt: dark");
    assert_eq!(again, "vizflyt: left camera moved by 9 cm: survey again");
}

#[test]
fn parses_the_packet_of_the_guide() {
    let text = r#"{"vizflyt_pose":1,"object":"wasp","seq":12,"stamp_ns":1000000000,"clock":"server",
        "position_m":[1.0,2.0,0.5],"rotation_xyzw":[0,0,0.7071,0.7071],"position_sigma_m":[0.1,0.2,0.3],
        "rotation_sigma_rad":[0.01,0.02,0.03],"quality":{"tags":3,"cameras":2,"rms_px":0.21,"image_ms":4.2}}"#;
    let found = only(&mut stream(""), at(7), text).unwrap();
    assert_eq!((found.vehicle, found.source), (1, 3));
    assert_eq!((found.stamp, found.arrival), (at(0), at(7)));
    assert_eq!(found.world_from_body.translation_m, DVec3::new(1.0, 2.0, 0.5));
    assert!((found.world_from_body.rotate(DVec3::X) - DVec3::Y).length() < 1e-9);
    let sigma = found.sigma.unwrap();
    assert_eq!(sigma.position_m, DVec3::new(0.1, 0.2, 0.3));
    assert_eq!(sigma.rotation_rad, DVec3::new(0.01, 0.02, 0.03));
}

#[test]
fn subtracts_a_constant_delay_from_the_stamp() {
    let found = only(&mut stream("latency_ms=100"), at(250), &packet("")).unwrap();
    assert_eq!((found.stamp, found.arrival), (at(150), at(250)));
    for wrong in ["-1", "501", "nan"] {
        let error = LocalizationConfig::parse(&format!("json,latency_ms={wrong}")).unwrap_err();
        assert!(error.contains("latency_ms"), "{error}");
    }
}

#[test]
fn sigmas_turn_with_the_axes() {
    let text = packet(r#","position_sigma_m":[1,2,3],"rotation_sigma_rad":[0.1,0.2,0.3]"#);
    let found = only(&mut stream("up=y,units=mm,nose=y"), at(0), &text).unwrap();
    // World x, y, z are the stream's x, -z, y; the body's x is the object's y after that.
    assert!((found.world_from_body.translation_m - DVec3::new(1e-3, -3e-3, 2e-3)).length() < 1e-12);
    let sigma = found.sigma.unwrap();
    assert!((sigma.position_m - DVec3::new(1e-3, 3e-3, 2e-3)).length() < 1e-12, "{sigma:?}");
    assert!((sigma.rotation_rad - DVec3::new(0.3, 0.1, 0.2)).length() < 1e-12, "{sigma:?}");
}

#[test]
fn reports_invalid_packets_once_and_counts_them() {
    for (text, expected) in [
        ("hello".to_owned(), "is not a pose packet"),
        (packet("").replace("pose\":1", "pose\":2"), "vizflyt_pose is 2, this server knows 1"),
        (packet("").replace("[1,2,3]", "[1,2,1e300]"), "absurdly large"),
        (packet("").replace("[0,0,0,1]", "[0,0,0,0]"), "is not of unit length"),
        (packet("").replace("[0,0,0,1]", "[0,0,1]"), "is not a pose packet"),
        (
            packet(r#","position_sigma_m":[0,1,1],"rotation_sigma_rad":[1,1,1]"#),
            "give positive numbers",
        ),
        (packet(r#","clock":"mine""#), "unknown variant `mine`"),
    ] {
        let mut stream = stream("");
        assert_eq!(only(&mut stream, at(0), &text), None, "{text}");
        let warning = stream.next_warning().unwrap();
        assert!(warning.contains(expected), "{warning}");
        assert_eq!(only(&mut stream, at(1), &text), None);
        assert_eq!((stream.next_warning(), stream.counters(0).bad_packets), (None, 2));
    }
}

#[test]
fn warns_of_other_names_and_clocks() {
    let mut s = stream("objects.vizflyt=drone");
    assert_eq!(only(&mut s, at(0), &packet("")), None);
    assert_eq!(
        s.next_warning().unwrap(),
        "json: object 'vizflyt' streams, but 'drone', 'wasp' was asked for; correct `object` in \
         the sender, or start the server with --vehicle"
    );

    let mut s = stream("");
    let text = packet(r#","stamp_ns":1,"clock":"server""#);
    let found = only(&mut s, ServerTime::from_ns(77_000_000_000), &text).unwrap();
    assert_eq!(found.stamp, found.arrival);
    assert!(s.next_warning().unwrap().contains("leave `clock` out"));

    let mut s = stream("");
    let mut warnings = Vec::new();
    for ms in 0..2000u64 {
        let jump_ns = if ms < 1000 { 0 } else { 500_000_000 };
        let text = packet(&format!(r#","stamp_ns":{}"#, 5 + ms * 1_000_000 + jump_ns));
        let found = only(&mut s, at(ms), &text).unwrap();
        assert_eq!(found.stamp, at(ms));
        warnings.extend(s.next_warning());
    }
    assert_eq!(warnings.len(), 1);
    assert!(warnings[0].contains("has jumped by 0.500 s"), "{warnings:?}");

    // Kilometres: probably millimetres.
    let mut s = stream("");
    let text = packet("").replace("[1,2,3]", "[1200,2,3]");
    assert!(only(&mut s, at(0), &text).is_some());
    assert!(s.next_warning().unwrap().contains("are these millimetres? set `units`"));
}

#[test]
fn drops_repeated_poses_and_reports_a_frozen_stream() {
    let mut s = stream("");
    assert!(only(&mut s, at(0), &packet(r#","seq":5"#)).is_some());
    for ms in 1..1500 {
        assert!(only(&mut s, at(ms), &packet(r#","seq":5"#)).is_none());
    }
    assert!(only(&mut s, at(2000), &packet(r#","seq":7"#)).is_some());
    let counters = s.counters(0);
    assert_eq!((counters.stale_packets, counters.lost_frames, counters.poses), (1499, 1, 2));
    let warning = s.next_warning().unwrap();
    assert!(warning.contains("streams frame 5 again and again"), "{warning}");
    assert_eq!(s.next_warning(), None);
}

proptest! {
    #[test]
    fn any_bytes_parse_or_fail_cleanly(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        for found in stream("").handle_packet(at(0), &bytes) {
            prop_assert!(found.world_from_body.is_valid());
        }
    }

    #[test]
    fn reads_back_written_packets(p in prop::array::uniform3(-50.0..50.0f64), q in prop::array::uniform4(-1.0..1.0f64), seq in any::<u32>()) {
        prop_assume!(q.iter().map(|v| v * v).sum::<f64>() > 1e-2);
        let q = DQuat::from_array(q).normalize();
        let text = serde_json::json!({"vizflyt_pose": 1, "object": "wasp", "seq": seq, "position_m": p, "rotation_xyzw": q.to_array()}).to_string();
        let found = only(&mut stream(""), at(0), &text).unwrap();
        prop_assert!((found.world_from_body.translation_m - DVec3::from(p)).length() < 1e-9);
        prop_assert!(found.world_from_body.rotation.dot(q).abs() > 1.0 - 1e-9);
    }

    /// After a change of any byte, all resulting poses are valid.
    #[test]
    fn returned_poses_are_valid(index in 0usize..90, value in any::<u8>()) {
        let mut bytes = packet(r#","seq":5,"stamp_ns":77"#).into_bytes();
        bytes[index] = value;
        for found in stream("").handle_packet(at(0), &bytes) {
            prop_assert!(found.world_from_body.is_valid());
        }
    }
}

#[test]
fn reports_the_tags_of_a_pose_and_the_view() {
    let mut stream = stream("");
    let from = "192.168.1.7:4000".parse().unwrap();
    let mut quality_of = |ms: u64, quality: &str| {
        let text = packet(&format!(r#","quality":{quality}"#));
        assert_eq!(stream.handle_packet_from(at(ms), from, text.as_bytes()).len(), 1, "{quality}");
        stream.counters(0).tags
    };
    let seen = r#"{"tags":3,"cameras":2,"rms_px":0.25,"image_ms":1.5,"view_port":8091}"#;
    let seen = quality_of(10, seen).expect("tags are reported");
    assert_eq!((seen.tags, seen.cameras, seen.rms_px), (3, 2, 0.25));
    assert_eq!(seen.view, Some("192.168.1.7:8091".parse().unwrap()));
    // A sender cannot choose another address for the link.
    let seen = r#"{"tags":1,"cameras":1,"rms_px":0.2,"image_ms":1,"view":"10.0.0.1:80"}"#;
    assert_eq!(quality_of(20, seen).expect("tags are reported").view, None);
    // An unknown `quality` of another program does not invalidate the pose.
    assert_eq!(quality_of(30, r#""good""#), None);
}

fn hovering(index: u32, p_m: DVec3) -> Vec<u8> {
    let stamp_ns = u64::from(index) * 20_000_000;
    let more = format!(r#","seq":{index},"stamp_ns":{stamp_ns}"#);
    packet(&more).replace("[1,2,3]", &format!("{:?}", p_m.to_array())).into_bytes()
}

#[test]
fn poses_of_a_hidden_object_are_missing() {
    let reason = |origin| lost_poses::reason_of(origin, &mut stream(""), hovering);
    assert!(matches!(reason(false), Some(Rejected::Repeated(_))));
    assert_eq!(reason(true), Some(Rejected::NotVisible));
    // The origin is the sender's, wherever it is in the room.
    let mut config = LocalizationConfig::new(Driver::Json);
    config.offset.position_m = DVec3::new(1.0, 2.0, 0.0);
    let moved = &mut JsonStream::new(&config, 0, &["vizflyt"]);
    assert_eq!(lost_poses::reason_of(true, moved, hovering), Some(Rejected::NotVisible));
}

#[test]
fn stream_of_a_vehicle_has_one_sender() {
    lost_poses::check_second_sender(&mut stream(""), hovering);
}

#[test]
fn counts_poses_that_are_marked_as_not_tracked() {
    let mut s = stream("");
    assert!(only(&mut s, at(0), &packet(r#","tracked":true"#)).is_some());
    assert_eq!(only(&mut s, at(10), &packet(r#","tracked":false"#)), None);
    assert_eq!((s.counters(0).occluded, s.next_warning()), (1, None));
}

#[test]
fn names_the_unit_of_stamps() {
    for (unit, ns) in [("seconds", 1e9), ("milliseconds", 1e6), ("microseconds", 1e3)] {
        for start_s in [0.0, 1.8e9] {
            let mut s = stream("");
            let mut warnings = Vec::new();
            for index in 0..1000 {
                let sent = (start_s + 0.01 * f64::from(index)) * 1e9 / ns;
                let text = packet(&format!(r#","stamp_ns":{}"#, sent as u64));
                let now = at(10 * index as u64);
                let found = only(&mut s, now, &text).unwrap();
                assert!(index < 200 || found.stamp == now, "{unit} at {index}");
                warnings.extend(std::iter::from_fn(|| s.next_warning()));
            }
            let [warning] = &warnings[..] else { panic!("{unit}: {warnings:?}") };
            assert!(warning.contains(&format!("is in {unit}")), "{warning}");
        }
        // The server's clock.
        let mut s = stream("");
        let stamp = (at(0).as_ns() as f64 + 4e9) / ns;
        let text = packet(&format!(r#","stamp_ns":{stamp:.0},"clock":"server""#));
        only(&mut s, at(4000), &text).unwrap();
        let warning = s.next_warning().unwrap();
        assert!(warning.contains(&format!("is in {unit}")), "{warning}");
    }
    for (stamp, unit) in
        [("1764358.25", "seconds"), ("1.7643e15", "microseconds"), ("1.7643e18", "a point")]
    {
        let mut s = stream("");
        assert_eq!(only(&mut s, at(0), &packet(&format!(r#","stamp_ns":{stamp}"#))), None);
        let warning = s.next_warning().unwrap();
        assert!(warning.contains("looks like") && warning.contains(unit), "{warning}");
    }
}
