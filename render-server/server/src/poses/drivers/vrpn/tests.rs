use super::*;
use crate::poses::drivers::lost_poses;
use proptest::prelude::*;
use vizflyt_arena::pose::Rejected;

/// TCP data sent by a server with the library of VRPN 7.38 to a client that sent only [`COOKIE`]: a tracker
/// "vizflyt" that moves in a circle at 100 Hz, and a tracker "wasp" with two sensors at rest. The last report
/// is truncated.
pub(super) const RECORDED: &[u8] = include_bytes!("recorded.bin");

fn config(settings: &str) -> LocalizationConfig {
    LocalizationConfig::parse(&format!("vrpn:127.0.0.1,{settings}")).unwrap()
}

pub(super) fn stream(settings: &str) -> VrpnStream {
    VrpnStream::new(&config(settings), 3, &["vizflyt", "wasp"])
}

fn at(ms: u64) -> ServerTime {
    ServerTime::from_ns(1_000_000_000 + ms * 1_000_000)
}

/// Passes bytes to a stream; returns all resulting poses.
fn poses_of(stream: &mut VrpnStream, now: ServerTime, bytes: &[u8]) -> Vec<Measurement> {
    let mut found = Vec::new();
    stream.handle_bytes(now, bytes);
    while stream.read().unwrap() {
        let measured = stream.measured();
        assert!(measured.len() <= 2 && measured.iter().all(|pose| pose.arrival == now));
        found.extend_from_slice(measured);
    }
    found
}

fn message(stamp_us: u64, sender: i32, kind: i32, body: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let words =
        [(HEAD + body.len()) as u32, (stamp_us / 1_000_000) as u32, (stamp_us % 1_000_000) as u32];
    bytes.extend(words.into_iter().flat_map(u32::to_be_bytes));
    bytes.extend([sender, kind, 0].into_iter().flat_map(i32::to_be_bytes));
    bytes.extend_from_slice(body);
    bytes.resize(bytes.len().next_multiple_of(8), 0);
    bytes
}

fn described(number: i32, kind: i32, name: &str) -> Vec<u8> {
    let mut body = (name.len() as u32 + 1).to_be_bytes().to_vec();
    body.extend_from_slice(name.as_bytes());
    body.push(0);
    message(5, number, kind, &body)
}

/// Returns the first messages of a server with these senders.
pub(super) fn beginning(senders: &[(&str, i32)]) -> Vec<u8> {
    let mut bytes = COOKIE.to_vec();
    bytes.extend(
        senders.iter().flat_map(|&(name, number)| described(number, SENDER_DESCRIPTION, name)),
    );
    bytes.extend(described(9, TYPE_DESCRIPTION, "vrpn_Tracker Pos_Quat"));
    bytes
}

pub(super) fn report(stamp_us: u64, sender: i32, sensor: i32, numbers: [f64; 7]) -> Vec<u8> {
    let mut body: Vec<_> = [sensor, sensor].into_iter().flat_map(i32::to_be_bytes).collect();
    body.extend(numbers.into_iter().flat_map(f64::to_be_bytes));
    message(stamp_us, sender, 9, &body)
}

pub(super) const STANDS: [f64; 7] = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0];

fn warnings(stream: &mut VrpnStream) -> Vec<String> {
    std::iter::from_fn(|| stream.next_warning()).collect()
}

