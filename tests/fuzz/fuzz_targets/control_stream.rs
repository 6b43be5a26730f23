//! Control streams of both sides: framing and messages.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_protocol::messages::{FromPlugin, ToPlugin, ToRuntime, ToServer};
use vizflyt_protocol::packet::framing::{Deframer, FramingError, decode_body};
use vizflyt_protocol::packet::{PeerRole, Preamble};

fn drain<M: serde::de::DeserializeOwned>(mut bytes: &[u8]) {
    let mut deframer = Deframer::default();
    while !bytes.is_empty() {
        bytes = &bytes[deframer.push(bytes)..];
        while let Some(message) = deframer.next::<M>() {
            // A length beyond the limit ends the stream; the driver closes the connection.
            if matches!(message, Err(FramingError::TooLong(_))) {
                return;
            }
        }
    }
}

fuzz_target!(|bytes: &[u8]| {
    if let Some(preamble) = bytes.first_chunk::<{ Preamble::SIZE }>() {
        let _ = Preamble::check(preamble, PeerRole::Server);
    }
    drain::<ToServer>(bytes);
    drain::<ToRuntime>(bytes);
    let _ = decode_body::<ToPlugin>(bytes);
    let _ = decode_body::<FromPlugin>(bytes);
});
