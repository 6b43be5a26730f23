//! Untrusted `.splat`: an error or a valid scene.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_splat::format::{Format, parse};

fuzz_target!(|bytes: &[u8]| {
    vizflyt_fuzz::check_scene(parse(bytes, Format::Splat), bytes.len());
});
