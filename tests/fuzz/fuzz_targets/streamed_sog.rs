//! Tree of an untrusted streamed SOG scene with valid chunks: an error or a valid scene.
#![no_main]
use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use vizflyt_splat::format::{Format, FormatError, Loaded, assemble_streamed, parse};

/// Maximum number of splats: chunks of 128 splats that a tree of the longest input can name.
const MAX_SPLATS: usize = 1 << 20;

static CHUNKS: LazyLock<[Loaded; 2]> = LazyLock::new(|| {
    let coarse = include_bytes!(
        "../../../render-server/splat/tests/data/formats/gaussforge-splat-sh0.splat"
    );
    let fine = include_bytes!(
        "../../../render-server/splat/tests/data/formats/splat-transform-sog-sh2.sog"
    );
    [parse(coarse, Format::Splat).expect("a scene"), parse(fine, Format::Sog).expect("a scene")]
});

fuzz_target!(|bytes: &[u8]| {
    let Some((&level, bytes)) = bytes.split_first() else { return };
    let open = |name: &str| -> Result<Loaded, FormatError> { Ok(CHUNKS[name.len() % 2].clone()) };
    vizflyt_fuzz::check_scene(assemble_streamed(bytes, u32::from(level), open), MAX_SPLATS);
});
