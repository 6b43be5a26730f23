//! Vicon datagrams: counted and dropped, or a measurement with finite values.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_protocol::time::ServerTime;
use vizflyt_server::poses::drivers::udp::PoseStream;
use vizflyt_server::poses::drivers::vicon::ViconStream;
use vizflyt_server::poses::settings::{Driver, LocalizationConfig};

fuzz_target!(|packets: Vec<&[u8]>| {
    let mut source =
        ViconStream::new(&LocalizationConfig::new(Driver::Vicon), 0, &["vizflyt", "wasp"]);
    for (index, packet) in packets.into_iter().enumerate() {
        let now = ServerTime::from_ns(index as u64 * 5_000_000);
        for measurement in source.handle_packet(now, packet) {
            assert!(measurement.world_from_body.is_valid());
        }
        while source.next_warning().is_some() {}
    }
});
