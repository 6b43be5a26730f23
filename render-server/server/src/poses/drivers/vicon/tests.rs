use super::*;
use crate::poses::drivers::lost_poses;
use crate::poses::settings::Driver;
use glam::DQuat;
use proptest::prelude::*;
use vizflyt_arena::pose::Rejected;

fn stream(vehicles: &[&str]) -> ViconStream {
    ViconStream::new(&LocalizationConfig::new(Driver::Vicon), 0, vehicles)
}

/// Encodes a packet like Tracker.
fn packet(frame: u32, objects: &[(&str, [f64; 6])]) -> Vec<u8> {
    let mut bytes = frame.to_le_bytes().to_vec();
    bytes.push(objects.len() as u8);
    for (name, values) in objects {
        bytes.push(0);
        bytes.extend_from_slice(&72u16.to_le_bytes());
        let mut field = [0u8; 24];
        field[..name.len()].copy_from_slice(name.as_bytes());
        bytes.extend_from_slice(&field);
        for value in values {
            bytes.extend_from_slice(&value.to_le_bytes());
        }
    }
    bytes
}

fn at(ms: u64) -> ServerTime {
    ServerTime::from_ns(1_000_000_000 + ms * 1_000_000)
}

/// Returns the measurement of a packet, at most one.
fn only(stream: &mut ViconStream, now: ServerTime, bytes: &[u8]) -> Option<Measurement> {
    let measured = stream.handle_packet(now, bytes);
    assert!(measured.len() <= 1, "{measured:?}");
    measured.first().copied()
}

#[test]
fn millimetres_become_metres_and_angles_a_rotation() {
    let yaw = std::f64::consts::FRAC_PI_2;
    let bytes = packet(7, &[("vizflyt", [1000.0, -2000.0, 1500.0, 0.0, 0.0, yaw])]);
    assert_eq!(bytes.len(), 5 + 75);
    let pose = only(&mut stream(&["vizflyt"]), at(0), &bytes).unwrap();
    assert_eq!(pose.world_from_body.translation_m, DVec3::new(1.0, -2.0, 1.5));
    // A quarter turn to the left: the nose points along y.
    assert!((pose.world_from_body.rotate(DVec3::X) - DVec3::Y).length() < 1e-12);
    assert_eq!((pose.stamp, pose.arrival), (at(0), at(0)));
}

#[test]
fn rotations_are_about_fixed_x_then_y_then_z() {
    let bytes = packet(7, &[("v", [1.0, 0.0, 0.0, 0.3, -0.4, 2.0])]);
    let mut found = None;
    parse(&bytes, |object| found = object.angles_rad).unwrap();
    // The matrix written out from R = Rz Ry Rx, first column: (cos z cos y, sin z cos y, -sin y).
    let rotation: DQuat = Euler::Xyz.rotation(found.unwrap());
    let nose = rotation * DVec3::X;
    let (y, z) = (-0.4f64, 2.0f64);
    assert!((nose - DVec3::new(z.cos() * y.cos(), z.sin() * y.cos(), -y.sin())).length() < 1e-12);
    // And third row: (-sin y, cos y sin x, cos y cos x).
    let up = rotation.conjugate() * DVec3::Z;
    let x = 0.3f64;
    assert!((up - DVec3::new(-y.sin(), y.cos() * x.sin(), y.cos() * x.cos())).length() < 1e-12);
}

#[test]
fn the_named_object_is_found_among_several_with_padding_and_foreign_items() {
    let one = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    let mut bytes = packet(1, &[("wand", one)]);
    bytes[4] = 3;
    bytes.extend_from_slice(&[9, 4, 0, 1, 2, 3, 4]); // an item of unknown id, 4 bytes
    bytes.extend_from_slice(&packet(1, &[("vizflyt", [5000.0, 0.0, 0.0, 0.0, 0.0, 0.0])])[5..]);
    bytes.resize(512, 0);
    let pose = only(&mut stream(&["vizflyt"]), at(0), &bytes).unwrap();
    assert_eq!(pose.world_from_body.translation_m.x, 5.0);
}

fn check(bytes: &[u8], expected: &str) {
    let error = parse(bytes, |_| ()).unwrap_err();
    assert_eq!(error.to_string(), expected);
}

/// Returns (vehicle, x [m]) of each pose of a packet.
fn found(stream: &mut ViconStream, bytes: &[u8]) -> Vec<(usize, f64)> {
    let line = |m: &Measurement| (m.vehicle, m.world_from_body.translation_m.x);
    stream.handle_packet(at(0), bytes).iter().map(line).collect()
}

