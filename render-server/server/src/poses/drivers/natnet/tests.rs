use super::*;
use crate::poses::drivers::lost_poses;
use natnet::{ConnectionInfo, DataSet, ModelDef, PlannedBody, RigidBodyDef, SyntheticServer};
use proptest::prelude::*;
use vizflyt_arena::pose::Rejected;

const SERVER: &str = "10.0.0.5:1510";

fn at(ms: u64) -> ServerTime {
    ServerTime::from_ns(1_000_000_000 + ms * 1_000_000)
}

fn stream(settings: &str, motive: Motive) -> NatnetStream {
    let config = LocalizationConfig::parse(&format!("natnet:{SERVER},{settings}")).unwrap();
    NatnetStream::new(&config, 2, &["bee", "wasp"], motive)
}

fn unicast() -> Motive {
    Motive::Unicast(SERVER.parse().unwrap())
}

fn info(version: Version) -> Vec<u8> {
    let info = ServerInfo {
        application_name: "Motive".to_owned(),
        server_version: Version::new(3, 1, 2, 1),
        protocol_version: version,
        high_res_clock_frequency: 10_000_000,
        connection: ConnectionInfo {
            data_port: 1511,
            multicast: false,
            multicast_group: [239, 255, 42, 99],
        },
    };
    info.to_datagram().unwrap()
}

fn names(version: Version, bodies: &[(&str, i32)]) -> Vec<u8> {
    let body = |&(name, id): &(&str, i32)| {
        let (name, offset, tail) = (name.to_owned(), [0.0; 3], 0i32.to_le_bytes().to_vec());
        DataSet::RigidBody(RigidBodyDef { name, id, parent_id: -1, offset, tail })
    };
    ModelDef { datasets: bodies.iter().map(body).collect() }.to_datagram(version).unwrap()
}

/// Returns a frame exposed at `exposed_s` of Motive's clock, and sent 4 ms later.
fn frame(version: Version, number: i32, exposed_s: f64, bodies: &[PlannedBody]) -> Vec<u8> {
    let mut frame = SyntheticServer::new(version, 10_000_000).frame(number, exposed_s, bodies);
    frame.timing.transmit = frame.timing.camera_mid_exposure + 40_000;
    frame.to_datagram(version).unwrap()
}

/// Returns the ids of the messages that are sent at `now`.
fn sent(stream: &mut NatnetStream, now: ServerTime) -> Vec<u16> {
    let mut ids = Vec::new();
    while let Some((to, bytes)) = stream.poll_transmit(now) {
        assert_eq!(to, SERVER.parse().unwrap());
        ids.push(MessageHeader::parse(&bytes).unwrap().message_id);
        assert!(ids.len() < 10, "no end of it: {ids:?}");
    }
    ids
}

#[test]
fn requests_are_repeated_until_motive_replies_and_then_kept_alive() {
    for version in [
        Version::new(3, 0, 0, 0),
        Version::new(3, 1, 0, 0),
        Version::new(4, 0, 0, 0),
        Version::V4_1,
    ] {
        let mut s = stream("up=y", unicast());
        assert_eq!(sent(&mut s, at(0)), [natnet::NAT_CONNECT]);
        assert!(sent(&mut s, at(100)).is_empty());
        assert_eq!(sent(&mut s, at(600)), [natnet::NAT_CONNECT]);
        assert_eq!(s.handle_packet(at(610), &info(version)), []);
        assert_eq!(sent(&mut s, at(620)), [natnet::NAT_REQUEST_MODELDEF, natnet::NAT_KEEPALIVE]);
        s.handle_packet(at(630), &names(version, &[("wand", 3), ("wasp", 7)]));
        assert!(sent(&mut s, at(640)).is_empty());
        let left = DQuat::from_rotation_y(0.5).as_quat().to_array();
        let body = PlannedBody::tracked(7, [0.0, 1.0, 2.0], left);
        let found = s.handle_packet(at(650), &frame(version, 1, 50.0, &[body]))[0];
        assert_eq!((found.vehicle, found.source, found.arrival), (1, 2, at(650)));
        // Sent on arrival, exposed 4 ms before.
        assert_eq!(found.stamp, at(646));
        let pose = found.world_from_body;
        assert!((pose.translation_m - DVec3::new(0.0, -2.0, 1.0)).length() < 1e-6);
        assert!((pose.rotation.to_scaled_axis() - DVec3::Z * 0.5).length() < 1e-6);
        assert_eq!(sent(&mut s, at(1700)), [natnet::NAT_KEEPALIVE]);
        // Silence: Motive was restarted.
        assert_eq!(sent(&mut s, at(4000)), [natnet::NAT_CONNECT]);
        assert_eq!(s.next_warning(), None);
    }
}

