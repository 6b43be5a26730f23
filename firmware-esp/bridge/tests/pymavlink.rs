//! Packets that another implementation made, every message of the dialect once: MAVLink 1 and 2,
//! signed and not. `tests/clients/capture.py` made them.

use core::net::{Ipv4Addr, SocketAddrV4};

use vizflyt_bridge::packet::{CutStats, Cutter, each_in_datagram};
use vizflyt_bridge::{Bridge, Chip, Settings};
use vizflyt_protocol::mavlink::MAX_PACKET;
use vizflyt_protocol::time::HostTime;

const BYTES: &[u8] = include_bytes!("data/pymavlink.bin");
const LINES: &str = include_str!("data/pymavlink.txt");

/// What a packet is: its bytes, and what pymavlink read from it.
struct Expected {
    bytes: &'static [u8],
    id: u32,
    source: (u8, u8),
    sequence: u8,
    signed: bool,
    target: (u8, u8),
}

fn expected() -> Vec<Expected> {
    let mut rest = BYTES;
    let packets: Vec<Expected> = LINES
        .lines()
        .skip(1)
        .map(|line| {
            let number: Vec<u32> = line.split(' ').map(|word| word.parse().unwrap()).collect();
            let (bytes, behind) = rest.split_at(number[0] as usize);
            rest = behind;
            Expected {
                bytes,
                id: number[1],
                source: (number[2] as u8, number[3] as u8),
                sequence: number[4] as u8,
                signed: number[5] == 1,
                target: (number[6] as u8, number[7] as u8),
            }
        })
        .collect();
    assert!(rest.is_empty() && packets.len() > 250);
    packets
}

#[test]
fn every_packet_is_cut_at_every_chunk_size() {
    let expected = expected();
    for chunk in (1..=600).chain([BYTES.len()]) {
        let mut cutter = Cutter::default();
        let mut place = 0;
        for part in BYTES.chunks(chunk) {
            cutter.push(part, |packet| {
                assert_eq!(packet.bytes(), expected[place].bytes, "packet {place}, chunk {chunk}");
                place += 1;
            });
        }
        assert_eq!(place, expected.len(), "chunk {chunk}");
        let stats = cutter.stats();
        assert_eq!((stats.dropped_bytes, stats.bad_checksum), (0, 0), "chunk {chunk}");
        // Every message is known by its own checksum, but for one whose CRC_EXTRA is 0 (395).
        assert!(stats.unknown <= 1, "chunk {chunk}: {stats:?}");
    }
}

#[test]
fn headers_and_targets_are_read_as_pymavlink_wrote_them() {
    for expected in expected() {
        let mut seen = 0;
        each_in_datagram(expected.bytes, &mut CutStats::default(), |packet| {
            seen += 1;
            assert_eq!(packet.id(), expected.id);
            assert_eq!(packet.source(), expected.source, "message {}", expected.id);
            assert_eq!(packet.sequence(), expected.sequence, "message {}", expected.id);
            assert_eq!(packet.is_signed(), expected.signed, "message {}", expected.id);
            assert_eq!(packet.target(), expected.target, "message {}", expected.id);
        });
        assert_eq!(seen, 1, "message {}", expected.id);
    }
}

/// The whole way: into the serial side in portions, out as datagrams, byte for byte.
#[test]
fn the_bridge_passes_them_on_unchanged() {
    let client = SocketAddrV4::new(Ipv4Addr::LOCALHOST, 14550);
    for portion in [1, 7, 64, 128, 300] {
        let settings =
            Settings { client: Some(client), radio_status: false, ..Settings::default() };
        let mut bridge = Bridge::new(HostTime::ZERO, settings, Chip::default());
        let (mut out, mut came) = ([0; 1472], Vec::new());
        // Whole within the first second: the bridge sends nothing of its own yet.
        for (step, part) in BYTES.chunks(portion).enumerate() {
            let now = HostTime::from_ns(step as u64 * 20_000);
            bridge.handle_uart(now, part);
            while let Some((_, len)) = bridge.poll_udp(now, &mut out) {
                came.extend_from_slice(&out[..len]);
            }
            let mut packet = [0; MAX_PACKET];
            assert_eq!(bridge.poll_uart(now, &mut packet), 0);
        }
        let later = HostTime::from_ns(900_000_000);
        while let Some((_, len)) = bridge.poll_udp(later, &mut out) {
            came.extend_from_slice(&out[..len]);
        }
        // HEARTBEAT and the answers to (7, 9) are for everybody here: nothing is left out.
        assert_eq!(came, BYTES, "portions of {portion}");
        assert_eq!(bridge.stats().uart.cut.packets as usize, expected().len());
    }
}
