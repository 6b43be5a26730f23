//! NatNet packets after Motive's identification: counted and dropped, or a measurement with finite values. No packet
//! causes endless replies.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_protocol::time::ServerTime;
use vizflyt_server::poses::drivers::natnet::{Motive, NatnetStream};
use vizflyt_server::poses::drivers::udp::PoseStream;
use vizflyt_server::poses::settings::LocalizationConfig;

fuzz_target!(|input: (u8, Vec<(u8, &[u8])>)| {
    let (minor, packets) = input;
    let config = LocalizationConfig::parse("natnet,up=y,objects.wasp=7").unwrap();
    let motive = Motive::Unicast("127.0.0.1:1510".parse().unwrap());
    let mut source = NatnetStream::new(&config, 0, &["vizflyt", "wasp"], motive);
    // SERVERINFO: name, version of Motive and of the protocol, ticks per second, stream.
    let mut info = vec![1, 0, 0, 0];
    info.resize(4 + 256, b'm');
    info.extend_from_slice(&[3, 1, 0, 0, 3 + minor / 128, minor % 2, 0, 0]);
    info.extend_from_slice(&10_000_000u64.to_le_bytes());
    info.extend_from_slice(&[0xe7, 5, 0, 239, 255, 42, 99]);
    let start = ServerTime::from_ns(1_000_000_000);
    source.handle_packet(start, &info);
    for (index, (id, payload)) in packets.into_iter().enumerate() {
        let now = start.plus_ns(index as i64 * 5_000_000);
        let mut packet = vec![id % 16, 0, 0, 0];
        packet.extend_from_slice(payload);
        for measurement in source.handle_packet(now, &packet) {
            assert!(measurement.world_from_body.is_valid() && measurement.stamp <= now);
        }
        let mut sent = 0;
        while source.poll_transmit(now).is_some() {
            sent += 1;
            assert!(sent < 8);
        }
        while source.next_warning().is_some() {}
    }
});
