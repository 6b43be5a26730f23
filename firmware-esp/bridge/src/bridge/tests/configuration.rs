//! Authorization of configuration changes.

use sha2::{Digest, Sha256};

use super::*;
use crate::access::{Op, PROOF, Status, TUNNEL_TYPE};
use crate::settings::Key;
use crate::stats::REPORT;

pub(super) const KEY: Key = [0x42; 32];

/// Sends a request to the bridge. Returns status and body of the answer.
pub(super) fn ask(bridge: &mut Bridge, now: u64, request: &[u8]) -> (Status, Vec<u8>) {
    let [low, high] = TUNNEL_TYPE.to_le_bytes();
    let mut payload = vec![low, high, 1, COMPONENT_ID, request.len() as u8];
    payload.extend_from_slice(request);
    let mut packet = [0; MAX_PACKET];
    let len = crate::mavlink_writer::write_packet(&mut packet, RUNTIME, 0, 385, &payload);
    bridge.handle_datagram(at(now), address(2), &packet[..len]);
    let mut answer = None;
    for (_, datagram) in datagrams(bridge, at(now + 50)) {
        crate::packet::each_in_datagram(
            &datagram,
            &mut crate::packet::CutStats::default(),
            |packet: Raw<'_>| {
                if packet.id() == 385 {
                    assert_eq!(packet.source(), (1, COMPONENT_ID));
                    assert_eq!(packet.target(), RUNTIME);
                    let mut body = packet.payload().to_vec();
                    body.resize(5 + access::BODY, 0);
                    let len = usize::from(body[4]);
                    assert_eq!(body[5], request[0] | 0x80);
                    answer =
                        Some((Status::from_number(body[6]).unwrap(), body[7..5 + len].to_vec()));
                }
            },
        );
    }
    answer.expect("every request is answered")
}

pub(super) fn request(op: Op, counter: u32, body: &[u8], key: Option<&Key>) -> Vec<u8> {
    let mut request = vec![op as u8];
    request.extend_from_slice(&counter.to_le_bytes());
    request.extend_from_slice(body);
    if let Some(key) = key {
        let proof: [u8; PROOF] = access::proof(key, &access::nonce(&[7; 16]), &request);
        request.extend_from_slice(&proof);
    }
    request
}

#[test]
fn accepts_changes_only_with_the_key_after_claiming() {
    let mut bridge = bridge(quiet());
    let mut check = |op, counter, body: &[u8], key: Option<&Key>, expected| {
        let now = 10 + 100 * u64::from(counter);
        let (status, _) = ask(&mut bridge, now, &request(op, counter, body, key));
        assert_eq!(status, expected, "{op:?} {counter}");
        (bridge.settings().loss_ms, bridge.poll_event())
    };
    check(Op::Set, 1, b"LOSS_MS=700", Some(&KEY), Status::Unclaimed);
    let (_, event) = check(Op::Claim, 2, &KEY, None, Status::Done);
    assert_eq!(event, Some(Event::Save));
    check(Op::Claim, 3, &[1; 32], None, Status::Claimed);
    check(Op::Set, 4, b"LOSS_MS=700", Some(&[1; 32]), Status::WrongKey);
    check(Op::Set, 4, b"LOSS_MS=700", None, Status::WrongKey);
    assert_eq!(check(Op::Set, 4, b"LOSS_MS=700", Some(&KEY), Status::Done).0, 700);
    // A replay of the same request.
    check(Op::Set, 4, b"LOSS_MS=700", Some(&KEY), Status::WrongKey);
    check(Op::Set, 5, b"LOSS_MS=1", Some(&KEY), Status::OutOfRange);
    check(Op::Set, 6, b"LOSS_MS", Some(&KEY), Status::Malformed);
    check(Op::Set, 7, b"NO=1", Some(&KEY), Status::Unknown);
    assert_eq!(check(Op::Save, 8, b"", Some(&KEY), Status::Done).1, Some(Event::Save));
    assert_eq!(check(Op::Restart, 9, b"", Some(&KEY), Status::Done).1, Some(Event::Restart));
    assert_eq!(check(Op::Reset, 10, b"", Some(&KEY), Status::Done).0, 1000);
    check(Op::Claim, 11, &KEY, None, Status::Claimed);
}

#[test]
fn reading_is_open_but_reveals_no_secret() {
    let mut bridge = bridge(Settings { key: Some(KEY), ..quiet() });
    let (status, hello) = ask(&mut bridge, 10, &request(Op::Hello, 0, b"", None));
    assert_eq!((status, &hello[..16], hello[20]), (Status::Done, &access::nonce(&[7; 16])[..], 1));
    let (_, value) = ask(&mut bridge, 200, &request(Op::Read, 0, b"LOSS_MS", None));
    assert_eq!(value, b"1000");
    let (_, value) = ask(&mut bridge, 300, &request(Op::Read, 0, b"key", None));
    assert_eq!(value, b"***");
    let before = bridge.stats().net.cut.packets;
    let (status, report) = ask(&mut bridge, 400, &request(Op::Stats, 0, b"", None));
    assert_eq!((status, report.len()), (Status::Done, 4 * REPORT.len()));
    assert_eq!(report[40..44], before.to_le_bytes());
    let (status, _) = ask(&mut bridge, 500, &[200, 0, 0, 0, 0]);
    assert_eq!(status, Status::Unknown);
}

