//! Datagrams of an autopilot whose estimate is the localization: counted and dropped, or a measurement with finite
//! values. Messages consist of the fuzzer's bytes with a valid checksum.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_protocol::mavlink::dialect::MavMessage;
use vizflyt_protocol::mavlink::{MAX_PACKET, MavHeader, MavlinkVersion, Message, encode};
use vizflyt_protocol::time::ServerTime;
use vizflyt_server::poses::drivers::mavlink::MavlinkStream;
use vizflyt_server::poses::drivers::udp::PoseStream;
use vizflyt_server::poses::settings::LocalizationConfig;

const IDS: [u32; 5] = [0, 30, 31, 32, 331];

fuzz_target!(|packets: Vec<(u8, &[u8])>| {
    let config = LocalizationConfig::parse("mavlink,objects.wasp=2").unwrap();
    let mut source = MavlinkStream::new(&config, 0, &["vizflyt", "wasp"]);
    for (index, (kind, bytes)) in packets.into_iter().enumerate() {
        let now = ServerTime::from_ns(1_000_000_000 + index as u64 * 5_000_000);
        let id = IDS[usize::from(kind) % IDS.len()];
        let mut buffer = [0; MAX_PACKET];
        let packet = match MavMessage::parse(MavlinkVersion::V2, id, bytes) {
            Ok(message) => {
                let system_id = 1 + u32::from(kind / 128);
                let header = MavHeader { system_id, component_id: 1, sequence: 0 };
                encode(header, &message, &mut buffer)
            }
            Err(_) => bytes,
        };
        let from = "127.0.0.1:14550".parse().unwrap();
        for measurement in source.handle_packet_from(now, from, packet) {
            assert!(measurement.world_from_body.is_valid() && measurement.stamp <= now);
            if let Some(sigma) = measurement.sigma {
                assert!(sigma.position_m.is_finite() && sigma.rotation_rad.is_finite());
            }
        }
        let mut sent = 0;
        while source.poll_transmit(now).is_some() {
            sent += 1;
            assert!(sent < 8);
        }
        while source.next_warning().is_some() {}
    }
});