#[test]
fn each_vehicle_gets_its_own_object_from_one_packet_or_several() {
    let mut together = stream(&["wasp", "bee"]);
    let x = |x_m: f64| [x_m * 1e3, 0.0, 0.0, 0.0, 0.0, 0.0];
    let both = packet(1, &[("bee", x(2.0)), ("wand", x(9.0)), ("wasp", x(1.0))]);
    assert_eq!(found(&mut together, &both), [(0, 1.0), (1, 2.0)]);
    // An occluded object does not delay the other, and each has its own counter.
    let hidden = packet(2, &[("bee", [0.0; 6]), ("wasp", x(1.0))]);
    assert_eq!(found(&mut together, &hidden), [(0, 1.0)]);
    assert_eq!(found(&mut together, &packet(3, &[("wasp", x(1.0))])), [(0, 1.0)]);
    assert_eq!(found(&mut together, &packet(3, &[("bee", x(2.0))])), [(1, 2.0)]);
    assert_eq!(found(&mut together, &packet(3, &[("bee", x(2.0))])), []);
    // Simulators count their own frames.
    let mut apart = stream(&["wasp", "bee"]);
    for frame in 1..5 {
        assert_eq!(found(&mut apart, &packet(1000 + frame, &[("wasp", x(1.0))])), [(0, 1.0)]);
        assert_eq!(found(&mut apart, &packet(frame, &[("bee", x(2.0))])), [(1, 2.0)]);
    }
    assert_eq!(apart.counters(0), SourceCounters { poses: 4, ..SourceCounters::default() });
    let counters = [0, 1].map(|vehicle| together.counters(vehicle));
    assert_eq!(counters.map(|c| (c.poses, c.occluded, c.stale_packets)), [(3, 0, 0), (2, 1, 1)]);
    let all = counters[0].and(counters[1]);
    assert_eq!((all.poses, all.occluded, all.lost_frames), (5, 1, 0));
}

#[test]
fn reports_invalid_packets() {
    let good = packet(1, &[("vizflyt", [1.0; 6])]);
    check(&good[..4], "packet of 4 bytes is shorter than its head of 5");
    check(&good[..6], "item 0 needs 3 bytes at offset 5, 1 are left");
    check(&good[..79], "item 0 needs 75 bytes at offset 5, 74 are left");
    let mut wrong = good.clone();
    wrong[6] = 71;
    check(&wrong, "item 0 is an object of 71 bytes instead of 72");
    let text = "item 0 has a coordinate or angle that is not finite or absurdly large";
    for poison in [f64::NAN, f64::INFINITY, 1e300] {
        check(&packet(1, &[("vizflyt", [0.0, 0.0, poison, 0.0, 0.0, 0.0])]), text);
    }
}

#[test]
fn warns_once_with_the_names_of_other_objects() {
    let mut stream = stream(&["vizflyt"]);
    for frame in 0..10 {
        let bytes = packet(frame, &[("drone", [1.0; 6])]);
        assert_eq!(stream.handle_packet(at(u64::from(frame)), &bytes), []);
    }
    let warning = stream.next_warning().unwrap();
    assert!(
        warning.starts_with("vicon: object 'drone' streams, but 'vizflyt' was asked for;"),
        "{warning}"
    );
    assert_eq!(stream.next_warning(), None);
}

#[test]
fn stale_lost_occluded_and_bad_packets_are_counted_and_a_restart_is_followed() {
    let mut stream = stream(&["v"]);
    let mut ms = 0;
    let mut feed = |frame: u32, values: [f64; 6]| {
        // Tracker is silent for a second while it restarts.
        ms += if frame == 1 { 1000 } else { 5 };
        !stream.handle_packet(at(ms), &packet(frame, &[("v", values)])).is_empty()
    };
    assert!(feed(100_000, [1.0; 6]));
    assert!(!feed(100_000, [1.0; 6])); // twice
    assert!(feed(100_003, [1.0; 6])); // two lost
    assert!(!feed(100_001, [1.0; 6])); // late
    assert!(!feed(100_004, [0.0; 6])); // occluded
    assert!(feed(1, [1.0; 6])); // Tracker restarted
    assert!(feed(2, [1.0; 6]));
    assert_eq!(stream.handle_packet(at(0), b"hello"), []);
    assert_eq!(
        stream.counters(0),
        SourceCounters {
            poses: 4,
            bad_packets: 1,
            stale_packets: 2,
            lost_frames: 2,
            occluded: 1,
            ..SourceCounters::default()
        }
    );
    assert_eq!(
        stream.next_warning().unwrap(),
        "vicon: the sender of 'v' was restarted: its frames begin again, at 1 after 100004"
    );
    assert!(stream.next_warning().unwrap().starts_with("vicon: item 0 needs"));
}

proptest! {
    #[test]
    fn any_bytes_parse_or_fail_cleanly(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
        let _ = parse(&bytes, |_| ());
        let _ = stream(&["v"]).handle_packet(at(0), &bytes);
    }

    /// After a change of any byte of a valid packet, the parser does not panic, and poses stay valid.
    #[test]
    fn returned_poses_are_valid(at_byte in 0usize..80, value in any::<u8>()) {
        let mut bytes = packet(9, &[("v", [1.0, 2.0, 3.0, 0.1, 0.2, 0.3])]);
        bytes[at_byte] = value;
        for pose in stream(&["v"]).handle_packet(at(0), &bytes) {
            prop_assert!(pose.world_from_body.is_valid());
        }
    }
}

fn hovering(index: u32, p_m: DVec3) -> Vec<u8> {
    let [x, y, z] = (1e3 * p_m).to_array();
    let turned = if p_m == DVec3::ZERO { 0.0 } else { 0.3 };
    packet(index, &[("v", [x, y, z, 0.0, 0.0, turned])])
}

#[test]
fn poses_of_a_hidden_object_are_missing() {
    let reason = |origin| lost_poses::reason_of(origin, &mut stream(&["v"]), hovering);
    assert!(matches!(reason(false), Some(Rejected::Repeated(_))));
    // All zeros mean that Tracker does not see the object.
    assert_eq!(reason(true), None);
}

#[test]
fn stream_of_a_vehicle_has_one_sender() {
    lost_poses::check_second_sender(&mut stream(&["v"]), hovering);
}