#[test]
fn refuses_changes_while_armed() {
    let mut bridge = bridge(Settings { key: Some(KEY), ..quiet() });
    bridge.handle_uart(at(0), &bytes(0, AUTOPILOT, &heartbeat(true, 5)));
    let change = request(Op::Set, 1, b"LOSS_MS=0", Some(&KEY));
    assert_eq!(ask(&mut bridge, 10, &change).0, Status::Armed);
    assert_eq!(bridge.settings().loss_ms, 1000);
    assert_eq!(bridge.stats().refused, 1);
}

/// Signs a packet as the MAVLink guide specifies.
pub(super) fn sign(packet: &[u8], key: &Key, stamp: u64) -> Vec<u8> {
    let mut packet = packet.to_vec();
    let id = u32::from_le_bytes([packet[7], packet[8], packet[9], 0]);
    packet[2] = 1;
    let at = packet.len() - 2;
    let extra = MavMessage::extra_crc(id);
    let crc = packet[1..at]
        .iter()
        .chain([&extra])
        .fold(0xFFFF, |crc, &byte| crate::packet::x25(crc, byte));
    packet[at..].copy_from_slice(&crc.to_le_bytes());
    packet.push(3);
    packet.extend_from_slice(&stamp.to_le_bytes()[..6]);
    let hash = Sha256::new().chain_update(key).chain_update(&packet).finalize();
    packet.extend_from_slice(&hash[..6]);
    packet
}

#[test]
fn sets_parameters_only_with_a_signature_by_the_key() {
    let mut bridge = bridge(Settings { key: Some(KEY), ..quiet() });
    let set = |value: f32| {
        MavMessage::PARAM_SET(PARAM_SET_DATA {
            param_value: value,
            target_system: 1,
            target_component: COMPONENT_ID,
            param_id: "LOSS_MS".into(),
            ..PARAM_SET_DATA::DEFAULT
        })
    };
    let mut ms = 0;
    let mut check = |packet: &[u8], expected: u16| {
        ms += 100;
        bridge.handle_datagram(at(ms), address(2), packet);
        assert_eq!(bridge.settings().loss_ms, expected);
        let reported = datagrams(&mut bridge, at(ms + 10)).iter().flat_map(|(_, b)| decode(b)).any(|packet| {
            matches!(packet.message, MavMessage::PARAM_VALUE(v) if v.param_value == f32::from(expected))
        });
        assert!(reported, "the reply has the setting in force");
    };
    let plain = bytes(0, RUNTIME, &set(600.0));
    check(&plain, 1000);
    check(&sign(&plain, &[1; 32], 100), 1000);
    check(&sign(&plain, &KEY, 100), 600);
    let other = bytes(0, RUNTIME, &set(800.0));
    check(&sign(&other, &KEY, 100), 600);
    check(&sign(&other, &KEY, 101), 800);
    check(&sign(&bytes(0, RUNTIME, &set(f32::NAN)), &KEY, 102), 800);
    check(&sign(&bytes(0, RUNTIME, &set(0.5)), &KEY, 103), 800);

    let list = MavMessage::default_message_from_id(21).unwrap();
    bridge.handle_datagram(at(5000), address(2), &bytes(0, RUNTIME, &list));
    let names: Vec<_> = datagrams(&mut bridge, at(5010))
        .iter()
        .flat_map(|(_, b)| decode(b))
        .filter_map(|packet| match packet.message {
            MavMessage::PARAM_VALUE(value) => Some(value.param_index),
            _ => None,
        })
        .collect();
    // The bridge's own parameters, and those that QGroundControl expects of a bridge.
    assert_eq!(names, (0..crate::settings::NUMBERS.len() as u16 + 23).collect::<Vec<_>>());
    // The autopilot also receives the request, because it was a broadcast.
    assert_eq!(foreign(uart(&mut bridge, at(5010))).len(), 1);
}

#[test]
fn answers_commands_to_the_bridge() {
    let mut bridge = bridge(Settings { key: Some(KEY), ..quiet() });
    let command = |command, param1| {
        MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
            param1,
            command,
            target_system: 1,
            target_component: COMPONENT_ID,
            ..Default::default()
        })
    };
    let mut ms = 0;
    let mut check = |packet: &[u8], expected: MavResult, event: Option<Event>| {
        ms += 100;
        bridge.handle_datagram(at(ms), address(2), packet);
        let results: Vec<MavResult> = datagrams(&mut bridge, at(ms + 10))
            .iter()
            .flat_map(|(_, b)| decode(b))
            .filter_map(|packet| match packet.message {
                MavMessage::COMMAND_ACK(ack) => Some(ack.result),
                _ => None,
            })
            .collect();
        assert_eq!(results, [expected]);
        assert_eq!(bridge.poll_event(), event);
        assert_eq!(foreign(uart(&mut bridge, at(ms))), Vec::<Vec<u8>>::new());
    };
    let restart = bytes(0, RUNTIME, &command(MavCmd::MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1.0));
    check(&restart, MavResult::MAV_RESULT_DENIED, None);
    check(&sign(&restart, &KEY, 5), MavResult::MAV_RESULT_ACCEPTED, Some(Event::Restart));
    let save = bytes(0, RUNTIME, &command(MavCmd::MAV_CMD_PREFLIGHT_STORAGE, 1.0));
    check(&sign(&save, &KEY, 6), MavResult::MAV_RESULT_ACCEPTED, Some(Event::Save));
    let land = bytes(0, RUNTIME, &command(MavCmd::MAV_CMD_NAV_LAND, 0.0));
    check(&sign(&land, &KEY, 7), MavResult::MAV_RESULT_UNSUPPORTED, None);
}