#[test]
fn reads_a_recording_of_a_real_server() {
    let mut s = stream("");
    let found = poses_of(&mut s, at(5000), RECORDED);
    let of = |vehicle| found.iter().filter(move |pose| pose.vehicle == vehicle);
    assert_eq!((of(0).count(), of(1).count()), (11, 10));
    assert!(found.iter().all(|pose| pose.source == 3));
    for pose in of(0) {
        // It moves around (1, -2) with a radius of 1 m, its x axis turned by half the angle of its position.
        let from_middle = pose.world_from_body.translation_m - DVec3::new(1.0, -2.0, 0.5);
        assert!((from_middle.length() - 1.0).abs() < 1e-9, "{from_middle}");
        assert!((pose.world_from_body.rotate(DVec3::X) - from_middle).length() < 1e-9);
    }
    for pose in of(1) {
        assert_eq!(pose.world_from_body.translation_m, DVec3::new(3.0, 0.25, 1.5));
        let q = DQuat::from_xyzw(0.5, 0.5, 0.5, 0.5);
        assert!(pose.world_from_body.rotation.dot(q).abs() > 1.0 - 1e-12);
    }
    // All arrived at once, and the server's clock was unknown before.
    assert!(found.iter().all(|pose| pose.stamp == at(5000)));
    assert_eq!(warnings(&mut s), Vec::<String>::new());
    assert_eq!(s.described().unwrap(), "'vizflyt', 'wasp'");
    assert_eq!((s.counters(0).poses, s.counters(0).bad_packets), (11, 0));

    let mut second = stream("sensor=1,units=cm,objects.vizflyt=wasp,objects.wasp=none");
    let found = poses_of(&mut second, at(5000), RECORDED);
    assert_eq!(found.len(), 10);
    let pose = found[0].world_from_body;
    assert!((pose.translation_m - DVec3::new(-0.03, 0.0025, 0.015)).length() < 1e-12);
    assert!((pose.rotation.to_scaled_axis().x - 2.0 * 0.6f64.asin()).abs() < 1e-9);
}

#[test]
fn uses_the_servers_stamps() {
    let mut s = stream("latency_ms=5");
    poses_of(&mut s, at(0), &beginning(&[("vizflyt", 1)]));
    // A server whose clock is 77 s behind. The second report took 30 ms longer, and is 10 ms younger.
    let found = poses_of(&mut s, at(100), &report(77_000_000, 1, 0, STANDS));
    assert_eq!((found[0].stamp, found[0].arrival), (at(95), at(100)));
    let found = poses_of(&mut s, at(140), &report(77_010_000, 1, 0, STANDS));
    assert_eq!((found[0].stamp, found[0].arrival), (at(105), at(140)));
    // Without a stamp, the arrival counts.
    let found = poses_of(&mut s, at(200), &report(0, 1, 0, STANDS));
    assert_eq!(found[0].stamp, at(195));
    // A restarted server, with its clock changed by hours, is accepted at once.
    s.begin_connection();
    poses_of(&mut s, at(1000), &beginning(&[("vizflyt", 4)]));
    let found = poses_of(&mut s, at(1010), &report(11, 4, 0, STANDS));
    assert_eq!(found[0].stamp, at(1005));
    assert_eq!(warnings(&mut s), Vec::<String>::new());
}

#[test]
fn each_batch_has_one_pose_of_a_vehicle() {
    let mut s = stream("");
    s.handle_bytes(at(0), &beginning(&[("vizflyt", 1), ("wasp", 2)]));
    for (stamp_us, sender) in [(10, 1), (10, 2), (20, 1), (30, 1), (30, 2)] {
        s.handle_bytes(at(1), &report(stamp_us, sender, 0, STANDS));
    }
    let mut batches = Vec::new();
    while s.read().unwrap() {
        batches.push(s.measured().iter().map(|pose| pose.vehicle).collect::<Vec<_>>());
    }
    assert_eq!(batches, [vec![0, 1], vec![0], vec![0, 1]]);
    assert!(s.unread_bytes() == 0);
}