#[test]
fn requests_names_from_a_multicast_sender() {
    let mut s = stream("", Motive::Multicast);
    assert_eq!(s.poll_transmit(at(0)), None);
    let body = [PlannedBody::tracked(7, [1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0])];
    let from = "10.0.0.5:1511".parse().unwrap();
    assert_eq!(s.handle_packet_from(at(1), from, &frame(Version::V4_1, 1, 50.0, &body)), []);
    assert_eq!(sent(&mut s, at(2)), [natnet::NAT_CONNECT]);
    s.handle_packet_from(at(3), SERVER.parse().unwrap(), &info(Version::V4_1));
    assert_eq!(sent(&mut s, at(4)), [natnet::NAT_REQUEST_MODELDEF]);
    s.handle_packet(at(5), &names(Version::V4_1, &[("bee", 7)]));
    assert_eq!(s.handle_packet(at(6), &frame(Version::V4_1, 2, 50.005, &body)).len(), 1);
    // No keep-alive is sent, and the name of a new rigid body is requested.
    assert!(sent(&mut s, at(3000)).is_empty());
    let new = [PlannedBody::tracked(8, [1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0])];
    s.handle_packet(at(3001), &frame(Version::V4_1, 3, 50.01, &new));
    assert_eq!(sent(&mut s, at(3002)), [natnet::NAT_REQUEST_MODELDEF]);
}

#[test]
fn reports_and_counts_invalid_packets() {
    let ready = || {
        let mut s = stream("objects.wasp=7", unicast());
        s.handle_packet(at(0), &info(Version::V4_1));
        s
    };
    // By id, without names; occluded; repeated; not a pose.
    let mut s = ready();
    let body = |p: f32| PlannedBody::tracked(7, [p, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0]);
    assert_eq!(s.handle_packet(at(1), &frame(Version::V4_1, 1, 1.0, &[body(1.0)])).len(), 1);
    assert_eq!(s.handle_packet(at(2), &frame(Version::V4_1, 1, 1.0, &[body(1.0)])).len(), 0);
    let unseen = [PlannedBody::dropout(7)];
    assert_eq!(s.handle_packet(at(3), &frame(Version::V4_1, 2, 1.0, &unseen)).len(), 0);
    assert_eq!(s.handle_packet(at(4), &frame(Version::V4_1, 3, 1.0, &[body(f32::NAN)])).len(), 0);
    let counters = s.counters(1);
    assert_eq!((counters.poses, counters.stale_packets, counters.occluded), (1, 1, 1));
    assert_eq!(counters.bad_packets, 1);
    assert!(s.next_warning().unwrap().contains("is not a valid pose"));

    let mut s = ready();
    s.handle_packet(at(1), &names(Version::V4_1, &[("Drone 1", 1), ("wand", 3)]));
    assert_eq!(
        s.next_warning().unwrap(),
        "natnet: object 'Drone 1', 'wand' streams, but 'bee', '7' was asked for; rename the rigid \
         body in Motive's Assets pane, or set `objects`"
    );

    // A newer version: with unicast, 4.1 is requested; with multicast it cannot be.
    let future = Version::new(5, 2, 0, 0);
    let mut s = stream("", unicast());
    assert_eq!(sent(&mut s, at(0)), [natnet::NAT_CONNECT]);
    s.handle_packet(at(1), &info(future));
    let (_, again) = s.poll_transmit(at(2)).unwrap();
    let asked = ConnectOptions::parse(&again[natnet::HEADER_LEN..]).unwrap();
    assert_eq!(asked.bitstream_version, Some(Version::V4_1));
    s.handle_packet(at(3), &info(future));
    assert!(s.session.is_some());
    let mut s = stream("", Motive::Multicast);
    s.handle_packet(at(1), &info(future));
    assert!(s.next_warning().unwrap().contains("streams NatNet 5.2.0.0, this server knows"));

    let mut s = ready();
    s.handle_packet(at(1), b"GET / HTTP/1.1");
    assert!(s.next_warning().unwrap().contains("is not NatNet's"));
}

