//! Pose packets in JSON: counted and dropped, or a measurement with finite values.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_protocol::time::ServerTime;
use vizflyt_server::poses::drivers::json::JsonStream;
use vizflyt_server::poses::drivers::udp::PoseStream;
use vizflyt_server::poses::settings::LocalizationConfig;

fuzz_target!(|packets: Vec<&[u8]>| {
    let config = LocalizationConfig::parse("json,up=y,units=mm,nose=-y").unwrap();
    let mut source = JsonStream::new(&config, 0, &["vizflyt", "wasp"]);
    for (index, packet) in packets.into_iter().enumerate() {
        let now = ServerTime::from_ns(1_000_000_000 + index as u64 * 5_000_000);
        for measurement in source.handle_packet(now, packet) {
            assert!(measurement.world_from_body.is_valid() && measurement.stamp <= now);
            if let Some(sigma) = measurement.sigma {
                assert!(sigma.position_m.is_finite() && sigma.rotation_rad.is_finite());
            }
        }
        while source.next_warning().is_some() {}
    }
});
