//! Datagrams of the server, which a runtime decodes without framing.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_protocol::messages::Datagram;
use vizflyt_protocol::packet::framing::{MAX_FRAMED, decode_body, encode_body};

fuzz_target!(|bytes: &[u8]| {
    let Ok(Datagram::Pose(pose)) = decode_body::<Datagram>(bytes) else { return };
    let mut buffer = [0; MAX_FRAMED];
    let again = decode_body(encode_body(&Datagram::Pose(pose), &mut buffer));
    if pose.is_valid() {
        assert_eq!(again, Ok(Datagram::Pose(pose)));
        assert!(pose.world_from_body.translation_m.is_finite());
        assert!(pose.twist.linear_mps.is_finite());
    }
});
