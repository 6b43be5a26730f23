//! Untrusted glTF scene: an error or a valid scene. The first byte selects whether the others are the complete file, or
//! the JSON before a valid scene's buffer.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_splat::format::{Format, parse};

/// More splats than the smallest file may hold.
const MAX_SPLATS: usize = 1 << 20;

const GOOD: &[u8] =
    include_bytes!("../../../render-server/splat/tests/data/formats/splat-transform-glb-sh2.glb");

fuzz_target!(|bytes: &[u8]| {
    let Some((&choice, bytes)) = bytes.split_first() else { return };
    if choice % 2 == 0 {
        vizflyt_fuzz::check_scene(parse(bytes, Format::Gltf), MAX_SPLATS);
        return;
    }
    let word = |at: usize| u32::from_le_bytes(GOOD[at..at + 4].try_into().expect("four bytes"));
    let binary = &GOOD[20 + word(12) as usize..];
    let mut wrapped = GOOD[..12].to_vec();
    wrapped.extend_from_slice(&(bytes.len() as u32).to_le_bytes());
    wrapped.extend_from_slice(b"JSON");
    wrapped.extend_from_slice(bytes);
    wrapped.extend_from_slice(binary);
    vizflyt_fuzz::check_scene(parse(&wrapped, Format::Gltf), MAX_SPLATS);
});
