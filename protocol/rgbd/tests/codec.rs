//! The whole bitstream: round trips, refusals, hostile bytes.

use proptest::prelude::*;
use vizflyt_rgbd::{
    DecodeError, Decoder, EncodeError, EncodeOptions, Encoder, RgbdView, encode_jpeg, peek,
};

/// A smooth picture with texture, and depth with an edge and a hole.
fn picture(width: u32, height: u32) -> (Vec<u8>, Vec<u16>) {
    let mut rgb = Vec::new();
    let mut depth = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let (u, v) = (f64::from(x) * 0.11, f64::from(y) * 0.07);
            let grain = f64::from((x * 7919 + y * 104729) % 17) - 8.0;
            for phase in [0.0, 1.0, 2.0] {
                let value = 128.0 + 80.0 * (u + phase).sin() * (v - phase).cos() + grain;
                rgb.push(value as u8);
            }
            depth.push(match (x + y) % 50 {
                0..3 => 0,
                3..25 => (1500 + 2 * x + y) as u16,
                _ => (9000 - y) as u16,
            });
        }
    }
    (rgb, depth)
}

fn encode(width: u32, height: u32, rgb: &[u8], depth_mm: &[u16]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let view = RgbdView { width, height, rgb, depth_mm };
    Encoder::new(EncodeOptions::default()).encode(&view, &mut bytes).unwrap();
    bytes
}

fn psnr_db(a: &[u8], b: &[u8]) -> f64 {
    let squares: f64 = a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    10.0 * (255.0f64.powi(2) / (squares / a.len() as f64)).log10()
}

#[test]
fn depth_is_exact_and_colour_close_at_odd_sizes() {
    let mut decoder = Decoder::new();
    for (width, height) in [(320, 240), (1, 1), (7, 5), (33, 65), (640, 1), (1, 480)] {
        let (rgb, depth) = picture(width, height);
        let bytes = encode(width, height, &rgb, &depth);
        let info = peek(&bytes).unwrap();
        assert_eq!((info.width, info.height, info.has_color), (width, height, true));
        let (mut rgb_out, mut depth_out) = (vec![0; rgb.len()], vec![1; depth.len()]);
        decoder.decode(&bytes, &mut rgb_out, &mut depth_out).unwrap();
        assert!(depth_out == depth, "depth differs at {width}x{height}");
        let psnr = psnr_db(&rgb, &rgb_out);
        assert!(psnr > 38.0, "{psnr:.1} dB at {width}x{height}");
    }
}

#[test]
fn quality_trades_size_for_error() {
    let (rgb, _) = picture(160, 120);
    let (mut coarse, mut fine) = (Vec::new(), Vec::new());
    encode_jpeg(&rgb, 160, 120, 40, &mut coarse).unwrap();
    encode_jpeg(&rgb, 160, 120, 95, &mut fine).unwrap();
    assert!(coarse.len() < fine.len());
    assert_eq!(encode_jpeg(&rgb, 160, 120, 0, &mut fine), Err(EncodeError::Quality(0)));
}

#[test]
fn parts_may_be_absent_or_unwanted() {
    let (rgb, depth) = picture(40, 30);
    let mut decoder = Decoder::new();
    let only_depth = encode(40, 30, &[], &depth);
    let mut depth_out = vec![0; depth.len()];
    decoder.decode(&only_depth, &mut [], &mut depth_out).unwrap();
    assert_eq!(depth_out, depth);
    let refused = decoder.decode(&only_depth, &mut vec![0; rgb.len()], &mut depth_out);
    assert!(matches!(refused, Err(DecodeError::Slice { part: "colour", expected: 0, .. })));
    let both = encode(40, 30, &rgb, &depth);
    depth_out.fill(0);
    decoder.decode(&both, &mut [], &mut depth_out).unwrap();
    assert_eq!(depth_out, depth);
}

#[test]
fn wrong_arguments_are_refused_precisely() {
    let (rgb, depth) = picture(8, 8);
    let mut encoder = Encoder::new(EncodeOptions::default());
    let mut out = Vec::new();
    let view = RgbdView { width: 8, height: 8, rgb: &rgb[1..], depth_mm: &depth };
    let error = encoder.encode(&view, &mut out).unwrap_err();
    assert_eq!(error.to_string(), "colour has 191 bytes; 8x8 needs 192");
    let view = RgbdView { rgb: &rgb, depth_mm: &depth[1..], ..view };
    assert!(matches!(encoder.encode(&view, &mut out), Err(EncodeError::Depth { found: 63, .. })));
    let view = RgbdView { width: 0, ..view };
    assert_eq!(encoder.encode(&view, &mut out), Err(EncodeError::Size(0, 8)));
    let bytes = encode(8, 8, &rgb, &depth);
    let error = Decoder::new().decode(&bytes, &mut [0; 5], &mut []).unwrap_err();
    assert!(matches!(error, DecodeError::Slice { part: "colour", found: 5, expected: 192, .. }));
}