#[test]
fn counts_and_reports_invalid_reports() {
    let mut s = stream("");
    poses_of(&mut s, at(0), &beginning(&[("vizflyt", 1)]));
    // A repeated report; occluded; another sensor; an unknown sender.
    for ms in 0..1500 {
        let found = poses_of(&mut s, at(ms), &report(10, 1, 0, STANDS));
        assert_eq!(found.len(), usize::from(ms == 0));
    }
    let unseen = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0];
    for bytes in [report(20, 1, 0, unseen), report(30, 1, 1, STANDS), report(40, 7, 0, STANDS)] {
        assert_eq!(poses_of(&mut s, at(1600), &bytes), []);
    }
    let counters = s.counters(0);
    assert_eq!((counters.poses, counters.stale_packets, counters.occluded), (1, 1499, 1));
    assert_eq!(counters.bad_packets, 0);
    let said = warnings(&mut s);
    assert!(said.len() == 1 && said[0].contains("streams frame 1 again and again"), "{said:?}");

    for (bytes, expected) in [
        (
            report(50, 1, 0, [1.0, 2.0, f64::NAN, 0.0, 0.0, 0.0, 1.0]),
            "an invalid position or rotation",
        ),
        (
            report(50, 1, 0, [1.0, 2.0, 1e300, 0.0, 0.0, 0.0, 1.0]),
            "an invalid position or rotation",
        ),
        (report(50, 1, 0, [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.5]), "an invalid position or rotation"),
        (message(50, 1, 9, &[0; 63]), "report of 63 bytes is shorter than 64"),
        (
            message(50, 1, SENDER_DESCRIPTION, &[0, 0, 1, 0, 65, 0]),
            "a name of 256 bytes is in a message of 6",
        ),
        (message(50, 1, TYPE_DESCRIPTION, &[0, 0]), "a name of 0 bytes is in a message of 2"),
    ] {
        let mut s = stream("");
        poses_of(&mut s, at(0), &beginning(&[("vizflyt", 1)]));
        assert_eq!(poses_of(&mut s, at(1), &bytes), []);
        let said = warnings(&mut s);
        assert!(said.len() == 1 && said[0].contains(expected), "{said:?}");
        // Later messages are parsed.
        assert_eq!(poses_of(&mut s, at(2), &report(60, 1, 0, STANDS)).len(), 1);
        assert_eq!(s.counters(0).bad_packets, 1);
    }
}

#[test]
fn names_other_trackers_once_all_have_reported() {
    let said_of = |settings: &str| {
        let mut s = stream(settings);
        poses_of(&mut s, at(0), &beginning(&[("ant", 1), ("bee", 2), ("Button0", 3)]));
        for ms in [0, 500, 1100, 1200] {
            poses_of(&mut s, at(ms), &report(1000 * ms + 10, 1, 4, STANDS));
            poses_of(&mut s, at(ms), &report(1000 * ms + 10, 2, 5, STANDS));
        }
        warnings(&mut s)
    };
    assert_eq!(
        said_of("objects.wasp=hornet"),
        [
            "vrpn: object 'ant', 'bee' streams, but 'vizflyt', 'hornet' was asked for; rename the object in the \
          motion capture's program, or set `objects`"
        ]
    );
    assert_eq!(
        said_of("objects.wasp=bee,sensor=2"),
        ["vrpn: 'bee' reports sensor 5, but 2 was asked for; set `sensor`"]
    );
    assert_eq!(said_of("objects.wasp=bee,sensor=5"), Vec::<String>::new());
}

#[test]
fn follows_a_renumbered_type() {
    let mut s = stream("");
    poses_of(&mut s, at(0), &beginning(&[("vizflyt", 1)]));
    poses_of(&mut s, at(1), &described(9, TYPE_DESCRIPTION, "vrpn_Tracker Velocity"));
    assert_eq!(poses_of(&mut s, at(2), &report(10, 1, 0, STANDS)), []);
    poses_of(&mut s, at(3), &described(9, TYPE_DESCRIPTION, "vrpn_Tracker Pos_Quat"));
    assert_eq!(poses_of(&mut s, at(4), &report(10, 1, 0, STANDS)).len(), 1);
    poses_of(&mut s, at(5), &described(1, SENDER_DESCRIPTION, "other"));
    assert_eq!(poses_of(&mut s, at(6), &report(20, 1, 0, STANDS)), []);
}

#[test]
fn rejects_data_that_is_not_vrpn() {
    let begins = |bytes: &[u8]| {
        let mut s = stream("");
        s.handle_bytes(at(0), bytes);
        s.read()
    };
    assert_eq!(begins(b"HTTP/1.1 400 Bad Request"), Err(VrpnError::Cookie));
    assert_eq!(begins(b"vrpn: ver. 06.12  0"), Err(VrpnError::Version(6)));
    assert_eq!(begins(b"vrpn: ver. 7.1"), Err(VrpnError::Cookie));
    assert_eq!(begins(b"vrpn: ver. 07"), Ok(false));
    assert_eq!(begins(b"vrpn: ver. 07.99  3....."), Ok(false));
    for length in [0u32, 23, 24 + 64_001, u32::MAX] {
        let bytes = [COOKIE.as_slice(), &length.to_be_bytes()].concat();
        assert_eq!(begins(&bytes), Err(VrpnError::Length(length)));
    }
    // The longest valid message waits for its end.
    let bytes = [COOKIE.as_slice(), &(24 + 64_000u32).to_be_bytes(), &vec![0; 60_000]].concat();
    assert_eq!(begins(&bytes), Ok(false));
}

