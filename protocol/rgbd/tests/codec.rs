//! Tests of the whole bitstream: round trips, slices, errors.

use proptest::prelude::*;
use vizflyt_rgbd::{
    ColorMode, DecodeError, Decoder, DepthBound, DepthMode, EncodeError, EncodeOptions, Encoder,
    HEADER_BYTES, ImageMut, ImageView, Parts, RgbdView, encode_jpeg, peek, slice_len,
};

mod picture;
use picture::Picture;

const SMALLEST: EncodeOptions = EncodeOptions {
    jpeg_quality: 93,
    color_mode: ColorMode::Lossless,
    depth_mode: DepthMode::Small,
    depth_bound: None,
    slices: 3,
};

#[test]
fn all_parts_survive_at_odd_sizes_in_every_mode() {
    let mut decoder = Decoder::new();
    for (width, height) in [(320, 240), (1, 1), (7, 5), (33, 65), (640, 1), (1, 480), (130, 200)] {
        let picture = Picture::new(width, height);
        for color_mode in [ColorMode::Jpeg444, ColorMode::Jpeg420, ColorMode::Lossless] {
            for depth_mode in [DepthMode::Fast, DepthMode::Small] {
                let options = EncodeOptions { color_mode, depth_mode, ..EncodeOptions::default() };
                let bytes = picture.encode(options);
                let info = peek(&bytes).unwrap();
                assert_eq!((info.width, info.height), (width, height));
                assert_eq!((info.color, info.depth), (Some(color_mode), Some(depth_mode)));
                let back = Picture::decode(&mut decoder, &bytes).unwrap();
                assert!(back.depth_mm == picture.depth_mm, "{depth_mode:?} {width}x{height}");
                assert!(back.alpha == picture.alpha && back.ids == picture.ids);
                let psnr = picture::psnr_db(&picture.rgb, &back.rgb);
                let least = match color_mode {
                    ColorMode::Jpeg444 => 38.0,
                    ColorMode::Jpeg420 => 30.0,
                    ColorMode::Lossless => f64::INFINITY,
                };
                assert!(psnr >= least, "{psnr:.1} dB, {color_mode:?} at {width}x{height}");
            }
        }
    }
}

#[test]
fn bounded_depth_keeps_its_bound_and_holes() {
    let picture = Picture::new(160, 120);
    for depth_mode in [DepthMode::Fast, DepthMode::Small] {
        let mut lens = Vec::new();
        for k in [None, Some(1e-6), Some(0.001), Some(0.05)] {
            let bound = k.and_then(DepthBound::new);
            let options = EncodeOptions { depth_mode, depth_bound: bound, ..SMALLEST };
            let bytes = picture.encode(options);
            assert_eq!(peek(&bytes).unwrap().depth_bound, bound);
            let back = Picture::decode(&mut Decoder::new(), &bytes).unwrap();
            for (&truth, &decoded) in picture.depth_mm.iter().zip(&back.depth_mm) {
                assert_eq!(truth == 0, decoded == 0);
                let allowed = bound.map_or(0, |bound| bound.error_mm(truth));
                assert!(truth.abs_diff(decoded) <= allowed, "{truth} came back as {decoded}");
            }
            lens.push(bytes.len());
        }
        assert!(lens[1..].is_sorted_by(|a, b| a > b), "a wider bound is smaller: {lens:?}");
    }
}

#[test]
fn quality_sets_the_size_and_can_change_for_each_image() {
    let picture = Picture::new(160, 120);
    let mut encoder = Encoder::new(EncodeOptions::default());
    let mut lens = Vec::new();
    for jpeg_quality in [40, 95, 40] {
        encoder.set_options(EncodeOptions { jpeg_quality, ..EncodeOptions::default() });
        let mut bytes = Vec::new();
        encoder.encode(picture.view(), &mut bytes).unwrap();
        Picture::decode(&mut Decoder::new(), &bytes).unwrap();
        lens.push(bytes.len());
    }
    assert!(lens[0] < lens[1] && lens[0] == lens[2], "{lens:?}");
    encoder.set_options(EncodeOptions { jpeg_quality: 0, ..EncodeOptions::default() });
    let refused = encoder.encode(picture.view(), &mut Vec::new());
    assert_eq!(refused, Err(EncodeError::Quality(0)));
    let refused = encode_jpeg(&picture.rgb, 160, 120, 101, &mut Vec::new());
    assert_eq!(refused, Err(EncodeError::Quality(101)));
}