#[test]
fn truncation_at_every_length_is_an_error() {
    let (rgb, depth) = picture(24, 18);
    let bytes = encode(24, 18, &rgb, &depth);
    let (mut rgb_out, mut depth_out) = (vec![0; rgb.len()], vec![0; depth.len()]);
    for len in 0..bytes.len() {
        let result = Decoder::new().decode(&bytes[..len], &mut rgb_out, &mut depth_out);
        assert!(result.is_err(), "{len} of {} bytes were accepted", bytes.len());
    }
    let mut longer = bytes.clone();
    longer.push(0);
    let result = Decoder::new().decode(&longer, &mut rgb_out, &mut depth_out);
    assert!(matches!(result, Err(DecodeError::Length { .. })));
}

#[test]
fn a_jpeg_cut_short_inside_whole_bytes_is_an_error() {
    // The header agrees with the length, so only the JPEG decoder can notice.
    let (rgb, _) = picture(24, 18);
    let bytes = encode(24, 18, &rgb, &[]);
    let mut rgb_out = vec![0; rgb.len()];
    for len in 24..bytes.len() - 2 {
        let mut cut = bytes[..len].to_vec();
        cut[16..20].copy_from_slice(&(len as u32 - 24).to_le_bytes());
        let result = Decoder::new().decode(&cut, &mut rgb_out, &mut []);
        assert!(matches!(result, Err(DecodeError::Color(_))), "{len}: {result:?}");
    }
}

#[test]
fn the_size_in_the_jpeg_must_be_the_headers() {
    let (rgb, _) = picture(24, 18);
    let mut bytes = encode(24, 18, &rgb, &[]);
    bytes[8] = 18;
    bytes[12] = 24;
    let result = Decoder::new().decode(&bytes, &mut vec![0; rgb.len()], &mut []);
    assert!(matches!(result, Err(DecodeError::Color(_))), "{result:?}");
}

#[test]
fn strangers_are_refused_by_name() {
    let (rgb, depth) = picture(8, 8);
    let bytes = encode(8, 8, &rgb, &depth);
    let with = |at: usize, value: u8| {
        let mut bytes = bytes.clone();
        bytes[at] = value;
        peek(&bytes)
    };
    assert!(matches!(with(0, b'X'), Err(DecodeError::Foreign(_))));
    assert_eq!(with(4, 9), Err(DecodeError::Version(9)));
    assert_eq!(with(5, 9), Err(DecodeError::Mode("colour", 9)));
    assert_eq!(with(6, 9), Err(DecodeError::Mode("depth", 9)));
    assert_eq!(with(11, 9).unwrap_err(), DecodeError::Size(0x0900_0008, 8));
    assert!(matches!(with(19, 255), Err(DecodeError::Length { .. })));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    /// Flipped bits give an image or an error, never a panic.
    #[test]
    fn flipped_bits_are_survived(
        flips in prop::collection::vec((any::<prop::sample::Index>(), 0u8..8), 1..6),
    ) {
        let (rgb, depth) = picture(33, 19);
        let mut bytes = encode(33, 19, &rgb, &depth);
        for (at, bit) in flips {
            let at = at.index(bytes.len());
            bytes[at] ^= 1 << bit;
        }
        let (mut rgb_out, mut depth_out) = (vec![0; rgb.len()], vec![0; depth.len()]);
        let _ = Decoder::new().decode(&bytes, &mut rgb_out, &mut depth_out);
    }

    /// Any bytes after a true header.
    #[test]
    fn any_parts_are_survived(parts in prop::collection::vec(any::<u8>(), 0..600), cut: prop::sample::Index) {
        let (rgb, depth) = picture(16, 16);
        let mut bytes = encode(16, 16, &rgb, &depth)[..24].to_vec();
        let color_len = cut.index(parts.len() + 1) as u32;
        bytes[16..20].copy_from_slice(&color_len.to_le_bytes());
        bytes[20..24].copy_from_slice(&(parts.len() as u32 - color_len).to_le_bytes());
        bytes.extend(&parts);
        let (mut rgb_out, mut depth_out) = (vec![0; rgb.len()], vec![0; depth.len()]);
        let _ = Decoder::new().decode(&bytes, &mut rgb_out, &mut depth_out);
    }

    #[test]
    fn any_bytes_are_survived(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let _ = peek(&bytes);
        let _ = Decoder::new().decode(&bytes, &mut [0; 48], &mut [0; 16]);
    }
}