#[test]
fn limits_the_number_of_senders() {
    let mut s = stream("");
    let mut bytes = COOKIE.to_vec();
    for number in 0..3000 {
        bytes.extend(described(number, SENDER_DESCRIPTION, &"x".repeat(98)));
    }
    poses_of(&mut s, at(0), &bytes);
    assert_eq!(s.session.senders.len(), MAX_SENDERS);
}

proptest! {
    /// The recorded stream gives the same poses for any segmentation.
    #[test]
    fn segmentation_does_not_change_the_poses(cuts in prop::collection::vec(1usize..300, 14..60)) {
        let mut s = stream("");
        let (mut rest, mut count) = (RECORDED, 0);
        for cut in cuts.iter().cycle() {
            let (now, later) = rest.split_at(rest.len().min(*cut));
            rest = later;
            count += poses_of(&mut s, at(5000), now).len();
            if rest.is_empty() {
                break;
            }
        }
        prop_assert_eq!(count, 21);
        prop_assert!(s.unread_bytes() < 88);
    }

    #[test]
    fn any_bytes_parse_or_fail_cleanly(bytes in prop::collection::vec(any::<u8>(), 0..600), greeted in any::<bool>()) {
        let mut s = stream("");
        if greeted {
            poses_of(&mut s, at(0), &beginning(&[("vizflyt", 1)]));
        }
        s.handle_bytes(at(1), &bytes);
        while s.read() == Ok(true) {
            prop_assert!(s.measured().iter().all(|pose| pose.world_from_body.is_valid()));
        }
    }

    /// After a change of any byte of a real stream, the resulting poses are valid and not in the future.
    #[test]
    fn returned_poses_are_valid(index in 0..RECORDED.len(), value in any::<u8>()) {
        let mut s = stream("");
        let mut bytes = RECORDED.to_vec();
        bytes[index] = value;
        s.handle_bytes(at(5000), &bytes);
        while s.read() == Ok(true) {
            for pose in s.measured() {
                prop_assert!(pose.world_from_body.is_valid() && pose.stamp <= pose.arrival);
            }
        }
    }

    #[test]
    fn reads_back_written_reports(p in prop::array::uniform3(-50.0..50.0f64), q in prop::array::uniform4(-1.0..1.0f64), stamp_us in 1u64..4_000_000_000_000_000) {
        prop_assume!(q.iter().map(|v| v * v).sum::<f64>() > 1e-2);
        let q = DQuat::from_array(q).normalize();
        let mut s = stream("");
        poses_of(&mut s, at(0), &beginning(&[("vizflyt", 1)]));
        let numbers = [p[0], p[1], p[2], q.x, q.y, q.z, q.w];
        let found = poses_of(&mut s, at(1), &report(stamp_us, 1, 0, numbers));
        prop_assert_eq!(found[0].world_from_body.translation_m, DVec3::from(p));
        prop_assert!(found[0].world_from_body.rotation.dot(q).abs() > 1.0 - 1e-9);
    }
}

#[test]
fn poses_of_a_hidden_object_are_missing() {
    let reason = |origin| {
        let mut s = stream("");
        s.handle_bytes(at(0), &beginning(&[("vizflyt", 4)]));
        lost_poses::reason(origin, |now, index, p_m| {
            let [x, y, z] = p_m.to_array();
            let stamp_us = 1_000_000 + 20_000 * u64::from(index);
            let numbers = [x, y, z, 0.0, 0.0, 0.0, 1.0];
            poses_of(&mut s, now, &report(stamp_us, 4, 0, numbers)).first().copied()
        })
    };
    assert!(matches!(reason(false), Some(Rejected::Repeated(_))));
    assert_eq!(reason(true), Some(Rejected::NotVisible));
}
