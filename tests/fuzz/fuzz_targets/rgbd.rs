//! Complete RGB-D bitstream: an error, or an image of the stated size; bounded time and memory.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_rgbd::{Decoder, ImageMut, peek};

fuzz_target!(|bytes: &[u8]| {
    let Ok(info) = peek(bytes) else { return };
    let pixels = info.width as usize * info.height as usize;
    // Like the receiver, which knows the size from the image header and rejects others.
    if pixels > 1 << 20 {
        return;
    }
    let parts = info.parts();
    let room = |present: bool, len: usize| if present { len } else { 0 };
    let mut rgb = vec![0; room(parts.color, 3 * pixels)];
    let mut depth_mm = vec![0; room(parts.depth, pixels)];
    let mut alpha = vec![0; room(parts.alpha, pixels)];
    let mut ids = vec![0; room(parts.ids, pixels)];
    let mut out =
        ImageMut { rgb: &mut rgb, depth_mm: &mut depth_mm, alpha: &mut alpha, ids: &mut ids };
    let mut decoder = Decoder::new();
    let at_once = decoder.decode_image(bytes, &mut out);
    // Incremental decoding must have the same result.
    decoder.restart();
    let half = decoder.feed(&bytes[..bytes.len() / 2], &mut out);
    let fed = half.and_then(|_| decoder.feed(bytes, &mut out));
    assert!(at_once.is_err() || fed.is_ok_and(|progress| progress.complete));
});
