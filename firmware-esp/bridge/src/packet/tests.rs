extern crate std;

use std::vec;
use std::vec::Vec;

use proptest::prelude::*;
use vizflyt_protocol::mavlink::dialect::{
    COMMAND_LONG_DATA, HEARTBEAT_DATA, MavCmd, MavMessage, TIMESYNC_DATA,
};
use vizflyt_protocol::mavlink::{MavHeader, encode};

use super::*;

/// Returns a message as MAVLink 2 bytes.
pub(crate) fn v2(sequence: u8, from: (u8, u8), message: &MavMessage) -> Vec<u8> {
    let header = MavHeader { system_id: from.0.into(), component_id: from.1, sequence };
    encode(header, message, &mut [0; MAX_PACKET]).to_vec()
}

/// Returns a packet of a message outside of the dialect, with the CRC_EXTRA `extra`.
fn unknown(id: u32, payload: &[u8], extra: u8) -> Vec<u8> {
    let mut bytes = vec![0xFD, payload.len() as u8, 0, 0, 7, 1, 1];
    bytes.extend_from_slice(&id.to_le_bytes()[..3]);
    bytes.extend_from_slice(payload);
    let crc = bytes[1..].iter().chain([&extra]).fold(0xFFFF, |crc, &byte| x25(crc, byte));
    bytes.extend_from_slice(&crc.to_le_bytes());
    bytes
}

/// Returns a signed packet in wire format. Its signature is not valid, because it is not verified.
fn signed(message: &MavMessage) -> Vec<u8> {
    let mut bytes = v2(3, (255, 190), message);
    let crc_at = bytes.len() - 2;
    bytes[2] = SIGNED;
    let extra = MavMessage::extra_crc(message_id(&bytes));
    let crc = bytes[1..crc_at].iter().chain([&extra]).fold(0xFFFF, |crc, &byte| x25(crc, byte));
    bytes[crc_at..].copy_from_slice(&crc.to_le_bytes());
    bytes.extend_from_slice(&[9, 1, 2, 3, 4, 5, 6, 0xFD, 0xFE, 10, 11, 12, 13]);
    bytes
}

fn stream() -> Vec<Vec<u8>> {
    let timesync = MavMessage::TIMESYNC(TIMESYNC_DATA {
        tc1: i64::from_le_bytes([0xFD; 8]),
        ts1: i64::from_le_bytes([0xFE; 8]),
        ..Default::default()
    });
    vec![
        v2(0, (1, 1), &MavMessage::HEARTBEAT(HEARTBEAT_DATA::default())),
        signed(&timesync),
        unknown(0x12_3456, &[1, 2, 3, 0xFD, 4], 77),
        // MAVLink 1 HEARTBEAT, captured from pymavlink 2.4.
        vec![0xFE, 9, 5, 255, 190, 0, 0, 0, 0, 0, 6, 8, 0, 0, 3, 205, 0xB6],
        v2(9, (1, 1), &timesync),
    ]
}

fn cut_up(bytes: &[u8], chunk: usize) -> (Vec<Vec<u8>>, CutStats) {
    let (mut cutter, mut found) = (Cutter::default(), Vec::new());
    for part in bytes.chunks(chunk) {
        cutter.push(part, |packet| found.push(packet.bytes().to_vec()));
    }
    cutter.look_behind(|_| panic!("nothing hides behind whole packets"));
    (found, cutter.stats())
}

#[test]
fn cuts_packets_unchanged_at_every_chunk_size() {
    let mut packets = stream();
    let v1 = packets.remove(3);
    let v1_crc = v1[1..15].iter().chain([&50]).fold(0xFFFF, |crc, &byte| x25(crc, byte));
    let mut v1 = v1;
    v1[15..].copy_from_slice(&v1_crc.to_le_bytes());
    packets.push(v1);
    let bytes = packets.concat();
    for chunk in 1..=bytes.len() {
        let (found, stats) = cut_up(&bytes, chunk);
        assert_eq!(found, packets, "chunk size {chunk}");
        assert_eq!((stats.dropped_bytes, stats.bad_checksum, stats.unknown), (0, 0, 1));
    }
}

