//! Network side of the bridge: datagrams of several senders, a TCP stream, configuration requests with and without the
//! key, time steps. No panic; settings change only with the key.
#![no_main]
use std::net::{Ipv4Addr, SocketAddrV4};

use libfuzzer_sys::arbitrary::{self, Arbitrary};
use libfuzzer_sys::fuzz_target;
use vizflyt_bridge::access::{self, TUNNEL_TYPE};
use vizflyt_bridge::bridge::CLIENTS;
use vizflyt_bridge::mavlink_writer::write_packet;
use vizflyt_bridge::packet::{CutStats, each_in_datagram};
use vizflyt_bridge::{Bridge, Chip, Settings};
use vizflyt_protocol::time::HostTime;

#[derive(Arbitrary, Debug)]
enum Step<'a> {
    Datagram(u8, &'a [u8]),
    /// A valid packet with this message id and payload.
    Packet(u8, u16, &'a [u8]),
    /// A configuration request, with or without a proof by the key.
    Request(&'a [u8], bool),
    Stream(u8, &'a [u8]),
    Open(u8),
    Close(u8),
    Uart(&'a [u8]),
    Pause(u16),
}

const KEY: [u8; 32] = [3; 32];

fuzz_target!(|steps: Vec<Step<'_>>| {
    let settings = Settings { key: Some(KEY), ..Settings::default() };
    let mut bridge = Bridge::new(HostTime::ZERO, settings, Chip::default());
    let mut now = HostTime::ZERO;
    let address = |last: u8| SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, last), 14550);
    for step in steps {
        let before = bridge.settings().clone();
        let mut proven = false;
        match step {
            Step::Datagram(from, bytes) => bridge.handle_datagram(now, address(from), bytes),
            Step::Packet(from, id, payload) => {
                let mut packet = [0; 280];
                let payload = &payload[..payload.len().min(255)];
                let len = write_packet(&mut packet, (255, from), 0, id.into(), payload);
                bridge.handle_datagram(now, address(from), &packet[..len]);
            }
            Step::Request(request, with_key) => {
                let mut request = request[..request.len().min(100)].to_vec();
                if with_key {
                    let proof = access::proof(&KEY, &access::nonce(&[0; 16]), &request);
                    request.extend_from_slice(&proof);
                    proven = true;
                }
                let [low, high] = TUNNEL_TYPE.to_le_bytes();
                let mut payload = vec![low, high, 1, 240, request.len() as u8];
                payload.extend_from_slice(&request);
                let mut packet = [0; 280];
                let len = write_packet(&mut packet, (255, 1), 0, 385, &payload);
                bridge.handle_datagram(now, address(1), &packet[..len]);
            }
            Step::Stream(slot, bytes) => bridge.handle_stream(now, slot, bytes),
            Step::Open(slot) => bridge.open_stream(now, slot),
            Step::Close(slot) => bridge.close_stream(slot),
            Step::Uart(bytes) => bridge.handle_uart(now, bytes),
            Step::Pause(ms) => {
                now = now.plus_ns(i64::from(ms) * 1_000_000);
                bridge.handle_timeout(now);
            }
        }
        assert!(proven || *bridge.settings() == before, "changed without the key");
        assert!(bridge.clients().count() <= CLIENTS);
        let mut packet = [0; 280];
        loop {
            let len = bridge.poll_uart(now, &mut packet);
            if len == 0 {
                break;
            }
            let mut cut = CutStats::default();
            each_in_datagram(&packet[..len], &mut cut, |_| {});
            assert_eq!((cut.packets, cut.dropped_bytes), (1, 0), "one whole packet");
        }
        let mut out = [0; 1472];
        while bridge.poll_udp(now, &mut out).is_some() {}
        for slot in 0..3 {
            while bridge.poll_tcp(now, slot, &mut out) > 0 {}
        }
        while bridge.poll_event().is_some() {}
    }
});
