//! SuperSplat's compressed PLY from a stranger: an error or a sound scene. Seeds lead here; the
//! plain PLY has a target of its own.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_splat::format::{Format, parse};

fuzz_target!(|bytes: &[u8]| {
    vizflyt_fuzz::check_scene(parse(bytes, Format::CompressedPly), bytes.len());
});