proptest! {
    #[test]
    fn any_bytes_parse_or_fail_cleanly(bytes in prop::collection::vec(any::<u8>(), 0..400), id in 0u16..12) {
        let mut s = stream("objects.wasp=7", unicast());
        s.handle_packet(at(0), &info(Version::V4_1));
        let mut headed = id.to_le_bytes().to_vec();
        headed.extend_from_slice(&[0, 0]);
        headed.extend(bytes);
        for found in s.handle_packet(at(1), &headed) {
            prop_assert!(found.world_from_body.is_valid());
        }
    }

    /// After a change of any byte of a valid frame, the resulting poses are valid and not in the future.
    #[test]
    fn returned_poses_are_valid(index in 0usize..220, value in any::<u8>()) {
        let mut s = stream("objects.wasp=7", unicast());
        s.handle_packet(at(0), &info(Version::V4_1));
        let mut bytes = frame(Version::V4_1, 9, 2.0, &[PlannedBody::tracked(7, [1.0, 2.0, 3.0], [0.0, 0.6, 0.0, 0.8])]);
        let index = index % bytes.len();
        bytes[index] = value;
        for found in s.handle_packet(at(1), &bytes) {
            prop_assert!(found.world_from_body.is_valid() && found.stamp <= found.arrival);
        }
    }
}

fn connected() -> NatnetStream {
    let mut s = stream("", unicast());
    s.handle_packet(at(0), &info(Version::V4_1));
    s.handle_packet(at(0), &names(Version::V4_1, &[("bee", 7)]));
    s
}

fn hovering(index: u32, p_m: DVec3) -> Vec<u8> {
    let body = PlannedBody::tracked(7, p_m.as_vec3().to_array(), [0.0, 0.0, 0.0, 1.0]);
    let exposed_s = 50.0 + 0.02 * f64::from(index);
    frame(Version::V4_1, index as i32 + 1, exposed_s, &[body])
}

#[test]
fn poses_of_a_hidden_object_are_missing_even_if_marked_as_tracked() {
    let reason = |origin| lost_poses::reason_of(origin, &mut connected(), hovering);
    assert!(matches!(reason(false), Some(Rejected::Repeated(_))));
    assert_eq!(reason(true), Some(Rejected::NotVisible));
}

#[test]
fn stream_of_a_vehicle_has_one_sender() {
    lost_poses::check_second_sender(&mut connected(), hovering);
}

#[test]
fn packets_of_another_computer_are_ignored_once_requested_by_unicast() {
    let mut s = connected();
    let other = "10.0.0.66:1511".parse().unwrap();
    for index in 0..3 {
        let bytes = hovering(index, DVec3::ONE);
        assert_eq!(s.handle_packet_from(at(u64::from(index) * 20), other, &bytes), []);
    }
    let warning = s.next_warning().unwrap();
    assert!(warning.contains("10.0.0.66:1511") && warning.contains(SERVER), "{warning}");
    assert_eq!(s.next_warning(), None);
}