#[test]
fn reads_headers() {
    let command = MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_NAV_LAND,
        target_system: 1,
        target_component: 240,
        ..Default::default()
    });
    let bytes = v2(200, (255, 191), &command);
    let mut seen = 0;
    each_in_datagram(&bytes, &mut CutStats::default(), |packet| {
        seen += 1;
        assert_eq!((packet.sequence(), packet.source()), (200, (255, 191)));
        assert_eq!((packet.id(), packet.target()), (76, (1, 240)));
        assert!(packet.is_v2() && !packet.is_signed());
    });
    assert_eq!(seen, 1);
}

#[test]
fn finds_a_packet_behind_a_false_start_after_silence() {
    let good = stream().swap_remove(0);
    let mut bytes = vec![0xFD, 250, 0];
    bytes.extend_from_slice(&good);
    let mut cutter = Cutter::default();
    cutter.push(&bytes, |_| panic!("it must wait for the long packet's end"));
    assert!(cutter.is_waiting());
    let mut found = Vec::new();
    cutter.look_behind(|packet| found.push(packet.bytes().to_vec()));
    assert_eq!(found, [good]);
    assert!(!cutter.is_waiting());
    assert_eq!((cutter.stats().dropped_bytes, cutter.stats().bad_checksum), (3, 1));
}

#[test]
fn does_not_cut_a_packet_out_of_a_payload() {
    let inner = stream().swap_remove(0);
    let mut payload = inner.clone();
    payload.extend_from_slice(&[7; 40]);
    let mut outer = [0; MAX_PACKET];
    let len = crate::mavlink_writer::write_packet(&mut outer, (1, 1), 0, 385, &payload);
    for pause in 1..len {
        // The inner packet ends with the received bytes, so it could be a packet.
        if pause == 10 + inner.len() {
            continue;
        }
        let (mut cutter, mut found) = (Cutter::default(), Vec::new());
        cutter.push(&outer[..pause], |_| panic!("it is not whole"));
        cutter.look_behind(|_| panic!("a payload is no packet, paused after {pause} bytes"));
        cutter.push(&outer[pause..len], |packet| found.push(packet.bytes().to_vec()));
        assert_eq!(found, [outer[..len].to_vec()], "paused after {pause} bytes");
    }
}

#[test]
fn cuts_whole_packets_of_a_truncated_datagram() {
    let packets = stream();
    let mut bytes = packets[0].clone();
    bytes.extend_from_slice(&packets[1][..20]);
    let (mut stats, mut found) = (CutStats::default(), Vec::new());
    each_in_datagram(&bytes, &mut stats, |packet| found.push(packet.bytes().to_vec()));
    assert_eq!(found, packets[..1]);
    assert_eq!(stats.dropped_bytes, 20);
}

#[test]
fn rejects_changed_bytes() {
    for packet in stream().into_iter().filter(|packet| packet[0] == 0xFD && packet[2] == 0) {
        if message_id(&packet) == 0x12_3456 {
            continue; // The CRC_EXTRA is unknown: one change in 256 passes.
        }
        for at in 0..packet.len() {
            let mut broken = packet.clone();
            broken[at] ^= 0x40;
            each_in_datagram(&broken, &mut CutStats::default(), |found| {
                assert_ne!(found.bytes().len(), packet.len(), "byte {at}");
            });
        }
    }
}

proptest! {
    /// After garbage of any content, all good packets are returned in order, at the latest after as many bytes as a
    /// packet may have.
    #[test]
    fn garbage_hides_no_good_packet(
        garbage in prop::collection::vec(any::<u8>(), 0..600),
        chunk in 1..64usize,
        pause in any::<bool>(),
    ) {
        let (mut cutter, mut found) = (Cutter::default(), Vec::new());
        let heartbeat = MavMessage::HEARTBEAT(HEARTBEAT_DATA::default());
        let mut bytes = garbage;
        let good: Vec<Vec<u8>> = (0..20).map(|number| v2(number, (1, 1), &heartbeat)).collect();
        bytes.extend(good.concat());
        for part in bytes.chunks(chunk) {
            let mut sink = |packet: Raw<'_>| found.push(packet.bytes().to_vec());
            cutter.push(part, &mut sink);
            if pause {
                cutter.look_behind(&mut sink);
            }
        }
        cutter.push(&[0; MAX_PACKET], |packet| found.push(packet.bytes().to_vec()));
        // For unknown messages, one in 256 pieces of garbage passes; see the module.
        prop_assume!(cutter.stats().unknown == 0);
        prop_assert_eq!(found, good);
    }
}
