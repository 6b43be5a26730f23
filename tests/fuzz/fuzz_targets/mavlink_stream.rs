//! MAVLink bytes in chunks of any size: no panic, and every byte is counted.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_protocol::mavlink::StreamDecoder;

fuzz_target!(|input: (u8, &[u8])| {
    let (chunk, bytes) = input;
    let mut decoder = StreamDecoder::default();
    for part in bytes.chunks(usize::from(chunk) + 1) {
        decoder.push(part, |packet| drop(packet.message));
    }
    let stats = decoder.stats();
    assert!(stats.dropped_bytes <= bytes.len() as u64);
    assert!((stats.packets + stats.unknown) * 8 <= bytes.len() as u64);
});
