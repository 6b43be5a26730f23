//! Encoder and decoder of depth and colour allocate nothing after the scratch memory has grown to the size of the
//! image.

use vizflyt_fixtures::CountingAllocator;
use vizflyt_rgbd::{ColorMode, Decoder, EncodeOptions, Encoder, RgbdView};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

#[test]
fn depth_allocates_only_for_the_first_image() {
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
fn colour_and_depth_allocate_only_for_the_first_image() {
    let rgb: Vec<u8> = (0..3 * 330 * 240).map(|n| (n * 7919 % 251) as u8).collect();
    let depth_mm: Vec<u16> = (0..330 * 240).map(|n| (n * 7919 % 9000) as u16).collect();
    let view = RgbdView { width: 330, height: 240, rgb: &rgb, depth_mm: &depth_mm };
    let (mut rgb_out, mut depth_out) = (vec![0; rgb.len()], vec![0; depth_mm.len()]);
    for color_mode in [ColorMode::Jpeg444, ColorMode::Jpeg420] {
        let mut encoder = Encoder::new(EncodeOptions { color_mode, ..EncodeOptions::default() });
        let (mut decoder, mut bytes) = (Decoder::new(), Vec::new());
        let mut turn = || {
            let before = CountingAllocator::thread_allocations();
            encoder.encode(&view, &mut bytes).unwrap();
            decoder.decode(&bytes, &mut rgb_out, &mut depth_out).unwrap();
            CountingAllocator::thread_allocations() - before
        };
        assert!(turn() > 0, "the counter counts");
        for _ in 0..3 {
            assert_eq!(turn(), 0, "{color_mode:?}");
        }
    }
}
