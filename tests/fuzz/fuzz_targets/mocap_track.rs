//! Untrusted recording of a motion capture.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_twin::align::recording;

fuzz_target!(|bytes: &[u8]| {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    match recording::parse(text) {
        Ok(track) => {
            assert!(track.len() >= 2 && track.len() <= bytes.len());
            assert!(track.iter().all(|t| t.at_s.is_finite() && t.position_m.is_finite()));
            assert!(track.windows(2).all(|two| two[0].at_s < two[1].at_s));
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
});
