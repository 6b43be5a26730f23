//! Depth, and the decoder of colour, allocate nothing once the scratch memory has grown to the
//! image's size.

use vizflyt_fixtures::CountingAllocator;
use vizflyt_rgbd::{ColorMode, Decoder, EncodeOptions, Encoder, RgbdView};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

#[test]
fn depth_allocates_for_the_first_image_only() {
    let depth_mm: Vec<u16> = (0..320 * 240).map(|n| (n * 7919 % 9000) as u16).collect();
    let view = RgbdView { width: 320, height: 240, rgb: &[], depth_mm: &depth_mm };
    let (mut encoder, mut decoder) = (Encoder::new(EncodeOptions::default()), Decoder::new());
    let (mut bytes, mut depth_out) = (Vec::new(), vec![0; depth_mm.len()]);
    let mut turn = || {
        let before = CountingAllocator::thread_allocations();
        encoder.encode(&view, &mut bytes).unwrap();
        decoder.decode(&bytes, &mut [], &mut depth_out).unwrap();
        CountingAllocator::thread_allocations() - before
    };
    assert!(turn() > 0, "the counter counts");
    for _ in 0..3 {
        assert_eq!(turn(), 0);
    }
    assert_eq!(depth_out, depth_mm);
}

#[test]
fn the_decoder_of_colour_allocates_for_the_first_image_only() {
    for color_mode in [ColorMode::Jpeg444, ColorMode::Jpeg420] {
        let rgb: Vec<u8> = (0..3 * 320 * 240).map(|n| (n * 7919 % 255) as u8).collect();
        let view = RgbdView { width: 320, height: 240, rgb: &rgb, depth_mm: &[] };
        let options = EncodeOptions { color_mode, ..EncodeOptions::default() };
        let mut bytes = Vec::new();
        Encoder::new(options).encode(&view, &mut bytes).unwrap();
        let mut decoder = Decoder::new();
        let mut back = vec![0; rgb.len()];
        let mut turn = || {
            let before = CountingAllocator::thread_allocations();
            decoder.decode(&bytes, &mut back, &mut []).unwrap();
            CountingAllocator::thread_allocations() - before
        };
        assert!(turn() > 0, "the counter counts");
        for _ in 0..3 {
            assert_eq!(turn(), 0, "{color_mode:?}");
        }
    }
}
