//! The RGB-D bitstream: an error, or an image of the size it says; bounded time and memory.
#![no_main]
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let Ok(info) = vizflyt_rgbd::peek(bytes) else { return };
    let pixels = info.width as usize * info.height as usize;
    // What the receiver does: it knows the size from the image header and refuses others.
    if pixels > 1 << 20 {
        return;
    }
    let (mut rgb, mut depth) = (vec![0; 3 * pixels], vec![0; pixels]);
    let _ = vizflyt_rgbd::Decoder::new().decode(bytes, &mut rgb, &mut depth);
});