#[test]
fn encodes_slices_one_by_one_and_decodes_them_in_any_order() {
    let picture = Picture::new(200, 150);
    let mut encoder = Encoder::new(SMALLEST);
    let mut bytes = Vec::new();
    let info = encoder.start(200, 150, picture.view().parts(), &mut bytes).unwrap();
    assert_eq!((info.slices, info.header_len), (3, bytes.len()));
    let mut slices = Vec::new();
    for slice in 0..info.slices {
        let mut one = Vec::new();
        let rows = picture.view().rows(info.slice_rows(slice));
        assert_eq!(encoder.push_slice(&rows, &mut one), Ok(slice + 1 == info.slices));
        assert_eq!(slice_len(&one), Some(one.len() as u64));
        slices.push(one);
    }
    let mut whole = bytes.clone();
    whole.extend(slices.iter().flatten());
    assert_eq!(whole, picture.encode(SMALLEST), "the same bytes as at once");

    let mut back = Picture::blank(200, 150);
    let mut decoder = Decoder::new();
    assert_eq!(decoder.start(&bytes).unwrap(), info);
    for slice in [2, 0, 1] {
        assert!(!decoder.is_complete());
        let rows = decoder.push_slice(&slices[slice], &mut back.room()).unwrap();
        assert_eq!(rows, info.slice_rows(slice as u8));
        let again = decoder.push_slice(&slices[slice], &mut back.room());
        assert_eq!(again, Err(DecodeError::Slice(slice as u16)));
    }
    assert!(decoder.is_complete() && back == picture);
}

#[test]
fn decodes_bytes_in_chunks_of_any_length() {
    let picture = Picture::new(96, 96);
    let bytes = picture.encode(SMALLEST);
    let mut decoder = Decoder::new();
    for chunk in [1, 2, 7, 19, 20, 21, 100, 1000, bytes.len()] {
        let mut back = Picture::blank(96, 96);
        let (mut rows, mut turns) = (0, 0);
        decoder.restart();
        let mut complete = false;
        for end in (0..bytes.len()).step_by(chunk).skip(1).chain([bytes.len()]) {
            assert!(!complete, "complete before the end");
            let progress = decoder.feed(&bytes[..end], &mut back.room()).unwrap();
            assert!(progress.rows.is_empty() || progress.rows.start == rows);
            rows = rows.max(progress.rows.end);
            turns += usize::from(!progress.rows.is_empty());
            complete = progress.complete;
        }
        assert!(complete && back == picture, "in chunks of {chunk}");
        assert!(turns == if chunk < 100 { 3 } else { turns }, "{turns} slices came apart");
    }
}

#[test]
fn rejects_unexpected_slices_and_continues_the_image() {
    let picture = Picture::new(40, 60);
    let mut encoder = Encoder::new(EncodeOptions { slices: 2, ..EncodeOptions::default() });
    let (mut out, view) = (Vec::new(), picture.view());
    let refused = encoder.push_slice(&view, &mut out);
    assert_eq!(refused, Err(EncodeError::Rows { width: 40, found: 60, expected: 0 }));
    encoder.start(40, 60, view.parts(), &mut out).unwrap();
    let refused = encoder.push_slice(&view.rows(0..31), &mut out);
    assert_eq!(refused, Err(EncodeError::Rows { width: 40, found: 31, expected: 32 }));
    let refused = encoder.push_slice(&ImageView { ids: &[], ..view.rows(0..32) }, &mut out);
    assert_eq!(refused, Err(EncodeError::Rows { width: 40, found: 0, expected: 32 }));
    assert_eq!(encoder.push_slice(&view.rows(0..32), &mut out), Ok(false));
    assert_eq!(encoder.push_slice(&view.rows(32..60), &mut out), Ok(true));
    assert_eq!(Picture::decode(&mut Decoder::new(), &out).unwrap().depth_mm, picture.depth_mm);
    let none = Parts::default();
    encoder.set_options(EncodeOptions { slices: 65, ..EncodeOptions::default() });
    assert_eq!(encoder.start(40, 60, none, &mut out), Err(EncodeError::Slices(65)));
}

