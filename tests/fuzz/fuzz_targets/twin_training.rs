//! Untrusted checkpoint of a training: an error, or valid and written as the same bytes.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_twin::train::Checkpoint;

fuzz_target!(|bytes: &[u8]| {
    match Checkpoint::from_bytes(bytes) {
        Ok(checkpoint) => assert_eq!(checkpoint.to_bytes(), bytes),
        Err(error) => assert!(!error.to_string().is_empty()),
    }
});
