//! Untrusted `.spz`: an error or a valid scene. Most inputs fail the gzip stream's checksum, so the bytes are also used
//! as the inflated stream.
#![no_main]
use std::io::Write as _;

use flate2::Compression;
use flate2::write::GzEncoder;
use libfuzzer_sys::fuzz_target;
use vizflyt_splat::format::{Format, parse};

/// More splats than a file of the longest input may inflate to.
const MAX_SPLATS: usize = 1 << 20;

fuzz_target!(|bytes: &[u8]| {
    vizflyt_fuzz::check_scene(parse(bytes, Format::Spz), MAX_SPLATS);
    let mut stream = GzEncoder::new(Vec::new(), Compression::none());
    stream.write_all(bytes).expect("memory");
    let wrapped = stream.finish().expect("memory");
    vizflyt_fuzz::check_scene(parse(&wrapped, Format::Spz), MAX_SPLATS);
});