#[test]
fn parts_may_be_absent_or_skipped() {
    let picture = Picture::new(40, 30);
    let (rgb, depth) = (&picture.rgb, &picture.depth_mm);
    let mut decoder = Decoder::new();
    let mut only_depth = Vec::new();
    let view = RgbdView { width: 40, height: 30, rgb: &[], depth_mm: depth };
    Encoder::default().encode(&view, &mut only_depth).unwrap();
    assert_eq!(peek(&only_depth).unwrap().header_len, HEADER_BYTES, "no JPEG tables");
    let mut depth_out = vec![0; depth.len()];
    decoder.decode(&only_depth, &mut [], &mut depth_out).unwrap();
    assert_eq!(&depth_out, depth);
    let refused = decoder.decode(&only_depth, &mut vec![0; rgb.len()], &mut depth_out);
    assert!(matches!(refused, Err(DecodeError::Room { part: "colour", expected: 0, .. })));
    let all = picture.encode(EncodeOptions::default());
    depth_out.fill(0);
    decoder.decode(&all, &mut [], &mut depth_out).unwrap();
    assert_eq!(&depth_out, depth);
    let mut ids = vec![0; depth.len()];
    let mut room = ImageMut { ids: &mut ids, ..ImageMut::default() };
    decoder.decode_image(&all, &mut room).unwrap();
    assert_eq!(ids, picture.ids);
}

#[test]
fn rejects_wrong_arguments_with_the_reason() {
    let picture = Picture::new(8, 8);
    let (rgb, depth) = (&picture.rgb, &picture.depth_mm);
    let mut encoder = Encoder::new(EncodeOptions::default());
    let mut out = Vec::new();
    let view = RgbdView { width: 8, height: 8, rgb: &rgb[1..], depth_mm: depth };
    let error = encoder.encode(&view, &mut out).unwrap_err();
    assert_eq!(error.to_string(), "colour has 191 bytes; 8x8 needs 192");
    let view = RgbdView { rgb, depth_mm: &depth[1..], ..view };
    assert!(matches!(encoder.encode(&view, &mut out), Err(EncodeError::Depth { found: 63, .. })));
    let view = ImageView { alpha: &picture.alpha[..60], ..picture.view() };
    let error = encoder.encode(view, &mut out).unwrap_err();
    assert_eq!(error.to_string(), "alpha has 60 pixels; 8x8 needs 64");
    let view = ImageView { width: 0, height: 8, ..ImageView::default() };
    assert_eq!(encoder.encode(view, &mut out), Err(EncodeError::Size(0, 8)));
    let bytes = picture.encode(EncodeOptions::default());
    let error = Decoder::new().decode(&bytes, &mut [0; 5], &mut []).unwrap_err();
    assert!(matches!(error, DecodeError::Room { part: "colour", found: 5, expected: 192, .. }));
}

/// FNV-1a hash.
fn hash(bytes: &[u8]) -> u64 {
    let step = |hash: u64, byte: &u8| (hash ^ u64::from(*byte)).wrapping_mul(0x100_0000_01b3);
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, step)
}

/// Returns hashes of colour and depth.
fn pixels(bytes: &[u8]) -> [u64; 2] {
    let back = Picture::decode(&mut Decoder::new(), bytes).unwrap();
    let depth: Vec<_> = back.depth_mm.iter().flat_map(|mm| mm.to_le_bytes()).collect();
    [hash(&back.rgb), hash(&depth)]
}

/// A picture computed in integers only, because sine functions differ between machines.
fn integers() -> Picture {
    let mut picture = Picture::blank(160, 120);
    for at in 0..160 * 120 {
        let (x, y) = (at % 160, at / 160);
        let wave = |n: usize| ((n * n / 64 + n) % 256) as u8;
        let rgb = [wave(x + y), wave(2 * x), wave(3 * y + x / 2)];
        picture.rgb[3 * at..][..3].copy_from_slice(&rgb);
        let near = (x / 40 + y / 30) % 2 == 0;
        picture.depth_mm[at] = if near { 1500 + 3 * x + y } else { 6000 + 20 * y } as u16;
        picture.ids[at] = if near { 7 } else { 0 };
        picture.alpha[at] = 255 - (x / 2) as u8;
    }
    picture
}

