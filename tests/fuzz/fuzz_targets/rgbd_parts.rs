//! Decoders of the RGB-D parts without the headers: a valid header of a small image in the modes given by the first
//! byte, then arbitrary bytes of a part.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_rgbd::depth::{DepthDecoder, scalar};
use vizflyt_rgbd::{
    ColorMode, Decoder, DepthMode, EncodeOptions, Encoder, ImageMut, Parts, SLICE_HEADER_BYTES,
};

fuzz_target!(|bytes: &[u8]| {
    let Some((&choice, part)) = bytes.split_first() else { return };
    let (width, height) = (if choice & 1 == 0 { 24 } else { 133 }, 16);
    let pixels = (width * height) as usize;
    let options = EncodeOptions {
        color_mode: match choice >> 1 & 3 {
            0 => ColorMode::Jpeg444,
            1 => ColorMode::Jpeg420,
            _ => ColorMode::Lossless,
        },
        depth_mode: if choice >> 3 & 1 == 0 { DepthMode::Fast } else { DepthMode::Small },
        ..EncodeOptions::default()
    };
    let which = usize::from(choice >> 4 & 3);
    let parts = Parts { color: which == 0, depth: which == 1, alpha: which == 2, ids: which == 3 };
    let mut header = Vec::new();
    Encoder::new(options).start(width, height, parts, &mut header).expect("a good image");
    let mut slice = vec![0; SLICE_HEADER_BYTES];
    slice[4 + 4 * which..][..4].copy_from_slice(&(part.len() as u32).to_le_bytes());
    slice.extend_from_slice(part);

    let (mut rgb, mut depth_mm) = (vec![0; 3 * pixels], vec![0; pixels]);
    let (mut alpha, mut ids) = (vec![0; pixels], vec![0; pixels]);
    let mut out = ImageMut::default();
    match which {
        0 => out.rgb = &mut rgb,
        1 => out.depth_mm = &mut depth_mm,
        2 => out.alpha = &mut alpha,
        _ => out.ids = &mut ids,
    }
    let mut decoder = Decoder::new();
    decoder.start(&header).expect("a true header");
    let _ = decoder.push_slice(&slice, &mut out);

    // The fast depth decoder and its reference must agree on any bytes.
    let (mut fast, mut reference) = (vec![0; pixels], vec![0; pixels]);
    let result = DepthDecoder::default().decode(part, width as usize, &mut fast);
    assert_eq!(result, scalar::decode(part, width as usize, &mut reference));
    assert!(result.is_err() || fast == reference);
});