/// Servers and runtimes run on different processors, with different vector instructions.
#[test]
fn colour_and_depth_have_the_same_bytes_on_every_processor() {
    let picture = integers();
    let mut noise = Picture::blank(160, 120);
    noise.fill_at_random(7, 11);
    let mut found = Vec::new();
    for picture in [&picture, &noise] {
        for depth_mode in [DepthMode::Fast, DepthMode::Small] {
            let depth_bound = DepthBound::new(0.002);
            let bytes = picture.encode(EncodeOptions { depth_mode, depth_bound, ..SMALLEST });
            let [colour, depth] = pixels(&bytes);
            found.push([hash(&bytes), colour, depth]);
        }
    }
    // Bitstream, colour, and depth.
    let expected = [
        [0x9c5a_d2af_faf3_0414, 0xc555_48f0_95d4_af01, 0x8112_1e6e_8dc8_5ad9],
        [0x4d29_fc70_4bd8_2428, 0xc555_48f0_95d4_af01, 0x8112_1e6e_8dc8_5ad9],
        [0xfff9_a86b_d42d_a4b1, 0x5399_3a0a_1624_a80c, 0x8a2e_070a_b772_6551],
        [0x549d_cf74_e32c_d46c, 0x5399_3a0a_1624_a80c, 0x8a2e_070a_b772_6551],
    ];
    assert_eq!(found, expected, "{found:#x?}");
}

#[test]
fn jpeg_has_the_same_bytes_on_every_processor() {
    let picture = integers();
    let found = [ColorMode::Jpeg444, ColorMode::Jpeg420].map(|color_mode| {
        hash(&picture.encode(EncodeOptions { color_mode, ..EncodeOptions::default() }))
    });
    assert_eq!(found, [0x27e1_ae4d_ed72_1b93, 0x2f62_453d_d46a_7605], "{found:#x?}");
}

/// Recordings of one computer are replayed on another. (These images come from another encoder.)
#[test]
fn recorded_images_have_the_same_pixels_on_every_processor() {
    let found =
        [include_bytes!("data/444.rgbd").as_slice(), include_bytes!("data/420.rgbd")].map(pixels);
    let expected = [
        [0x0ccf_20aa_9b4a_7eb0, 0x9a46_d6c0_94b8_4596],
        [0x7876_80a5_fef1_6ee2, 0x9a46_d6c0_94b8_4596],
    ];
    assert_eq!(found, expected, "{found:#x?}");
}

#[test]
fn large_images_survive_a_round_trip() {
    for (width, height) in [(4096, 3000), (4095, 17), (19, 3000)] {
        let picture = Picture::new(width, height);
        let options = EncodeOptions { slices: 64, ..EncodeOptions::default() };
        let back = Picture::decode(&mut Decoder::new(), &picture.encode(options)).unwrap();
        assert!(back.depth_mm == picture.depth_mm, "{width}x{height}");
        assert!(back.alpha == picture.alpha && back.ids == picture.ids, "{width}x{height}");
        assert!(picture::psnr_db(&picture.rgb, &back.rgb) > 38.0, "{width}x{height}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// All sizes, numbers of slices and lossless modes, with random pixels.
    #[test]
    fn random_pixels_survive_a_round_trip(
        width in 1u32..150, height in 1u32..150, slices in 1u8..=64, seed: u64,
        depth_mode in prop::sample::select(vec![DepthMode::Fast, DepthMode::Small]),
        bits in 0u32..=16,
    ) {
        let mut picture = Picture::blank(width, height);
        picture.fill_at_random(seed, bits);
        let options = EncodeOptions { depth_mode, slices, ..SMALLEST };
        let back = Picture::decode(&mut Decoder::new(), &picture.encode(options)).unwrap();
        prop_assert!(back == picture);
    }
}
